"""The module simulator as a process: found, ended, orphaned, killed and started again, with nothing left behind."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import textwrap
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from firmware_bridge import errors
from firmware_bridge.camera_settings import ReplaySettings
from firmware_bridge.factory import build
from firmware_bridge.settings import LampSettings, ModuleSettings
from firmware_bridge.wire.modbus import Table
from firmware_bridge.wire.profiles import PROFILES

COMMANDS = {
    "module": [sys.executable, "-m", "firmware_bridge.simulators.module"],
    "command": [sys.executable, "-m", "inspector", "simulate-device", "module"],
}


@pytest.fixture
def started() -> Iterator[Callable[..., tuple[subprocess.Popen[str], str]]]:
    """``started(*options, command="module")``: a simulator's process and the address that it printed."""
    with contextlib.ExitStack() as stack:

        def start(*options: str, command: str = "module") -> tuple[subprocess.Popen[str], str]:
            process = subprocess.Popen(
                [*COMMANDS[command], *options], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
            )
            stack.callback(_end, process)
            assert process.stdout is not None
            return process, process.stdout.readline().strip()

        yield start


def _end(process: subprocess.Popen[str]) -> None:
    process.kill()
    with process:
        process.wait(30)


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_it_serves_under_a_name_until_it_is_told_to_end(
    command: str, number: int, started: Any, master_at: Any, tmp_path: Path
) -> None:
    link = tmp_path / "module"
    process, address = started("--profile", "ato-4ch", "--unit", "3", "--symlink", str(link), command=command)
    assert os.readlink(link) == address
    master = master_at(str(link), deadline_s=10.0)
    master.write(Table.HOLDING_REGISTERS, 1, 4095)
    assert master.read(Table.HOLDING_REGISTERS, 0, 4) == [0, 4095, 0, 0]
    process.send_signal(number)
    assert process.wait(30) == 0
    assert not link.is_symlink()


def test_a_dangling_name_is_taken_over_and_a_file_is_not(started: Any, tmp_path: Path) -> None:
    link = tmp_path / "module"
    link.symlink_to(tmp_path / "pulled")
    _, address = started("--profile", "ato-4ch", "--symlink", str(link))
    assert os.readlink(link) == address
    file = tmp_path / "file"
    file.write_text("kept")
    refused, _ = started("--profile", "ato-4ch", "--symlink", str(file))
    assert refused.wait(30) == 2
    assert file.read_text() == "kept"


def test_the_name_of_its_successor_is_left_alone(started: Any, tmp_path: Path) -> None:
    link = tmp_path / "module"
    first, _ = started("--profile", "ato-4ch", "--symlink", str(link))
    _, address = started("--profile", "ato-4ch", "--symlink", str(link))
    first.terminate()
    first.wait(30)
    assert os.readlink(link) == address


def test_what_is_wrong_with_a_module_can_be_asked_for(started: Any, module_at: Any) -> None:
    _, address = started("--profile", "tm-da1p1r1", "--unit", "3", "--tripped", "--stuck")
    driver = module_at("tm-da1p1r1", address, deadline_s=10.0)
    driver.connect()
    with pytest.raises(errors.WatchdogTripped):
        driver.check_trip()
    driver.open()
    driver.write_volts(0, 4.0)
    assert driver.read_volts(0) == 0.0
    _, silent = started("--profile", "adam-4021", "--unit", "3", "--ascii")
    with pytest.raises(errors.NoReply, match="speaking ASCII"):
        module_at("adam-4021", silent, deadline_s=0.3).open()


def test_a_module_with_a_serial_line_can_be_tried_over_tcp(started: Any, module_at: Any) -> None:
    _, address = started("--profile", "ato-4ch", "--unit", "3", "--tcp-port", "0")
    driver = module_at("ato-4ch", address, deadline_s=10.0)
    driver.open()
    driver.write_volts(0, 3.0)
    assert driver.read_volts(0) == pytest.approx(3.0, abs=0.002)


