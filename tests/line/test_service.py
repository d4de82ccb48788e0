"""The service as a process, over the wire: what a PLC and a terminal see of a station whose parts come and go."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from firmware_bridge.simulators.module_server import ModuleServer, WireFault
from inspector.faults import Fault
from inspector.model import State, Verdict
from inspector.publish.registers import Status
from inspector.publish.systemd import Notifier
from tests.line.conftest import Service, Station, simulated_module
from tests.support import forked

GOES_ON = 3
"""Further results to wait for where something must stay as it is."""


def verdict_of(line: str) -> str:
    return line.split()[1]


def test_parts_that_are_missing_at_the_start_are_named_in_turn_and_waited_for(
    station: Any, module: Callable[[], ModuleServer], service: Callable[..., Any]
) -> None:
    hidden = station.frames.rename(station.folder / "elsewhere")
    running = service()
    first = running.until_fault(Fault.MODULE_GONE)
    assert first["state"] == State.ERROR
    assert not Status(int(first["status"])) & (Status.LAMP_OK | Status.CAMERA_OK | Status.RESULTS_VALID)
    module()
    second = running.until_fault(Fault.CAMERA_GONE)
    assert Status.LAMP_OK in Status(int(second["status"]))
    hidden.rename(station.frames)
    shown = running.until_inspecting()
    assert shown["state"] == State.CONTINUOUS_EXECUTION
    assert shown["fault_code"] == 0
    assert {Status.LAMP_OK, Status.CAMERA_OK, Status.SIMULATED} <= set(Status(int(shown["status"])))
    said = [re.sub(r".*?(ERROR|INFO) ", "", line) for line in running.log]
    for device in ("lamp", "camera"):
        assert len([line for line in said if line.startswith(f"{device} fails")]) == 1
        assert len([line for line in said if line.startswith(f"{device} works again")]) == 1


def test_registers_equal_what_inspect_says_of_the_same_frames(
    station: Any, module: Callable[[], ModuleServer], service: Callable[..., Any]
) -> None:
    module()
    recipe = station.folder / "recipe.yaml"
    recipe.write_text(yaml.safe_dump(station.settings["recipe"]))
    station.settings |= {"recipe": recipe.name}
    station.settings["camera"]["rate_hz"] = 5
    station.write()
    frames = sorted(station.frames.iterdir())
    options = ["--calibration", station.settings["calibration"], "--recipe", recipe]
    said = forked.run("inspect", *frames, "--format", "jsonl", *options)
    expected = {Path(row["frame"]).name: row for row in map(json.loads, said.stdout.splitlines())}
    running = service()
    unseen, last = set(expected), 0
    while unseen:
        shown = running.until(lambda r, after=last: r["sequence"] > after, f"a result after {last}")
        last = int(shown["sequence"])
        line = running.lines_to(last)[-1]
        name = next(name for name in expected if name in line)
        unseen.discard(name)
        check_registers(shown, expected[name])


def check_registers(shown: dict[str, Any], row: dict[str, Any]) -> None:
    """The result block says what the frame's JSON does, each number rounded to its register's step."""
    assert Verdict(int(shown["verdict"])).name == row["verdict"]
    assert shown["defect_count"] == len(row["defects"])
    heights = sorted((defect["height_um"] for defect in row["defects"]), reverse=True)
    assert shown["largest_height_um_f32"] == pytest.approx(heights[0] if heights else 0.0, rel=1e-6)
    for number, defect in enumerate(sorted(row["defects"], key=lambda d: -d["height_um"]), 1):
        for key, step in (("x_mm", 0.01), ("y_mm", 0.01), ("height_um", 1), ("height_sigma_um", 1)):
            assert shown[f"defect_{number}_{key}"] == pytest.approx(defect[key], abs=step / 2 + 1e-9)


def lost_and_found(running: Any, code: int, lose: Callable[[], Any], find: Callable[[], Any]) -> None:
    """After ``lose`` there is no verdict but for frames already on their way, until ``find``; the code says why."""
    running.until_inspecting()
    lose()
    lost = running.until_fault(code)
    running.until(lambda r: r["sequence"] >= lost["sequence"] + GOES_ON, "further results")
    find()
    found = running.until_inspecting(after=int(lost["sequence"]))
    assert found["fault_code"] == 0
    lines = running.lines_to(int(found["sequence"]))
    first = next(n for n in range(int(lost["sequence"]), len(lines) + 1) if verdict_of(lines[n - 1]) != "NOT_INSPECTED")
    assert first >= lost["sequence"] + GOES_ON


class Lasting:
    """A station at work through all the losses of one worker's tests, each of which it gets over."""

    def __init__(self, folder: Path, wait_until: Callable[..., Any]) -> None:
        self.station = Station(folder)
        self.server = simulated_module(self.station)
        self.running = Service(self.station.file, wait_until, [])

    def put_back(self) -> None:
        """The module's line, under another name."""
        self.server = simulated_module(self.station)

    def close(self) -> None:
        self.running.close()
        self.server.stop()


