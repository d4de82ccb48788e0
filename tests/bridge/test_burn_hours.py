"""The lamp's burning hours: counted while it is lit, kept over restarts, and never in the lamp's way."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from memory_line import Clock, MemoryLine

from firmware_bridge.drivers.lamp import FostecLamp
from firmware_bridge.drivers.modbus_module import ModbusModule
from firmware_bridge.links.modbus_master import ModbusMaster
from firmware_bridge.settings import LampSettings
from firmware_bridge.wire.lamp_burn import LIT_V, Burn, at_level, burnt
from firmware_bridge.wire.profiles import PROFILES

HOUR_S = 3600.0


def lamp_on(clock: Clock, file: Path | None) -> FostecLamp:
    """An open lamp on a module in memory, its hours kept in ``file``."""
    line = MemoryLine(PROFILES["ato-4ch"], 1, clock)
    master = ModbusMaster("module", 1, line.open_port, rtu=True, deadline_s=0.5, clock=clock)
    lamp = FostecLamp(ModbusModule(PROFILES["ato-4ch"], master), LampSettings(hours_file=file), clock=clock)
    lamp.open()
    return lamp


@given(st.lists(st.tuples(st.floats(0, 100), st.floats(0, 5))))
def test_only_time_that_was_lit_counts(steps: list[tuple[float, float]]) -> None:
    account, now_s, lit_s, lit = Burn(10.0, 0.0), 0.0, 0.0, False
    for pause_s, level_v in steps:
        now_s += pause_s
        lit_s += pause_s if lit else 0.0
        account, lit = at_level(account, now_s, level_v), level_v > LIT_V
    assert burnt(account, now_s) == pytest.approx(10.0 + lit_s / HOUR_S)


def test_hours_are_kept_over_restarts(tmp_path: Path) -> None:
    clock, file = Clock(), tmp_path / "hours.json"
    for life in (1, 2, 3):
        lamp = lamp_on(clock, file)
        lamp.set_volts(4.0)
        clock.now_s += 2 * HOUR_S
        assert lamp.burnt_hours() == pytest.approx(2.0 * life, abs=1e-3)
        lamp.close()
        clock.now_s += 5 * HOUR_S
        assert lamp.burnt_hours() == pytest.approx(2.0 * life, abs=1e-3), "dark since it was closed"
    assert json.loads(file.read_text())["burnt_hours"] == pytest.approx(6.0, abs=1e-3)
    assert [path.name for path in tmp_path.iterdir()] == ["hours.json"]


def test_a_power_cut_costs_minutes(tmp_path: Path) -> None:
    clock, file = Clock(), tmp_path / "hours.json"
    lamp = lamp_on(clock, file)
    lamp.set_volts(4.0)
    for _ in range(600):
        clock.now_s += 60
        lamp.keep_alive()
    assert lamp_on(clock, file).burnt_hours() == pytest.approx(10.0, abs=0.11)


def test_without_a_file_hours_are_of_this_run() -> None:
    clock = Clock()
    lamp = lamp_on(clock, None)
    lamp.set_volts(4.0)
    clock.now_s += HOUR_S
    assert lamp.burnt_hours() == pytest.approx(1.0, abs=1e-3)
    lamp.close()


DAMAGED = ["", "{", "7", '{"burnt_hours": "8"}', '{"burnt_hours": -1}', '{"burnt_hours": NaN}', '{"hours": 1}']


@pytest.mark.parametrize("text", DAMAGED)
def test_a_damaged_file_is_put_aside_and_said(text: str, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    file = tmp_path / "hours.json"
    file.write_text(text)
    lamp = lamp_on(Clock(), file)
    assert lamp.set_volts(4.0) == pytest.approx(4.0)
    assert lamp.burnt_hours() == 0.0
    assert (tmp_path / "hours.json.damaged").read_text() == text
    assert "hours begin at 0, it is kept as hours.json.damaged" in caplog.text


def test_a_file_that_cannot_be_written_is_said_once_and_no_harm(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    clock = Clock()
    lamp = lamp_on(clock, tmp_path / "missing" / "hours.json")
    lamp.set_volts(4.0)
    with caplog.at_level(logging.WARNING):
        for _ in range(5):
            clock.now_s += HOUR_S
            lamp.keep_alive()
        lamp.close()
    assert lamp.burnt_hours() == pytest.approx(5.0, abs=1e-3)
    assert caplog.text.count("cannot be written") == 1


def test_a_lamp_of_another_service_is_counted_from_its_first_reading(tmp_path: Path) -> None:
    clock: Any = Clock()
    line = MemoryLine(PROFILES["ato-4ch"], 1, clock)
    line.module.set_value(PROFILES["ato-4ch"].output, 3000)
    master = ModbusMaster("module", 1, line.open_port, rtu=True, deadline_s=0.5, clock=clock)
    lamp = FostecLamp(ModbusModule(PROFILES["ato-4ch"], master), LampSettings(), clock=clock)
    lamp.open()
    lamp.keep_alive()
    clock.now_s += HOUR_S
    assert lamp.burnt_hours() == pytest.approx(1.0, abs=1e-3)
