"""The unit at work under a real systemd, as it is deployed; the PLC polls it over the wire."""

from __future__ import annotations

import contextlib
import json
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import yaml

from firmware_bridge.links.modbus_master import ModbusMaster
from firmware_bridge.links.ports import open_tcp
from firmware_bridge.wire.profiles import PROFILES
from inspector.faults import Fault
from inspector.model import State, Verdict
from inspector.publish.registers import Status
from tests.line.conftest import Plc

REPOSITORY = Path(__file__).parents[2]
PORT, MODULE_PORT, PROFILE = 5020, 1502, "iologik-e1241"


class Station:
    """A machine on which the service is installed and enabled, its lamp on a module that is a process of its own."""

    def __init__(self, machine: Any, wait_until: Callable[..., Any]) -> None:
        self.machine, self._wait_until = machine, wait_until
        self.etc, self.units = machine.root / "etc/inspector", machine.root / "etc/systemd/system"
        self._clients = contextlib.ExitStack()
        self.settings = yaml.safe_load((REPOSITORY / "config/demo.yaml").read_text())
        self.settings["camera"] = {"kind": "simulated", "seeds": [[0, 0, 1500]], "rate_hz": 20, "deadline_s": 1}
        self.settings["module"] = {
            "profile": PROFILE,
            "link": {"kind": "tcp", "host": "127.0.0.1", "port": MODULE_PORT},
            "deadline_s": 1,
        }
        machine.install_project()
        shutil.copytree(REPOSITORY / "config", self.etc)
        for pattern in ("*.service", "*.timer"):
            for unit in (REPOSITORY / "deploy").glob(pattern):
                shutil.copy(unit, self.units)
        wants = self.units / "multi-user.target.wants"
        wants.mkdir()
        (wants / "inspector.service").symlink_to("/etc/systemd/system/inspector.service")
        self.write()

    def write(self) -> None:
        """Put the settings into the file."""
        (self.etc / "line.yaml").write_text(yaml.safe_dump(self.settings))

    def drop_in(self, unit: str, text: str) -> None:
        """What a plant adds to a unit."""
        folder = self.units / f"{unit}.d"
        folder.mkdir(exist_ok=True)
        (folder / f"{len(list(folder.iterdir()))}.conf").write_text(text)

    def systemctl(self, *words: str, check: bool = True) -> str:
        """What systemctl answers."""
        return str(self.machine.run("systemctl", *words, check=check).stdout).strip()

    def plug_in_module(self) -> None:
        """The module, served until the machine is off."""
        simulate = ["/usr/bin/inspector", "simulate-device", "module", "--profile", PROFILE]
        self.machine.run("systemd-run", "--unit=module", *simulate, "--tcp-port", str(MODULE_PORT))

    def lamp_v(self) -> float:
        """The level of the lamp's output, read at the module by another master."""

        def read() -> float:
            opener = partial(open_tcp, "module", "127.0.0.1", MODULE_PORT, 5)
            profile = PROFILES[PROFILE]
            with contextlib.closing(ModbusMaster("module", 1, opener, rtu=False, deadline_s=5)) as master:
                master.open()
                return profile.span.volts(master.read(profile.output.table, profile.output.address)[0])

        return float(self.machine.in_network(read))

    def until(self, condition: Callable[[dict[str, Any]], Any], what: str, deadline_s: float = 60) -> dict[str, Any]:
        """The first registers that the condition holds for; who polls connects anew when the service has gone."""
        plc: list[Plc] = []

        def met() -> dict[str, Any] | None:
            try:
                if not plc:
                    plc.append(self.machine.in_network(lambda: Plc(PORT)))
                registers = plc[0].read()
            except OSError:
                if plc:
                    plc.pop().close()
                return None
            return registers if condition(registers) else None

        try:
            found: dict[str, Any] = self._wait_until(met, what, deadline_s)
        except pytest.fail.Exception:
            pytest.fail(f"{what}; log: {self.machine.journal('inspector')[-30:]}")
        finally:
            for client in plc:
                client.close()
        return found

    def main_pid(self) -> int:
        """The service's process, in its own numbering; 0 while there is none."""
        return int(self.systemctl("show", "--property=MainPID", "--value", "inspector"))

    def log(self, text: str) -> list[str]:
        """Lines of the service's journal that have this text."""
        return [line for line in self.machine.journal("inspector") if text in line]