@pytest.fixture(scope="module")
def lasting(tmp_path_factory: pytest.TempPathFactory, wait_until: Callable[..., Any]) -> Iterator[Lasting]:
    with contextlib.closing(Lasting(tmp_path_factory.mktemp("lasting"), wait_until)) as station:
        yield station


one_service = pytest.mark.xdist_group("one service through all losses")


@one_service
@pytest.mark.parametrize(
    ("fault", "code"),
    [
        (WireFault.SILENT, Fault.MODULE_SILENT),
        (WireFault.BAD_CRC, Fault.MODULE_REPLY_WRONG),
        (WireFault.WRONG_UNIT, Fault.MODULE_REPLY_WRONG),
    ],
)
def test_module_faults_have_their_codes_and_end_by_themselves(lasting: Lasting, fault: WireFault, code: Fault) -> None:
    lost_and_found(
        lasting.running,
        code,
        lambda: setattr(lasting.server, "fault", fault),
        lambda: setattr(lasting.server, "fault", WireFault.NONE),
    )


def test_a_slow_module_that_is_set_up_anew_is_no_stall(
    station: Any, module: Callable[[], ModuleServer], service: Callable[..., Any]
) -> None:
    """Each answer comes in time and opening takes two dozen of them, longer than a cycle may: the cycle lives."""
    station.settings["module"] |= {"deadline_s": 0.6, "safe_v": 1.0, "power_on_v": 0.5, "watchdog_s": 20.0}
    station.settings["camera"]["deadline_s"] = 0.2
    station.write()
    server = module()
    server.module.trip()
    server.fault, server.late_s = WireFault.LATE, 0.25
    running = service()
    running.until_inspecting()
    assert not [line for line in running.log if "has not turned" in line]


@one_service
def test_a_lamp_that_does_not_follow_is_never_a_pass(lasting: Lasting) -> None:
    module = lasting.server.module

    def stick() -> None:
        module.stuck = True
        module.set_value(module.profile.read_back_of(0), 0)

    lost_and_found(lasting.running, Fault.LAMP_READBACK, stick, lambda: setattr(module, "stuck", False))


@one_service
def test_a_serial_line_pulled_and_put_back_under_another_name(lasting: Lasting) -> None:
    lost_and_found(lasting.running, Fault.MODULE_GONE, lasting.server.stop, lasting.put_back)


@one_service
def test_a_camera_folder_taken_away_and_put_back(lasting: Lasting) -> None:
    station, elsewhere = lasting.station, lasting.station.folder / "elsewhere"
    lost_and_found(
        lasting.running,
        Fault.CAMERA_GONE,
        lambda: station.frames.rename(elsewhere),
        lambda: elsewhere.rename(station.frames),
    )
    assert lasting.server.module.output_v(0) == pytest.approx(4.0, abs=0.01)


