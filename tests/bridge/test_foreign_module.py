"""The drivers against slaves on libmodbus and pymodbus, behind pseudo-terminals: nothing of ours at the other end."""

from __future__ import annotations

import contextlib
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from firmware_bridge import errors
from firmware_bridge.drivers.lamp import FostecLamp
from firmware_bridge.drivers.modbus_module import ModbusModule
from firmware_bridge.factory import build_module
from firmware_bridge.links.ports import Port
from firmware_bridge.settings import LampSettings
from firmware_bridge.wire.module_setup import AS_SET_UP, held
from firmware_bridge.wire.profiles import PROFILES

UNIT = 3
SCRIPT = Path(__file__).parents[1] / "peers" / "module_slave.py"
SERIAL = [name for name, profile in PROFILES.items() if profile.has_serial]


@pytest.fixture
def foreign(peer: Any, compiled_peer: Any, wait_until: Any, tmp_path: Path) -> Iterator[Callable[..., str]]:
    """``foreign(profile, slave="libmodbus")``: the port that leads to a slave on libmodbus, or on pymodbus, with the
    profile's points laid out."""
    socat = peer("socat", "socat")
    programs = {"libmodbus": lambda: [compiled_peer("module_slave")], "pymodbus": lambda: [sys.executable, str(SCRIPT)]}
    with contextlib.ExitStack() as stack:

        def start(profile: str, slave: str = "libmodbus") -> str:
            near, far = tmp_path / f"{slave}-near", tmp_path / f"{slave}-far"
            ends = [f"pty,raw,echo=0,link={end}" for end in (near, far)]
            stack.callback(_end, subprocess.Popen([socat, *ends]))
            wait_until(lambda: near.exists() and far.exists(), "socat made its pair of terminals")
            command = [*programs[slave](), str(far), str(UNIT), *_layout(profile)]
            process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
            stack.callback(_end, process)
            assert process.stdout is not None
            assert process.stdout.readline() == "ready\n"
            return str(near)

        yield start


def _end(process: subprocess.Popen[Any]) -> None:
    process.kill()
    process.communicate(timeout=30)


def _layout(name: str) -> list[str]:
    """What the slave must hold and copy so that it stands for a module of the profile."""
    profile = PROFILES[name]
    held = [f"{setup.point.plus(c).address}={setup.value}" for setup in profile.setup if not setup.writable
            for c in range(profile.channels)]  # fmt: skip
    if profile.read_back == profile.output:
        return held
    return held + [f"{profile.output_of(c).address}:{profile.read_back_of(c).address}" for c in range(profile.channels)]


@pytest.fixture
def traced(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, bytes]]:
    """Every byte that crosses a port from now on, as (direction, bytes), whatever pieces it comes in."""
    trace: list[tuple[str, bytes]] = []
    read, write = Port.read, Port.write

    def note(direction: str, data: bytes) -> None:
        if data and trace and trace[-1][0] == direction:
            trace[-1] = (direction, trace[-1][1] + data)
        elif data:
            trace.append((direction, data))

    def noted_read(port: Port, timeout_s: float) -> bytes:
        data = read(port, timeout_s)
        note("in", data)
        return data

    def noted_write(port: Port, data: bytes, timeout_s: float) -> None:
        note("out", data)
        write(port, data, timeout_s)

    monkeypatch.setattr(Port, "read", noted_read)
    monkeypatch.setattr(Port, "write", noted_write)
    return trace


