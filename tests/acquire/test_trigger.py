"""What begins a cycle, what is missed, what is late: over times that the tests choose."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from inspector.acquire.trigger import Calls, Clock, Debounced, Input, Line, Trigger, debounce

LATE_S = 0.05
OFF = Debounced(False, False, 0.0, 0.0)


def levels(state: Debounced, looks: list[tuple[float, bool]], stable_s: float) -> list[bool]:
    """Where the input rose, look by look."""
    rose = []
    for now_s, seen in looks:
        state = debounce(state, seen, now_s, stable_s)
        rose.append(state.rose)
    return rose


def test_a_bouncing_input_comes_on_once() -> None:
    looks = [(0.00, False), (0.01, True), (0.02, False), (0.03, True), (0.04, True), (0.05, True), (0.06, True)]
    assert levels(OFF, looks, 0.02) == [False] * 5 + [True, False]


def test_without_a_time_to_wait_the_first_look_counts() -> None:
    assert levels(OFF, [(0.0, False), (0.1, True), (0.2, True), (0.3, False), (0.4, True)], 0.0) == [
        False, True, False, False, True,
    ]  # fmt: skip


@given(st.lists(st.booleans()), st.integers(1, 5))
def test_it_rises_only_after_standing_still_and_never_twice_without_going_off(seen: list[bool], looks: int) -> None:
    state, run, stood_off = OFF, [], True
    for n, now in enumerate(seen):
        state = debounce(state, now, float(n), float(looks))
        run.append(now)
        if state.rose:
            assert stood_off
            assert all(run[-looks:])
        stood_off = not state.level


def test_a_camera_sets_its_own_pace_and_rests_while_devices_fail() -> None:
    trigger = Trigger(LATE_S)
    assert trigger.due_s(5.0) <= 5.0
    trigger.ended(6.0, resume_s=6.5)
    assert trigger.due_s(6.1) == 6.5
    assert (trigger.missed, trigger.late) == (0, 0)


def test_ticks_that_pass_during_a_cycle_are_missed_and_a_late_begin_is_counted() -> None:
    clock = Clock(10.0, 100.0, LATE_S)
    assert clock.due_s(99.0) == 100.0
    clock.begins(100.02)
    clock.ended(100.35, 100.35)
    assert clock.missed == 3
    assert clock.due_s(100.35) == pytest.approx(100.4)
    clock.begins(100.48)
    assert clock.came_s == pytest.approx(100.4)
    clock.ended(100.49, 100.49)
    assert (clock.missed, clock.late) == (3, 1)


def test_of_calls_one_counts_and_those_during_a_cycle_are_missed() -> None:
    came: list[list[float]] = [[], [10.0, 10.1], [], [10.3], []]
    calls = Calls(lambda: came.pop(0), LATE_S)
    assert calls.due_s(9.0) == math.inf
    assert calls.due_s(10.2) == 10.0
    assert calls.missed == 1
    calls.begins(10.2)
    assert (calls.late, calls.came_s) == (1, 10.0)
    assert calls.missed_before == 0  # the other came after it
    assert calls.due_s(10.2) == 10.0
    calls.ended(10.4, 10.4)
    assert calls.missed == 2
    assert calls.due_s(10.5) == math.inf


class Barrier:
    """A light barrier that stands as the test says."""

    on = False

    def __call__(self) -> bool:
        return self.on


def looked(trigger: Input, times_s: list[float]) -> float:
    return [trigger.due_s(now_s) for now_s in times_s][-1]


def test_an_input_begins_a_cycle_when_it_comes_on_and_not_while_it_stays_on() -> None:
    barrier = Barrier()
    barrier.on = True
    trigger = Input(barrier, 0.02, 0.01, LATE_S)
    assert looked(trigger, [0.0, 0.05, 0.1]) == math.inf
    barrier.on = False
    assert looked(trigger, [0.11, 0.14]) == math.inf
    barrier.on = True
    assert looked(trigger, [0.15, 0.16]) == math.inf
    assert trigger.due_s(0.17) == 0.17
    trigger.begins(0.171)
    assert trigger.came_s == 0.14, "since then it may have been on"
    trigger.glance()
    trigger.ended(0.3, 0.3)
    assert looked(trigger, [0.31, 0.4]) == math.inf
    assert (trigger.missed, trigger.late) == (0, 0)


def test_a_panel_that_comes_during_a_cycle_is_missed() -> None:
    barrier = Barrier()
    trigger = Input(barrier, 0.0, 0.01, LATE_S)
    trigger.due_s(0.0)
    barrier.on = True
    assert trigger.due_s(0.01) == 0.01
    trigger.begins(0.01)
    barrier.on = False
    trigger.glance()
    barrier.on = True
    trigger.ended(0.2, 0.2)
    assert looked(trigger, [0.21, 0.3]) == math.inf
    assert trigger.missed == 1


def test_an_input_that_was_looked_at_too_late_is_late() -> None:
    barrier = Barrier()
    trigger = Input(barrier, 0.0, 0.01, LATE_S)
    trigger.due_s(0.0)
    barrier.on = True
    assert trigger.due_s(0.5) == 0.5
    trigger.begins(0.5)
    assert trigger.late == 1


def test_frames_that_nobody_took_were_missed() -> None:
    line = Line(LATE_S)
    line.passed_over(3)  # before the first: of no line that is known
    for frame_id in (7, 8, 11, 1):
        line.took(frame_id, 1.0)
    assert (line.missed, line.missed_before) == (2, 2)
    line.passed_over(2)
    assert line.missed == 4
    line.begins(1.0)
    line.took(5, 1.5)
    assert (line.missed, line.came_s) == (5, 1.5)
