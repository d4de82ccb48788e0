"""The drivers against a slave on libmodbus, behind a pair of pseudo-terminals: nothing of ours at the other end."""

from __future__ import annotations

import contextlib
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from firmware_bridge import errors
from firmware_bridge.drivers.lamp import FostecLamp
from firmware_bridge.settings import LampSettings
from firmware_bridge.wire.profiles import PROFILES

UNIT = 3
SERIAL = [name for name, profile in PROFILES.items() if profile.has_serial]


@pytest.fixture
def foreign(peer: Any, compiled_peer: Any, wait_until: Any, tmp_path: Path) -> Iterator[Callable[..., str]]:
    """``foreign(profile)``: the port that leads to a libmodbus slave with the profile's points laid out."""
    socat, slave = peer("socat", "socat"), compiled_peer("module_slave")
    with contextlib.ExitStack() as stack:

        def start(profile: str) -> str:
            near, far = tmp_path / "near", tmp_path / "far"
            ends = [f"pty,raw,echo=0,link={end}" for end in (near, far)]
            stack.callback(_end, subprocess.Popen([socat, *ends]))
            wait_until(lambda: near.exists() and far.exists(), "socat made its pair of terminals")
            process = subprocess.Popen(
                [slave, str(far), str(UNIT), *_layout(profile)], stdout=subprocess.PIPE, text=True
            )
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


@pytest.mark.parametrize("profile", SERIAL)
def test_levels_are_the_same_as_on_our_simulator(profile: str, foreign: Any, serve: Any, module_at: Any) -> None:
    traces = [_trace(module_at(profile, port, deadline_s=10.0)) for port in (foreign(profile), serve(profile).address)]
    assert traces[0] == traces[1]
    assert traces[0][1] == pytest.approx(4.0, abs=0.005)


def _trace(driver: Any) -> list[float]:
    driver.open()
    levels = []
    for volts in (0.0, 4.0, 3.3, 5.0, 0.0):
        driver.write_volts(0, volts)
        levels.append(driver.read_volts(0))
    driver.check_trip()
    driver.close()
    return levels


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