@pytest.fixture
def station(booted: Any, wait_until: Callable[..., Any]) -> Station:
    """The machine is still off."""
    return Station(booted, wait_until)


def refused(registers: dict[str, Any]) -> bool:
    return Status.SETTINGS_REFUSED in Status(int(registers["status"]))


def test_the_service_starts_inspects_refuses_a_bad_file_and_stops_dark(station: Station) -> None:
    station.machine.boot()
    absent = station.until(lambda r: r["fault_code"], "a fault")
    assert (absent["fault_code"], absent["verdict"]) == (Fault.MODULE_GONE, Verdict.NOT_INSPECTED)
    station.plug_in_module()
    before = station.until(lambda r: r["verdict"], "a verdict")
    assert station.systemctl("is-active", "inspector") == "active"
    assert station.lamp_v() > 0
    station.settings["plc"]["port"] = 99999
    station.write()
    station.systemctl("reload", "inspector")
    shown = station.until(refused, "settings refused")
    assert shown["configuration_hash"] == before["configuration_hash"]
    station.until(lambda r: r["verdict"] and r["sequence"] > shown["sequence"], "a verdict by the old settings")
    station.systemctl("stop", "inspector")
    assert station.lamp_v() == 0
    assert station.systemctl("show", "--property=Result", "inspector") == "Result=success"


@pytest.mark.long
def test_a_cycle_that_hangs_is_told_ended_by_the_watchdog_and_the_service_comes_back(station: Station) -> None:
    station.settings["camera"]["faults"] = [{"kind": "hangs", "after": 10, "count": 1}]
    station.write()
    station.drop_in("inspector.service", "[Service]\nWatchdogSec=8\n")
    station.machine.boot()
    station.plug_in_module()
    station.until(lambda r: r["verdict"], "a verdict")
    stalled = station.until(lambda r: r["fault_code"] == Fault.CYCLE_STALLED, "told that the cycle stalled")
    assert (stalled["verdict"], stalled["state"]) == (Verdict.NOT_INSPECTED, State.ERROR)
    station.until(lambda r: r["verdict"] and not r["fault_code"] and r["panels_passed"] < 5, "begun anew", 90)
    assert station.log("Watchdog timeout")
    assert int(station.systemctl("show", "--property=NRestarts", "--value", "inspector")) >= 1


@pytest.mark.long
def test_settings_that_do_not_bring_the_station_to_ready_are_taken_back_and_stay_so_over_a_power_cut(
    station: Station,
) -> None:
    station.settings["cycle"] = {"rollback_after_s": 3}
    station.write()
    station.machine.boot()
    station.plug_in_module()
    before = station.until(lambda r: r["verdict"], "a verdict")
    station.settings["module"]["link"]["port"] = MODULE_PORT + 1
    station.write()
    station.systemctl("reload", "inspector")
    station.until(lambda r: r["fault_code"] == Fault.MODULE_GONE and not refused(r), "the new settings on trial")
    back = station.until(lambda r: r["verdict"] and refused(r), "the old ones again")
    assert back["configuration_hash"] == before["configuration_hash"]
    assert station.log("the last good ones are in force again")
    for text in ((station.etc / "line.yaml").read_text(), "{"):
        station.machine.cut_power()
        (station.etc / "line.yaml").write_text(text)
        station.machine.boot()
        station.plug_in_module()
        again = station.until(lambda r: r["verdict"] and refused(r), "the last good ones after the power cut")
        assert again["configuration_hash"] == before["configuration_hash"]
    station.settings["module"]["link"]["port"] = MODULE_PORT
    station.write()
    station.systemctl("reload", "inspector")
    station.until(lambda r: r["verdict"] and not refused(r), "a good file")