@pytest.mark.parametrize("profile", SERIAL)
def test_one_station_leaves_the_same_trace_on_every_slave(
    profile: str, foreign: Any, serve: Any, settings_for: Any, traced: Any
) -> None:
    """The same settings and the same work against libmodbus, pymodbus and our simulator: the same bytes, both ways."""
    server = serve(profile)
    for wanted in held(PROFILES[profile], range(PROFILES[profile].channels), AS_SET_UP):
        if wanted.writable:
            server.module.set_value(wanted.point, 0)  # foreign slaves begin with zeros: set up as by another way
    traces = []
    for port in (foreign(profile, "libmodbus"), foreign(profile, "pymodbus"), server.address):
        traced.clear()
        levels = _work(build_module(settings_for(profile, port, deadline_s=10.0, **SAFETY.get(profile, {}))))
        traces.append((levels, list(traced)))
    assert len(traces[0][1]) >= 20
    assert traces[0] == traces[2], "libmodbus"
    assert traces[1] == traces[2], "pymodbus"


SAFETY = {
    "tm-da1p1r1": {"safe_v": 1.0, "power_on_v": 0.5, "watchdog_s": 10.0},
    "adam-4021": {"power_on_v": 0.5},
}
"""What the station asks of modules that can do it."""


def _work(module: ModbusModule) -> list[float | tuple[bool, ...]]:
    """A station's day with its lamp and its digital points; what was read back."""
    lamp = FostecLamp(module, LampSettings(curve=((0, 0), (50, 2.0), (100, 5.0))))
    lamp.open()
    seen = [lamp.set_volts(volts) for volts in (0.0, 4.0, 3.3, 5.0)]
    seen.append(lamp.set_percent(75.0))
    lamp.keep_alive()
    with pytest.raises(errors.OutOfRange):
        lamp.set_volts(5.1)
    seen += [module.read_inputs(), module.read_outputs()]
    for on in (True, False):
        for channel in range(len(module.read_outputs())):
            module.write_output(channel, on)
        seen.append(module.read_outputs())
    lamp.close()
    lamp.open()
    seen.append(lamp.read_volts())
    lamp.close()
    return seen


def test_a_lamp_on_a_foreign_module(foreign: Any, module_at: Any) -> None:
    lamp = FostecLamp(module_at("ato-4ch", foreign("ato-4ch"), deadline_s=10.0), LampSettings())
    lamp.open()
    assert lamp.set_percent(80.0) == pytest.approx(4.0, abs=0.002)
    lamp.close()
    lamp.open()
    assert lamp.read_volts() == 0.0
    lamp.close()


def test_refusals_and_silence_of_a_foreign_module(foreign: Any, settings_for: Any) -> None:
    from firmware_bridge.factory import build_master
    from firmware_bridge.wire.modbus import Table

    port = foreign("ato-4ch")
    master = build_master(settings_for("ato-4ch", port, deadline_s=10.0))
    master.open()
    with pytest.raises(errors.Refused, match="exception 2, illegal data address"):
        master.read(Table.HOLDING_REGISTERS, 5000)
    assert master.read(Table.COILS, 0, 5) == [0, 0, 0, 0, 0]
    master.close()
    other = build_master(settings_for("ato-4ch", port, deadline_s=0.3, unit=9))
    other.open()
    with pytest.raises(errors.NoReply):
        other.read(Table.HOLDING_REGISTERS, 0)
    other.close()


def test_a_foreign_master_drives_our_simulator(peer: Any, serve: Any) -> None:
    server = serve("ato-4ch")
    line = [peer("mbpoll", "mbpoll"), "-m", "rtu", "-b", "9600", "-P", "none", "-a", str(UNIT), "-0", "-1", "-o", "10"]
    subprocess.run([*line, "-r", "1", server.address, "2048"], check=True, capture_output=True, timeout=60)
    assert server.module.output_v(1) == pytest.approx(2048 * 5 / 4095)
    shown = subprocess.run([*line, "-r", "0", "-c", "2", server.address], capture_output=True, text=True, timeout=60)
    assert "[0]: \t0\n[1]: \t2048" in shown.stdout
    refused = subprocess.run([*line, "-r", "1", server.address, "5000"], capture_output=True, text=True, timeout=60)
    assert refused.returncode != 0
    assert "Illegal data value" in refused.stderr
