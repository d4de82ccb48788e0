"""The PLC program that tends the booth: acts on what is valid, fresh and sure, once, and then lets it work."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from inspector.lab.booth import Deed
from inspector.lab.plc_client import READS, STATISTICS
from inspector.lab.plc_program import DEEDS, VALID, PlcProgram
from inspector.line_statistics import Action
from inspector.publish.registers import REGISTERS
from inspector.publish.statistics_registers import StatisticsStatus
from inspector.publish.wire_fields import TYPES


def registers(sequence: int, action: int = 0, **other: Any) -> dict[str, Any]:
    shown = {
        "statistics_sequence": sequence,
        "statistics_sequence_end": sequence,
        "statistics_status": VALID,
        "statistics_age_ms": 10,
        "action": action,
        "confidence": 0.7,
    }
    return shown | other


def test_it_does_what_is_advised() -> None:
    assert PlcProgram().scan(registers(1, Action.CHECK_FILTER)) == ((Deed.CHANGE_FILTER,), False)
    assert PlcProgram().scan(registers(1, Action.HOLD)) == ((Deed.CHANGE_FILTER, Deed.CLEAN_BOOTH), False)


@pytest.mark.parametrize("action", sorted({0, 140, *Action} - set(DEEDS)))
def test_what_is_for_people_orders_nothing(action: int) -> None:
    assert PlcProgram().scan(registers(1, action)) == ((), False)


@pytest.mark.parametrize(
    "other",
    [
        {"statistics_status": 0xFFFF & ~VALID},
        {"statistics_age_ms": 60_001},
        {"statistics_age_ms": None},
        {"confidence": 0.49},
        {"confidence": None},
        {"statistics_sequence_end": 0},
    ],
)
def test_it_does_not_act_on_what_is_invalid_old_unsure_or_torn(other: dict[str, Any]) -> None:
    assert PlcProgram().scan(registers(1, Action.HOLD, **other)) == ((), False)


def test_a_sequence_is_acted_upon_once_and_the_deed_is_let_work() -> None:
    program = PlcProgram(settle_panels=5)
    assert program.scan(registers(65534, Action.CHECK_FILTER))[0]
    for sequence in (65534, 65535, 0, 1, 2):
        assert program.scan(registers(sequence, Action.HOLD)) == ((), False)
    assert program.scan(registers(3, Action.HOLD)) == ((), True), "five panels later, over the wrap"
    assert program.scan(registers(4, Action.CHECK_FILTER))[0], "if it did not help"
    assert [deed for _, deed in program.orders] == [Deed.CHANGE_FILTER] * 2


def test_panels_that_it_did_not_see_count_as_passed() -> None:
    program = PlcProgram(settle_panels=30)
    program.scan(registers(10, Action.CLEAN_BOOTH))
    assert program.scan(registers(60)) == ((), True)


def test_its_registers_and_codes_are_the_integrator_s() -> None:
    rows = {row.name: row for row in REGISTERS}
    for name, (at, form, scale) in READS.items():
        row = rows[name]
        assert (row.address, TYPES[row.type].format, row.scale) == (STATISTICS + at, form, scale)
    assert VALID == StatisticsStatus.VALID
    assert {Action(code).name for code in DEEDS} == {"HOLD", "CHECK_FILTER", "CLEAN_BOOTH", "CHECK_FIXTURE"}
    source = (Path(__file__).parents[2] / "inspector" / "lab" / "plc_program.py").read_text()
    assert "inspector.judge" not in source
    assert "inspector.publish" not in source