@pytest.mark.long
def test_only_a_service_that_answers_nothing_or_was_given_up_is_started_again_from_outside(
    station: Station, wait_until: Callable[..., Any]
) -> None:
    station.drop_in("inspector.service", "[Service]\nWatchdogSec=0\n")
    station.drop_in("inspector-health.timer", "[Timer]\nOnActiveSec=1\nOnUnitInactiveSec=1\nAccuracySec=100ms\n")
    station.machine.boot()
    station.until(lambda r: r["fault_code"] == Fault.MODULE_GONE, "a device's fault")
    first = station.main_pid()

    def times_seen() -> int:
        return len([line for line in station.machine.journal("inspector-health") if "fault 101" in line])

    wait_until(lambda: times_seen() >= 2, "health has looked twice", 60)
    assert station.main_pid() == first
    assert station.systemctl("show", "--property=NRestarts", "--value", "inspector") == "0"
    station.machine.run("kill", "-STOP", str(first))
    wait_until(lambda: station.main_pid() not in (0, first), "another process in place of the one that is stopped", 90)
    station.plug_in_module()
    station.until(lambda r: r["verdict"], "a verdict")

    killed = set()
    while station.systemctl("is-failed", "inspector", check=False) != "failed":
        if (pid := station.main_pid()) and pid not in killed:
            killed.add(pid)
            station.machine.run("kill", "-KILL", str(pid), check=False)
    station.until(lambda r: r["verdict"], "a verdict, after it was given up")

    station.systemctl("stop", "inspector")
    assert station.systemctl("is-active", "inspector-health.timer", check=False) == "inactive"


@pytest.mark.long
def test_rules_and_settings_of_the_system_are_read_without_a_word(station: Station) -> None:
    deploy, etc = REPOSITORY / "deploy", station.machine.root / "etc"
    shutil.copytree(deploy / "udev", etc / "udev/rules.d", dirs_exist_ok=True)
    for folder in ("tmpfiles.d", "sysctl.d"):
        shutil.copytree(deploy / folder, etc / folder, dirs_exist_ok=True)
    for folder in ("journald.conf.d", "system.conf.d"):
        shutil.copytree(deploy / folder, etc / "systemd" / folder, dirs_exist_ok=True)
    station.drop_in("inspector.service", (deploy / "inspector.service.d/plant.conf").read_text().replace("#", ""))
    station.machine.boot()
    run = station.machine.run
    for rule, complaints in (("", False), ('SUBSYSTEM=="tty", NO_SUCH_KEY="1"\n', True)):
        (etc / "udev/rules.d/62-more.rules").write_text(rule)
        said = run("udevadm", "test", "/sys/class/tty/tty0", check=False)
        assert ("rules.d/6" in "".join(line for line in said.stderr.splitlines(True) if "nvalid" in line)) is complaints
    for name, mode in (("etc/inspector", 0o755), ("etc/credstore", 0o700)):
        assert (station.machine.root / name).stat().st_mode & 0o777 == mode
    run("systemd-tmpfiles", "--create", "inspector.conf")
    assert run("systemd-analyze", "cat-config", "systemd/journald.conf").stdout.count("SystemMaxUse=500M") == 1
    complaints = run("journalctl", "--priority=warning", "--output=cat", "_PID=1").stdout
    assert "inspector" not in complaints, complaints