@pytest.mark.parametrize("options", [
    ("--profile", "ato-4ch", "--tcp-port", "0", "--symlink", "x"),
    ("--profile", "none"), ("--profile", "ato-4ch", "--unit", "0"), (), ("--profile", "ato-4ch", "--tripped"),
    ("--profile", "iologik-e1241", "--ascii"),
])  # fmt: skip
def test_wrong_options_are_refused(options: tuple[str, ...]) -> None:
    refused = subprocess.run([*COMMANDS["module"], *options], capture_output=True, text=True, timeout=60)
    assert refused.returncode == 2
    assert "error: " in refused.stderr


def test_faults_can_be_asked_for(started: Any, master_at: Any) -> None:
    options = ("--profile", "ato-4ch", "--unit", "3", "--fault", "silent", "--fault-after", "1", "--fault-count", "1")
    _, address = started(*options)
    master = master_at(address, deadline_s=2.0)
    assert master.read(Table.HOLDING_REGISTERS, 0) == [0]
    with pytest.raises(errors.NoReply):
        master.read(Table.HOLDING_REGISTERS, 0)
    assert master.read(Table.HOLDING_REGISTERS, 0) == [0]


def test_with_its_parent_it_ends_when_the_pipe_is_closed(started: Any) -> None:
    process, _ = started("--profile", "ato-4ch", "--with-parent")
    process.stdin.close()
    assert process.wait(30) == 0


def _simulated(profile: str) -> Any:
    module = ModuleSettings.model_validate({"profile": profile, "link": {"kind": "simulated"}, "deadline_s": 5.0})
    return build(ReplaySettings(kind="replay", paths=(Path("unused"),)), module, LampSettings()).lamp


def _children() -> set[int]:
    """Simulators that this process has started and not yet reaped."""
    found = set()
    for entry in Path("/proc").iterdir():
        with contextlib.suppress(OSError, ValueError):
            pid, parent = int(entry.name), int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            if parent == os.getpid() and b"firmware_bridge.simulators.module" in (entry / "cmdline").read_bytes():
                found.add(pid)
    return found


@pytest.mark.parametrize("profile", PROFILES)
def test_a_simulated_link_is_a_real_port_to_a_process(profile: str, descriptors: Any) -> None:
    lamp = _simulated(profile)
    assert lamp.simulated
    before = descriptors()
    lamp.open()
    assert lamp.set_volts(4.0) == pytest.approx(4.0, abs=0.005)
    assert len(_children()) == 1
    lamp.close()
    assert not _children()
    assert descriptors() == before


def test_a_simulator_that_was_killed_is_started_again() -> None:
    lamp = _simulated("ato-4ch")
    lamp.open()
    lamp.set_volts(4.0)
    (pid,) = _children()
    os.kill(pid, signal.SIGKILL)
    os.waitid(os.P_PID, pid, os.WEXITED | os.WNOWAIT)
    with pytest.raises(errors.DeviceGone):
        lamp.set_volts(4.0)
    lamp.close()
    lamp.open()
    assert lamp.set_volts(4.0) == pytest.approx(4.0)
    lamp.close()
    assert not _children()


def test_it_does_not_outlive_a_parent_that_was_killed(wait_until: Any) -> None:
    program = textwrap.dedent("""
        import sys
        from firmware_bridge.links.simulated import open_simulated
        from firmware_bridge.wire.profiles import PROFILES
        port = open_simulated("module", PROFILES["ato-4ch"], 1)
        print(port.name, flush=True)
        sys.stdin.read()
    """)
    parent = subprocess.Popen([sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    terminal = parent.stdout.readline().strip()
    assert Path(terminal).exists()
    parent.kill()
    parent.communicate(timeout=30)
    wait_until(lambda: not _serving(terminal), "the simulator ended with its parent")


def _serving(terminal: str) -> list[str]:
    """Simulators that hold this pseudo-terminal open."""
    holders = []
    for entry in Path("/proc").iterdir():
        with contextlib.suppress(OSError):
            if b"firmware_bridge.simulators.module" in (entry / "cmdline").read_bytes():
                holders += [entry.name for fd in (entry / "fd").iterdir() if os.readlink(fd) == terminal]
    return holders


def test_a_simulator_that_cannot_start_is_a_module_that_is_gone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", "/bin/false")
    with pytest.raises(errors.DeviceGone, match="did not start"):
        _simulated("ato-4ch").open()
    assert not _children()
