"""Frames gathered into panels: by count, by the PLC, by an input, by length; nothing is lost and nothing shifts."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from inspector.acquire.panels import NO_FRAME, READ_OUT_S, Panels
from inspector.model import Frame, FrameResult, PanelFrames, Verdict
from inspector.panel_settings import PanelSettings

PITCH = {"by": {"kind": "pitch", "mm_per_frame": 10.0}}
SPEED = {"by": {"kind": "line_speed", "mm_per_s": 100.0}}


class Line:
    """A line whose triggers bring frames, are missed or fail; the camera numbers the frames it took."""

    def __init__(self, frames: dict[str, Any], travel: dict[str, Any] = PITCH, **more: Any) -> None:
        settings = {"frames": frames, "travel": travel, "timeout_s": 5.0} | more
        self.panels = Panels(PanelSettings.model_validate_json(json.dumps(settings)))
        self.done: list[PanelFrames] = []
        self.now_s, self.missed, self.frame_id = 0.0, 0, 0

    def take(self, wanted: bool = True, panel_id: int | None = None) -> None:
        self.now_s += 0.1
        self.frame_id += 1
        frame = Frame(np.zeros((1, 1), np.uint8), f"frame {self.frame_id}", self.frame_id, taken_s=self.now_s)
        result = FrameResult(frame.name, Verdict.PASS) if wanted and self.panels.wants_frame else None
        self.done += self.panels.took(frame, result, self.missed, self.now_s, panel_id)

    def miss(self) -> None:
        self.now_s += 0.1
        self.missed += 1

    def fail(self, panel_id: int | None = None) -> None:
        self.now_s += 0.1
        self.done += self.panels.failed("CAMERA_TIMEOUT", self.missed, self.now_s, panel_id)

    def input(self, on: bool, after_s: float = 0.0) -> None:
        self.now_s += after_s
        self.done += self.panels.in_view(on, self.now_s, self.missed)

    @property
    def shown(self) -> list[tuple[list[str], list[float], bool]]:
        """Of each panel that ended: its frames, where they are, and whether it was seen whole."""
        return [
            ([f.result.frame for f in p.frames], [round(f.travel_mm, 6) for f in p.frames], not p.missing)
            for p in self.done
        ]


COUNT = {"kind": "count", "count": 3}


def test_so_many_frames_are_a_panel() -> None:
    line = Line(COUNT)
    for _ in range(7):
        line.take()
    assert line.shown == [
        (["frame 1", "frame 2", "frame 3"], [0.0, 10.0, 20.0], True),
        (["frame 4", "frame 5", "frame 6"], [0.0, 10.0, 20.0], True),
    ]
    assert line.panels.frames_so_far == 1


@given(st.lists(st.sampled_from(["take", "miss", "fail"]), max_size=30), st.integers(1, 4))
def test_triggers_without_a_frame_shift_no_panel(triggers: list[str], count: int) -> None:
    """From the first trigger that the station notices on, each panel has the frames of its own triggers."""
    line = Line({"kind": "count", "count": count})
    line.take()
    for trigger in triggers:
        getattr(line, trigger)()
    line.take()
    kinds = ["take", *triggers, "take"]
    taken = iter(range(1, 100))
    names = [f"frame {next(taken)}" if kind == "take" else None for kind in kinds]
    places = [names[i : i + count] for i in range(0, len(names), count)]
    whole = [(p, [10.0 * i for i in range(count)], True) for p in places if len(p) == count and None not in p]
    parts = [p for p in places if len(p) == count and None in p and any(p)]
    assert [shown for shown in line.shown if shown[2]] == whole
    assert [frames for frames, _, seen_whole in line.shown if not seen_whole and frames] == [
        [name for name in part if name] for part in parts
    ]
    for frames, travels, _ in line.shown:
        assert travels == [10.0 * (names.index(name) % count) for name in frames]


@given(st.lists(st.sampled_from(["take", "miss", "fail"]), max_size=30))
def test_every_frame_is_in_one_panel_or_in_the_one_under_way(triggers: list[str]) -> None:
    line = Line(COUNT)
    for trigger in triggers:
        getattr(line, trigger)()
    frames = [name for names, _, _ in line.shown for name in names]
    assert len(set(frames)) == len(frames)
    assert len(frames) + line.panels.frames_so_far == line.frame_id


def test_frames_that_the_camera_took_and_nobody_got_are_missed_by_their_numbers() -> None:
    line = Line(COUNT)
    line.take()
    line.frame_id += 1
    line.take()
    line.take()
    ((frames, travels, whole),) = line.shown
    assert (frames, travels, whole) == (["frame 1", "frame 3"], [0.0, 20.0], False)
    assert line.done[0].missing == (NO_FRAME,)


def test_a_camera_that_counts_anew_misses_nothing_by_that() -> None:
    line = Line(COUNT)
    for number in (1000, 0, 1):
        line.frame_id = number
        line.take()
    assert line.shown[0][2]


def test_with_the_lines_speed_time_says_how_far_it_moved_and_frames_left_out_are_none_missed() -> None:
    line = Line(COUNT, SPEED)
    line.take()
    line.frame_id += 5
    line.now_s += 0.5
    line.take()
    line.take()
    assert line.shown == [(["frame 1", "frame 7", "frame 8"], [0.0, 60.0, 70.0], True)]


def test_a_frame_whose_time_goes_back_is_told() -> None:
    line = Line(COUNT, SPEED)
    line.take()
    line.now_s -= 60
    line.take()
    line.take()
    assert "lies before that of the one before it" in line.done[0].missing[0]


def test_a_panel_that_gets_no_more_frames_ends_after_its_time_and_the_count_begins_anew() -> None:
    line = Line(COUNT)
    line.take()
    assert line.panels.look(line.now_s + 4.9, 0) == ()
    line.done += line.panels.look(line.now_s + 5.0, 0)
    assert line.shown == [(["frame 1"], [0.0], False)]
    assert "for 5 s" in line.done[0].missing[0]
    for _ in range(3):
        line.take()
    assert line.shown[1][2]
    assert line.panels.look(line.now_s + 100, 0) == ()


def test_the_plc_begins_and_ends_a_panel_and_its_id_comes_back() -> None:
    line = Line({"kind": "plc"})
    line.take()
    line.panels.started(17, line.now_s, line.missed)
    line.take()
    line.take()
    line.done += line.panels.ended(17, line.missed)
    line.take()
    assert line.shown == [(["frame 2", "frame 3"], [0.0, 10.0], True)]
    assert line.done[0].panel_id == 17
    assert not line.panels.wants_frame


def test_a_start_ends_the_panel_before_and_an_end_without_a_start_is_a_result_too() -> None:
    line = Line({"kind": "plc"})
    line.panels.started(17, 0.0, line.missed)
    line.take()
    line.done += line.panels.started(18, line.now_s, line.missed)
    line.take()
    line.done += line.panels.ended(18, line.missed)
    line.done += line.panels.ended(19, line.missed)
    assert [(p.panel_id, len(p.frames), p.missing) for p in line.done] == [
        (17, 1, ()),
        (18, 1, ()),
        (19, 0, ("its end came without its start",)),
    ]


def test_a_panel_begun_whose_end_and_frames_do_not_come_ends_after_its_time() -> None:
    line = Line({"kind": "plc"})
    line.panels.started(17, 0.0, line.missed)
    (left,) = line.panels.look(5.0, 0)
    assert (left.panel_id, left.frames) == (17, ())
    assert left.missing


@pytest.mark.parametrize("trouble", ["miss", "fail"])
@pytest.mark.parametrize(
    "frames", [COUNT, {"kind": "plc"}, {"kind": "digital_input"}, {"kind": "length", "length_mm": 35}]
)
def test_trouble_in_the_middle_of_a_panel_is_never_forgotten(trouble: str, frames: dict[str, Any]) -> None:
    line = Line(frames)
    line.input(False)
    line.panels.started(1, 0.0, line.missed)
    line.input(True)
    line.take()
    getattr(line, trouble)()
    line.take()
    line.take()
    line.done += line.panels.ended(1, line.missed)
    line.input(False)
    line.input(False, after_s=1.0)
    line.take()
    assert line.shown[0][2] is False


def test_an_input_that_is_on_says_that_a_panel_is_in_view() -> None:
    line = Line({"kind": "digital_input", "debounce_s": 0.25})
    line.input(False)
    line.take()
    line.input(True)
    line.take()
    line.input(False)  # bounces
    line.take()
    line.input(True)
    line.take()
    line.input(False)
    line.input(False, after_s=0.2)
    assert line.done == []
    line.input(False, after_s=0.1)
    # What was taken while it was off is not of the panel; the gap shows by where the others are.
    assert line.shown == [(["frame 2", "frame 4"], [0.0, 20.0], True)]


def test_a_panel_in_view_when_the_station_begins_to_look_was_not_seen_whole() -> None:
    line = Line({"kind": "digital_input"})
    line.input(True)
    line.take()
    line.input(False)
    line.input(False, after_s=1.0)
    line.input(True)
    line.take()
    line.input(False)
    line.input(False, after_s=1.0)
    assert [whole for _, _, whole in line.shown] == [False, True]


def test_a_length_ends_a_panel_and_its_next_frame_begins_the_next_one() -> None:
    line = Line({"kind": "length", "length_mm": 25.0})
    for _ in range(7):
        line.take()
    assert line.shown == [
        (["frame 1", "frame 2", "frame 3"], [0.0, 10.0, 20.0], True),
        (["frame 4", "frame 5", "frame 6"], [0.0, 10.0, 20.0], True),
    ]


def test_what_is_interrupted_is_told_and_the_panels_that_follow_begin_where_they_would_have() -> None:
    line = Line(COUNT)
    line.take()
    line.done += line.panels.interrupted("the recipe was changed")
    assert line.done[0].missing == ("the recipe was changed",)
    assert line.panels.interrupted("again") == ()
    before, line.panels = line.panels, Line(COUNT).panels
    line.panels.goes_on(before, same_camera=True)
    for _ in range(5):
        line.take()
    assert line.shown[1:] == [
        (["frame 2", "frame 3"], [10.0, 20.0], False),
        (["frame 4", "frame 5", "frame 6"], [0.0, 10.0, 20.0], True),
    ]


def test_panels_that_are_made_otherwise_begin_anew() -> None:
    before, line = Line(COUNT), Line({"kind": "count", "count": 2})
    before.take()
    line.panels.goes_on(before.panels, same_camera=True)
    line.take()
    line.take()
    assert line.shown[0][2]


@pytest.mark.parametrize("frames", [{"kind": "plc"}, {"kind": "digital_input"}])
@pytest.mark.parametrize("looked", [False, True])
def test_a_trigger_missed_after_a_panels_last_frame_is_that_panels_and_not_the_next_ones(
    frames: dict[str, Any], looked: bool
) -> None:
    line = Line(frames)
    line.input(False)
    for _ in range(2):
        line.panels.started(1, line.now_s, line.missed)
        line.input(True)
        line.take()
        line.take()
        if not line.done:
            line.miss()
        if looked:
            line.panels.look(line.now_s, line.missed)
        line.done += line.panels.ended(1, line.missed)
        line.input(False)
        line.input(False, after_s=1.0)
    assert [(len(frames), whole) for frames, _, whole in line.shown if frames] == [(2, False), (2, True)]
    assert [panel.missing for panel in line.done if panel.frames] == [(NO_FRAME,), ()]


def test_a_start_of_the_plc_ends_no_panel_as_whole_whose_last_trigger_was_missed() -> None:
    line = Line({"kind": "plc"})
    line.panels.started(1, 0.0, line.missed)
    line.take()
    line.miss()
    line.done += line.panels.started(2, line.now_s, line.missed)
    assert line.shown == [(["frame 1"], [0.0], False)]


def test_a_panel_by_length_whose_first_trigger_was_missed_has_not_been_seen_whole() -> None:
    line = Line({"kind": "length", "length_mm": 25.0})
    for _ in range(3):
        line.take()
    line.miss()
    for _ in range(4):
        line.take()
    assert [whole for _, _, whole in line.shown] == [True, False]


@pytest.mark.parametrize(
    ("length_mm", "step_mm", "frames"), [(25.0, 10.0, 3), (30.0, 10.0, 3), (1.1, 0.1, 11), (0.7, 0.1, 7), (5.0, 9.0, 1)]
)
def test_a_length_in_triggers_has_its_verdict_with_the_frame_that_covers_it(
    length_mm: float, step_mm: float, frames: int
) -> None:
    by = {"by": {"kind": "pitch", "mm_per_frame": step_mm}}
    line = Line({"kind": "length", "length_mm": length_mm}, by)
    for _ in range(frames - 1):
        line.take()
    assert line.shown == []
    line.take()
    assert [whole for _, _, whole in line.shown] == [True]
    assert not line.panels.under_way


def test_a_length_in_time_has_its_verdict_when_no_frame_can_be_of_it_any_more() -> None:
    line = Line({"kind": "length", "length_mm": 25.0}, SPEED)
    line.take()
    line.take()
    begun_s = line.now_s - 0.1
    assert line.panels.look(begun_s + 0.25 + READ_OUT_S - 0.001, 0) == ()
    (panel,) = line.panels.look(begun_s + 0.25 + READ_OUT_S + 0.001, 0)
    assert (len(panel.frames), panel.missing) == (2, ())


def test_a_panel_whose_first_frame_failed_has_the_id_that_the_plc_gave_with_it() -> None:
    line = Line(COUNT)
    line.fail(panel_id=5)
    line.take(panel_id=5)
    line.take(panel_id=5)
    assert (line.done[0].panel_id, line.shown[0][2]) == (5, False)


def test_a_panel_has_the_id_that_the_plc_gave_with_its_first_frame() -> None:
    line = Line(COUNT)
    for panel_id in (5, 6, None):
        line.take(panel_id=panel_id)
    assert line.done[0].panel_id == 5
