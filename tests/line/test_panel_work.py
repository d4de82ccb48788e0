"""Panels at work beside the cycle: the input that says when one is in view, marks in their order, time that passes."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from firmware_bridge.errors import BridgeError, NoReply
from inspector.handshake import Order
from inspector.handshake_table import Action
from inspector.model import Frame, FrameResult, PanelFrames, PanelResult, Snapshot, Verdict
from inspector.panel_settings import PanelSettings
from inspector.service.cycle import Turn
from inspector.service.panel_work import PanelWork

TRAVEL = {"by": {"kind": "pitch", "mm_per_frame": 10.0}}
BY_INPUT = {"kind": "digital_input", "channel": 3, "active": "off", "debounce_s": 0.1, "poll_s": 0.05}


class Line:
    """A line with an input, on or off or failing, and a clock."""

    def __init__(self, frames: dict[str, Any]) -> None:
        self.now_s, self.input, self.asked, self.frame_id = 0.0, True, [], 0
        settings = PanelSettings.model_validate_json(json.dumps({"frames": frames, "travel": TRAVEL, "timeout_s": 9.0}))
        station: Any = type("Station", (), {"panel": settings})
        self.work = PanelWork(station, self._judge, self._read, 0, lambda: self.now_s)

    def _judge(self, gathered: PanelFrames) -> PanelResult:
        verdict = Verdict.NOT_INSPECTED if gathered.missing else Verdict.PASS
        travels = tuple(frame.travel_mm for frame in gathered.frames)
        return PanelResult(verdict, reasons_text=gathered.missing, panel_id=gathered.panel_id, travels_mm=travels)

    def _read(self, channel: int) -> bool:
        self.asked.append(channel)
        if isinstance(self.input, BridgeError):
            raise self.input
        return bool(self.input)

    def wait(self, wait_s: float) -> None:
        self.now_s += wait_s
        self.work.look(0)

    def frame(self) -> None:
        """A cycle: the exposure, a look at the input, the inspection where the frame is of a panel."""
        self.frame_id += 1
        self.work.glance(0)
        frame = Frame(np.zeros((1, 1), np.uint8), "f", self.frame_id, taken_s=self.now_s)
        result = FrameResult("f", Verdict.PASS) if self.work.wants_frame() else None
        self.work.took(Turn(Snapshot(), frame_id=self.frame_id, frame=frame, result=result), 0, 0)

    def shown(self) -> list[tuple[Verdict, int]]:
        return [(panel.verdict, len(panel.travels_mm)) for panel in self.work.results()]


def test_an_input_says_when_a_panel_is_in_view() -> None:
    line = Line(BY_INPUT)
    line.wait(0.0)
    line.frame()
    line.input = False
    line.frame()
    line.frame()
    line.input = True
    line.wait(0.05)
    assert line.shown() == []
    assert line.work.under_way
    line.wait(0.05)
    line.wait(0.05)
    assert line.shown() == [(Verdict.PASS, 2)]
    assert set(line.asked) == {3}


def test_the_input_is_read_no_more_often_than_it_says_while_the_station_waits() -> None:
    line = Line(BY_INPUT)
    for _ in range(10):
        line.wait(0.02)
    assert len(line.asked) == 4


def test_an_input_that_cannot_be_read_keeps_the_panel_in_view_from_passing() -> None:
    line = Line(BY_INPUT)
    line.wait(0.0)
    line.input = False
    line.frame()
    line.input = NoReply("module", "silent")
    line.frame()
    line.input = True
    for _ in range(3):
        line.wait(0.06)
    (panel,) = line.work.results()
    assert panel.verdict is Verdict.NOT_INSPECTED
    assert "could not be read" in panel.reasons_text[0]


def mark(action: Action, at_s: float, panel_id: int = 0) -> Order:
    return Order(action, at_s, panel_id)


@pytest.mark.parametrize(("trigger_s", "frames"), [(1.5, 1), (2.5, 0)])
def test_an_end_after_a_trigger_that_waits_comes_after_its_frame(trigger_s: float, frames: int) -> None:
    line = Line({"kind": "plc"})
    line.work.mark([mark(Action.START_PANEL, 1.0, 7), mark(Action.END_PANEL, 2.0, 7)], trigger_s, 0)
    line.frame()
    line.work.mark([], float("inf"), 0)
    (panel,) = line.work.results()
    assert (panel.panel_id, len(panel.travels_mm)) == (7, frames)


def test_a_panel_that_was_waited_for_long_enough_is_ended() -> None:
    line = Line({"kind": "plc"})
    line.work.mark([mark(Action.START_PANEL, 0.0)], float("inf"), 0)
    line.wait(8.9)
    assert line.shown() == []
    line.wait(0.2)
    assert line.shown() == [(Verdict.NOT_INSPECTED, 0)]


def test_a_trigger_missed_after_a_panels_end_and_the_next_ones_start_is_the_next_ones() -> None:
    line = Line({"kind": "plc"})
    line.work.mark([mark(Action.START_PANEL, 0.0, 7)], float("inf"), 0)
    line.frame()
    # While the cycle ran: the end, the start, and a TRIGGER that was missed.
    line.work.look(1)
    line.work.mark([mark(Action.END_PANEL, 1.0, 7), mark(Action.START_PANEL, 1.0, 8)], float("inf"), 0)
    line.work.look(1)
    line.work.mark([Order(Action.END_PANEL, 2.0, 8, missed=1)], float("inf"), 0)
    assert line.work.results()[-1].verdict is Verdict.NOT_INSPECTED


def test_a_panel_whose_end_may_have_been_refused_does_not_pass() -> None:
    line = Line({"kind": "plc"})
    line.work.mark([mark(Action.START_PANEL, 0.0, 6), mark(Action.END_PANEL, 0.0, 6)], float("inf"), 0)
    line.work.mark([replace(mark(Action.START_PANEL, 0.0, 7), mark_refused_after=True)], float("inf"), 0)
    line.frame()
    line.work.mark([mark(Action.END_PANEL, 1.0, 7), mark(Action.START_PANEL, 1.0, 8)], float("inf"), 0)
    line.frame()
    line.work.mark([mark(Action.END_PANEL, 2.0, 8)], float("inf"), 0)
    assert [panel.verdict for panel in line.work.results()] == [Verdict.PASS, Verdict.NOT_INSPECTED, Verdict.PASS]


def test_nobody_knows_on_which_side_of_the_marks_another_trigger_was_missed() -> None:
    line = Line({"kind": "plc"})
    line.work.mark([mark(Action.START_PANEL, 0.0, 7)], float("inf"), 0)
    line.frame()
    line.work.mark([mark(Action.END_PANEL, 1.0, 7), mark(Action.START_PANEL, 1.0, 8)], float("inf"), 1)
    line.work.mark([mark(Action.END_PANEL, 2.0, 8)], float("inf"), 1)
    assert [panel.verdict for panel in line.work.results()] == [Verdict.NOT_INSPECTED] * 2