def test_a_simulator_killed_in_mid_run_costs_one_result_and_is_started_again(
    station: Any, service: Callable[..., Any]
) -> None:
    station.settings["module"]["link"] = {"kind": "simulated"}
    station.write()
    running = service()
    running.until_inspecting()
    children = Path(f"/proc/{running.process.pid}/task/{running.process.pid}/children").read_text().split()
    assert len(children) == 1
    os.kill(int(children[0]), signal.SIGKILL)
    running.until(lambda r: r["panels_not_inspected"], "a result that is NOT_INSPECTED")
    running.until_inspecting(after=len(running.results))
    (line,) = (line for line in running.results if verdict_of(line) == "NOT_INSPECTED")
    assert "MODULE_GONE" in line or "MODULE_SILENT" in line


def test_a_recording_at_its_end_is_a_camera_without_frames(
    station: Any, module: Callable[[], ModuleServer], service: Callable[..., Any]
) -> None:
    module()
    station.settings["camera"] |= {"loop": False}
    station.write()
    running = service()
    shown = running.until_fault(Fault.CAMERA_TIMEOUT)
    assert shown["state"] == State.ERROR
    assert shown["panels_passed"] + shown["panels_failed"] == len(list(station.frames.iterdir()))


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_stop_puts_the_lamp_out_even_while_the_camera_is_waited_for(
    number: signal.Signals, station: Any, module: Callable[[], ModuleServer], service: Callable[..., Any]
) -> None:
    server = module()
    # After the first frame the next one is 1000 s away: only a wait that can be left ends in time.
    station.settings["camera"] |= {"rate_hz": 0.001, "deadline_s": 2000}
    station.write()
    running = service()
    running.until_inspecting()
    assert server.module.output_v(0) == pytest.approx(4.0, abs=0.01)
    running.send(number)
    assert running.ended() == 0
    assert server.module.output_v(0) == 0.0
    assert "stopped" in running.log[-1]


def test_a_stop_without_any_device_is_clean_too(service: Callable[..., Any]) -> None:
    running = service()
    running.until_fault(Fault.MODULE_GONE)
    running.send(signal.SIGTERM)
    assert running.ended() == 0


def test_reload_takes_a_right_file_whole_and_a_wrong_one_not_at_all(
    station: Any, module: Callable[[], ModuleServer], service: Callable[..., Any], wait_until: Callable[..., Any]
) -> None:
    server = module()
    running = service()
    before = running.until_inspecting()
    station.settings["plc"]["port"] = 99999
    station.settings["camera"]["rate"] = 20
    station.write()
    running.send(signal.SIGHUP)
    refused = running.until(lambda r: Status.SETTINGS_REFUSED in Status(int(r["status"])), "settings refused")
    assert refused["configuration_hash"] == before["configuration_hash"]
    assert running.until_inspecting(after=int(refused["sequence"]))["fault_code"] == 0
    log = wait_until(lambda: [line for line in running.log if "settings refused: " in line][1:] and running.log, "log")
    assert any("plc.port: 99999: allowed: a whole number from 0 to 65535" in line for line in log)
    assert any("camera.rate: 20: unknown key (did you mean rate_hz?)" in line for line in log)
    assert any("fault 503" in line for line in log)

    station.settings["plc"]["port"] = 0
    del station.settings["camera"]["rate"]
    station.settings["recipe"] = {"id": 7, "limits": {"max_height_um": 1}}
    server.module.output_v(0)
    station.write()
    running.send(signal.SIGHUP)
    taken = running.until(lambda r: r["recipe_id"] == 7, "recipe 7")
    assert Status.SETTINGS_REFUSED not in Status(int(taken["status"]))
    assert taken["configuration_hash"] != before["configuration_hash"]
    later = running.until(lambda r: r["sequence"] > taken["sequence"] + GOES_ON, "further results")
    assert later["panels_failed"] > taken["panels_failed"]
    assert later["panels_not_inspected"] == 0