PROBE = """
import ctypes, json, os, pathlib, socket, time

def tried(call):
    try:
        call()
    except OSError as error:
        return error.strerror or str(error)
    return "done"

def connect(host):
    with socket.socket() as client:
        client.settimeout(1)
        client.connect((host, 9))

folders = ["/etc", "/etc/inspector", "/usr/bin", "/opt/inspector", "/var/lib", "/run", "/home", "/root", "/boot",
           "/srv", "/sys", "/proc/sys/kernel"]
secrets = ["/etc/shadow", "/etc/credstore/inspector-plc.key", "/proc/1/environ", "/dev/kmsg", "/dev/net/tun"]
privileged = {
    "set the clock": lambda: time.clock_settime(time.CLOCK_REALTIME, 0),
    "raw socket": lambda: socket.socket(socket.AF_INET, socket.SOCK_RAW, 1),
    "packet socket": lambda: socket.socket(socket.AF_PACKET, socket.SOCK_RAW),
    "another user": lambda: os.setuid(0),
    "another root": lambda: os.chroot("/tmp"),
    "connect elsewhere": lambda: connect("192.0.2.1"),
}
print("probe: " + json.dumps({
    "uid": os.getuid(),
    "written": [path for path in folders if tried(lambda: pathlib.Path(path, "x").write_text("x")) == "done"],
    "read": [path for path in secrets if tried(lambda: pathlib.Path(path).read_bytes()) == "done"],
    "privileged": [name for name, call in privileged.items() if tried(call) == "done"],
    "namespace": ctypes.CDLL(None).unshare(0x10000000),
    "state": tried(lambda: pathlib.Path(os.environ["STATE_DIRECTORY"], "x").write_text("x")),
    "ports": [tried(lambda: socket.create_server(("127.0.0.1", port)).close()) for port in (502, 802)],
    "this machine": tried(lambda: connect("127.0.0.1")),
    "credential": pathlib.Path(os.environ["CREDENTIALS_DIRECTORY"], "inspector-plc.key").read_text(),
}))
"""


@pytest.mark.long
def test_what_runs_as_the_service_can_do_nothing_else(station: Station) -> None:
    (station.etc / "probe.py").write_text(PROBE)
    credentials = station.machine.root / "etc/credstore"
    credentials.mkdir(mode=0o700, exist_ok=True)
    (credentials / "inspector-plc.key").write_text("secret")
    (credentials / "inspector-plc.key").chmod(0o400)
    for folder in ("srv", "home"):
        (station.machine.root / folder).chmod(0o777)
    # The unit as it is, but for what it runs: its last word on each of these counts.
    station.drop_in(
        "inspector.service",
        "[Service]\nType=oneshot\nRestart=no\nEnvironment=LD_LIBRARY_PATH=/opt/inspector/python/lib\nExecStart=\n"
        "ExecStart=/opt/inspector/.venv/bin/python /etc/inspector/probe.py\n",
    )
    (station.units / "multi-user.target.wants/inspector.service").unlink()
    station.machine.boot()
    station.machine.run("ip", "address", "add", "192.0.2.1/32", "dev", "lo")  # so that the filter alone is in the way
    station.systemctl("start", "inspector")
    (line,) = station.log("probe: ")
    said = json.loads(line.removeprefix("probe: "))
    assert 61184 <= said.pop("uid") <= 65519, "the range of dynamic users"
    assert said == {
        "written": [],
        "read": [],
        "privileged": [],
        "namespace": -1,
        "state": "done",
        "ports": ["done", "done"],
        "this machine": "Connection refused",
        "credential": "secret",
    }


@pytest.mark.long
def test_an_archive_has_a_disk_that_is_mounted_after_the_service_has_started(station: Station) -> None:
    archive, private = "/var/lib/inspector/archive", "/var/lib/private/inspector"
    station.settings["archive"] = {"folder": archive, "disk": archive, "frames": {"min_free_mb": 0}}
    station.settings |= {f"{name}_file": f"/var/lib/inspector/{name}.json" for name in ("recipe_choice", "statistics")}
    station.settings["plc"]["sequence_file"] = "/var/lib/inspector/sequence.json"
    station.write()
    station.machine.boot()
    station.plug_in_module()
    station.until(lambda r: r["verdict"] and r["status"] & Status.STORE_DEGRADED, "results wait for the disk")
    assert station.log("no disk is mounted there")
    station.machine.run("mkdir", f"{private}/archive")
    station.machine.run("mount", "-t", "tmpfs", "-o", "mode=700", "archive", f"{private}/archive")
    station.machine.run("chown", f"--reference={private}", f"{private}/archive")
    station.until(lambda r: r["verdict"] and not r["status"] & Status.STORE_DEGRADED, "they are on the disk")
    station.systemctl("restart", "inspector")
    station.until(lambda r: r["verdict"] and not r["status"] & Status.STORE_DEGRADED, "they are again")
