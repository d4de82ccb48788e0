"""What the registers show next: counts, sequence, and nothing of an old result beside a fault."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from inspector.faults import Fault
from inspector.model import Defect, Frame, FrameResult, Reason, Snapshot, State, Unpaired, Verdict
from inspector.publish.console import how_to_poll, panel_line
from inspector.snapshots import FRAME_FAULTS, Times, inspected, not_inspected, stopped, taken_back

FRAME = Frame(np.zeros((2, 2), np.uint8), "a/b.png", frame_id=9, exposure_us=1000.0, lamp_v=4.0)
SEED = Defect(1.0, 2.0, 700.0, 3.0, (1.0, 1.0), (2.0, 2.0))
TIMES = Times(now_s=50.0, elapsed_us=800.0, cycle_us=20000.0)
FIRST = Snapshot(state=State.INITIALIZED, recipe_id=3, configuration_hash=5, lamp_set_v=4.0)


def result(verdict: Verdict, reasons: int = 0) -> FrameResult:
    return FrameResult("b.png", verdict, Reason(reasons), ("why",), (SEED,), (Unpaired(1.0, 1.0),))


def test_a_result_shows_its_frame() -> None:
    shown = inspected(FIRST, FRAME, result(Verdict.FAIL, Reason.HEIGHT_LIMIT), TIMES)
    assert shown == replace(
        FIRST,
        state=State.CONTINUOUS_EXECUTION,
        sequence=1,
        panel_id=1,
        acquisition_id=9,
        verdict=Verdict.FAIL,
        reasons=Reason.HEIGHT_LIMIT,
        defects=(SEED,),
        unpaired_count=1,
        result_at_s=50.0,
        elapsed_us=800.0,
        cycle_us=20000.0,
        panels_failed=1,
        lamp_read_v=4.0,
        lamp_ok=True,
        camera_ok=True,
        exposure_us=1000.0,
    )


@pytest.mark.parametrize("reason", FRAME_FAULTS, ids=lambda reason: reason.name)
def test_a_frame_that_cannot_be_judged_has_a_code_and_the_cycle_goes_on(reason: Reason) -> None:
    shown = inspected(FIRST, FRAME, FrameResult("b.png", Verdict.NOT_INSPECTED, reason, ("why",)), TIMES)
    assert (shown.state, shown.fault_code) == (State.CONTINUOUS_EXECUTION, FRAME_FAULTS[reason])
    assert inspected(shown, FRAME, result(Verdict.PASS), TIMES).fault_code == 0


@pytest.mark.parametrize("fault", list(Fault)[1:], ids=lambda fault: fault.name)
def test_a_fault_shows_nothing_of_the_result_before_it(fault: Fault) -> None:
    before = inspected(FIRST, FRAME, result(Verdict.FAIL), TIMES)
    shown = not_inspected(before, fault, Times(60.0, 0.0, 7.0))
    assert (shown.verdict, shown.fault_code) == (Verdict.NOT_INSPECTED, fault)
    assert shown.state is (State.INITIALIZED if fault is Fault.LAMP_WARMING_UP else State.ERROR)
    assert (shown.sequence, shown.panels_failed, shown.panels_not_inspected) == (2, 1, 1)
    assert (shown.defects, shown.unpaired_count, shown.lamp_read_v, shown.exposure_us) == ((), 0, 0.0, 0.0)
    assert shown.reasons
    assert (shown.recipe_id, shown.configuration_hash, shown.result_at_s) == (3, 5, 60.0)


@given(st.lists(st.one_of(st.sampled_from(list(Verdict)), st.sampled_from(list(Fault)[1:]))))
def test_every_cycle_is_one_result(cycles: list[Verdict | Fault]) -> None:
    shown = FIRST
    for number, cycle in enumerate(cycles, 1):
        if isinstance(cycle, Fault):
            shown = not_inspected(shown, cycle, TIMES)
        else:
            shown = inspected(shown, FRAME, FrameResult("b.png", cycle), TIMES)
        assert shown.sequence == number
        assert not (shown.state is State.ERROR and shown.verdict is not Verdict.NOT_INSPECTED)
    counted = shown.panels_passed + shown.panels_failed + shown.panels_not_inspected
    assert counted == len(cycles)


def test_by_other_settings_the_last_result_is_nobodys_and_one_not_inspected_keeps_its_reasons() -> None:
    panel = replace(inspected(FIRST, FRAME, result(Verdict.FAIL, Reason.HEIGHT_LIMIT), TIMES), panel_frames=3)
    shown = taken_back(panel)
    assert (shown.verdict, shown.reasons, shown.defects, shown.unpaired_count) == (Verdict.NOT_INSPECTED, 0, (), 0)
    assert (shown.sequence, shown.panels_failed, shown.panel_frames) == (1, 1, 1)
    failed = taken_back(not_inspected(panel, Fault.CAMERA_GONE, TIMES))
    assert (failed.verdict, failed.reasons) == (Verdict.NOT_INSPECTED, Reason.DEVICE_FAULT)
    assert failed.fault_code == Fault.CAMERA_GONE


def test_a_stopped_station_stands_behind_nothing() -> None:
    shown = stopped(inspected(FIRST, FRAME, result(Verdict.PASS), TIMES))
    assert (shown.state, shown.verdict, shown.defects) == (State.HALTED, Verdict.NOT_INSPECTED, ())
    assert not shown.lamp_ok
    assert shown.sequence == 1


def test_a_panel_is_one_plain_line() -> None:
    shown = inspected(FIRST, FRAME, result(Verdict.FAIL), TIMES)
    line = panel_line(replace(shown, defects=(SEED,) * 9), "b.png", ("too high",))
    assert line.startswith("#1 ")
    for part in ("FAIL", "9 seeds: 700 700", "... um", "0.80 ms", "b.png", "too high"):
        assert part in line
    assert "\n" not in line
    failed = panel_line(not_inspected(shown, Fault.CAMERA_GONE, TIMES), "", ())
    assert failed.split()[1:3] == ["\x1b[33mNOT_INSPECTED\x1b[0m", "CAMERA_GONE:"]


@pytest.mark.parametrize(("host", "reached"), [("0.0.0.0", "127.0.0.1"), ("10.0.0.5", "10.0.0.5")])
def test_how_to_poll_is_a_command_for_this_station(host: str, reached: str) -> None:
    assert how_to_poll(host, 5020).splitlines()[1].split()[-3:] == ["-p", "5020", reached]