def test_systemd_hears_of_every_turn(
    station: Any, module: Callable[[], ModuleServer], service: Callable[..., Any], wait_until: Callable[..., Any]
) -> None:
    module()
    heard: list[str] = []
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        name = f"@inspector-test-{os.getpid()}-{station.folder.name}"
        manager.bind("\0" + name[1:])
        manager.setblocking(False)

        def hears(text: str) -> bool:
            while True:
                try:
                    heard.extend(manager.recv(4096).decode().splitlines())
                except BlockingIOError:
                    return any(line.startswith(text) for line in heard)

        running = service(NOTIFY_SOCKET=name, WATCHDOG_USEC="400000")
        for text in ("READY=1", "WATCHDOG_USEC=", "WATCHDOG=1", "STATUS=CONTINUOUS_EXECUTION"):
            wait_until(lambda text=text: hears(text), text)
        heard.clear()
        running.send(signal.SIGHUP)
        wait_until(lambda: hears("READY=1"), "READY=1 after the reload")
        assert heard.index("RELOADING=1") < heard.index("READY=1")
        assert any(line.startswith("MONOTONIC_USEC=") for line in heard)
        running.send(signal.SIGTERM)
        assert running.ended() == 0
        assert hears("STOPPING=1")


def test_a_second_service_on_the_same_port_says_so(station: Any, service: Callable[..., Any]) -> None:
    port = service().port
    station.settings["plc"]["port"] = port
    station.write()
    second = service()
    assert second.ended() == 69
    assert f"cannot listen on 127.0.0.1:{port}" in second.log[-1]


def test_wrong_settings_are_refused_before_anything_is_touched(station: Any, service: Callable[..., Any]) -> None:
    station.settings |= {"calibration": "none.yaml", "lamp": {"channel": -1}}
    station.write()
    running = service()
    assert running.ended() == 78
    assert running.out == []
    assert any("calibration: 'none.yaml'" in line for line in running.log)
    assert any("lamp.channel: -1" in line for line in running.log)


def test_limits_end_the_service(module: Callable[[], ModuleServer], service: Callable[..., Any]) -> None:
    server = module()
    running = service("--panels", "3")
    assert running.ended() == 0
    assert [line.split()[0] for line in running.results] == ["#1", "#2", "#3"]
    assert server.module.output_v(0) == 0.0
    assert service("--duration-s", "0").ended() == 0


def test_a_terminal_that_goes_away_is_no_fault(
    station: Any, module: Callable[[], ModuleServer], wait_until: Callable[..., Any]
) -> None:
    server = module()
    command = [sys.executable, "-m", "inspector", "run", "--config", str(station.file), "--panels", "5"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        log = process.stderr.read().decode()
        assert process.wait(30) == 0
    assert "Traceback" not in log
    assert server.module.output_v(0) == 0.0


def test_the_demo_is_a_service_that_inspects(station: Any, service: Callable[..., Any]) -> None:
    demo = Path(__file__).parents[2] / "config" / "demo.yaml"
    settings = yaml.safe_load(demo.read_text())
    settings["plc"]["port"] = 0
    settings["calibration"] = str(demo.parent / settings["calibration"])
    settings["camera"]["paths"] = [str(demo.parent / path) for path in settings["camera"]["paths"]]
    settings["archive"]["folder"] = "archive"
    station.settings = settings
    station.write()
    running = service("--panels", "9")
    assert running.ended() == 0
    verdicts = [verdict_of(line) for line in running.results]
    assert set(verdicts) == {"PASS", "FAIL"}
    assert all(a != b for a, b in itertools.pairwise(running.results))


def test_without_systemd_nothing_is_sent() -> None:
    Notifier({}).send("READY=1")
    Notifier({"NOTIFY_SOCKET": "/nowhere/at/all"}).send("READY=1")
