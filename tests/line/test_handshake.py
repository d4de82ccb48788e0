"""The handshake's table and what carries it out, without a wire."""

from __future__ import annotations

from dataclasses import replace

import pytest

from inspector import handshake
from inspector.handshake import FIFO_RESULTS, ControlBlock, Handshake, Order
from inspector.handshake_table import TABLE, Action, Answer, CommandResult, Control, Event, Step
from inspector.model import Reason, Snapshot, State, Verdict


class Line:
    """A PLC and a station at the two ends of one handshake; ``live`` is what the station is."""

    def __init__(self, **state: bool) -> None:
        self.state = replace(Handshake(), **state)
        self.live = Snapshot(state=State.READY)
        self.orders: list[Order] = []

    def write(self, bits: int = 0, **block: int) -> None:
        self.state, orders = handshake.written(self.state, ControlBlock(Control(bits), **block), 1.0)
        self.orders += orders

    def result(self, verdict: Verdict = Verdict.PASS) -> None:
        self.live = replace(self.live, sequence=self.live.sequence + 1, verdict=verdict, result_at_s=1.0)
        self.state = handshake.resulted(self.state, self.live)

    def acknowledge(self, sequence: int) -> None:
        bits = self.state.control.bits
        self.write(bits | Control.RESULTS_ACK, acknowledged_sequence=sequence)
        self.write(bits, acknowledged_sequence=sequence)

    @property
    def shown(self) -> Snapshot:
        return handshake.view(self.state, self.live)

    @property
    def answers(self) -> Answer:
        return Answer(self.shown.plc.answers)

    @property
    def actions(self) -> list[Action]:
        return [order.action for order in self.orders]


def test_a_result_that_is_held_keeps_what_it_was_made_by() -> None:
    line = Line(always_buffer=True)
    line.live = replace(line.live, recipe_id=1, simulated=True)
    line.result()
    line.live = replace(line.live, recipe_id=2, simulated=False, verdict=Verdict.NOT_INSPECTED)
    assert (line.shown.recipe_id, line.shown.simulated, line.shown.verdict) == (1, True, Verdict.PASS)
    line.acknowledge(1)
    assert (line.shown.recipe_id, line.shown.simulated, line.shown.verdict) == (2, False, Verdict.NOT_INSPECTED)


def test_without_buffering_too_a_plc_that_acknowledges_sees_a_result_as_it_was_found_until_it_has() -> None:
    line = Line()
    line.live = replace(line.live, recipe_id=1)
    line.result(Verdict.FAIL)
    line.live = replace(line.live, recipe_id=2, verdict=Verdict.NOT_INSPECTED)
    assert (line.shown.recipe_id, line.shown.verdict) == (2, Verdict.NOT_INSPECTED), "nobody says that it was taken"
    line.acknowledge(1)
    line.result(Verdict.FAIL)
    line.live = replace(line.live, recipe_id=3, verdict=Verdict.NOT_INSPECTED)
    assert (line.shown.recipe_id, line.shown.verdict) == (2, Verdict.FAIL)
    line.live = replace(line.live, state=State.ERROR, fault_code=301)
    assert line.shown.verdict == Verdict.NOT_INSPECTED
    line.live = replace(line.live, state=State.READY, fault_code=0)
    line.acknowledge(2)
    assert (line.shown.recipe_id, line.shown.verdict) == (3, Verdict.NOT_INSPECTED)


def test_every_step_event_and_action_is_used_and_every_step_can_be_left() -> None:
    assert {event for _, event in TABLE} == set(Event)
    assert {step for step, _ in TABLE} == {step for step, _ in TABLE.values()} == set(Step)
    assert {action for _, actions in TABLE.values() for action in actions} | {Action.CLEAR_FAULTS} == set(Action)


def test_a_trigger_when_ready_is_taken_once_until_it_drops() -> None:
    line = Line(able=True)
    assert Answer.TRIGGER_READY in line.answers
    line.write(Control.TRIGGER, panel_id=77)
    line.write(Control.TRIGGER, panel_id=78)
    assert line.orders == [Order(Action.BEGIN_CYCLE, 1.0, 77)]
    assert Answer.TRIGGER_ACK in line.answers
    assert Answer.TRIGGER_READY not in line.answers
    line.write()
    assert line.answers & (Answer.TRIGGER_ACK | Answer.TRIGGER_READY) == Answer(0), "the cycle runs"
    line.state = handshake.cycle_ended(line.state)
    assert line.answers & (Answer.TRIGGER_ACK | Answer.TRIGGER_READY) == Answer.TRIGGER_READY


@pytest.mark.parametrize("why", [{"able": False}, {"able": True, "cycle": True}])
def test_a_trigger_when_not_ready_is_counted_flagged_and_not_made_up_for(why: dict[str, bool]) -> None:
    line = Line(**why)
    line.write(Control.TRIGGER)
    line.state = handshake.ready(handshake.cycle_ended(line.state), True)
    assert (line.orders, line.shown.missed_triggers) == ([], 1)
    assert line.answers & ~Answer.ONLINE == Answer.TRIGGER_MISSED
    line.write()
    assert line.answers & ~Answer.ONLINE == Answer.TRIGGER_MISSED | Answer.TRIGGER_READY
    line.write(Control.CLEAR_FAULT)
    assert line.answers & ~Answer.ONLINE == Answer.TRIGGER_READY
    assert (line.actions, line.shown.missed_triggers) == ([Action.CLEAR_FAULTS], 1)


def test_offline_takes_no_trigger() -> None:
    line = Line(able=True)
    line.write(Control.OFFLINE)
    assert line.answers == Answer(0)
    line.write(Control.OFFLINE | Control.TRIGGER)
    assert line.shown.missed_triggers == 1


def test_without_buffering_the_newest_is_shown_and_offered() -> None:
    line = Line()
    for _ in range(3):
        line.result()
    assert (line.shown.sequence, line.shown.overruns) == (3, 0)
    assert Answer.RESULT_AVAILABLE in line.answers
    line.write(Control.RESULTS_ACK, acknowledged_sequence=3)
    line.result()
    assert line.shown.sequence == 4
    assert Answer.RESULT_AVAILABLE not in line.answers, "RESULTS_ACK is still high"
    line.write()
    assert (line.shown.sequence, line.shown.plc.results_waiting) == (4, 0)
    assert Answer.RESULT_AVAILABLE in line.answers


def test_with_buffering_each_is_held_and_a_full_fifo_loses_the_newest_and_says_so() -> None:
    line = Line()
    line.write(Control.BUFFER_RESULTS)
    for _ in range(1 + FIFO_RESULTS + 2):
        line.result()
    assert (line.shown.sequence, line.shown.plc.results_waiting, line.shown.overruns) == (1, FIFO_RESULTS, 2)
    assert Answer.OVERRUN in line.answers
    taken = []
    while Answer.RESULT_AVAILABLE in line.answers:
        taken.append(line.shown.sequence)
        line.acknowledge(line.shown.sequence)
    assert taken == list(range(1, 10))
    line.result()
    assert line.shown.sequence == 12


def test_an_acknowledgement_of_another_result_is_refused() -> None:
    line = Line(always_buffer=True)
    line.result()
    line.result()
    line.write(Control.RESULTS_ACK, acknowledged_sequence=2)
    assert line.shown.sequence == 1
    assert {Answer.RESULT_AVAILABLE, Answer.ACK_MISMATCH} <= set(line.answers)
    line.write(Control.RESULTS_ACK, acknowledged_sequence=1)
    assert line.shown.sequence == 1, "no edge"
    line.write()
    assert Answer.ACK_MISMATCH not in line.answers
    line.acknowledge(1)
    assert line.shown.sequence == 2


def test_a_plc_that_starts_again_with_zeros_loses_nothing_that_was_held() -> None:
    line = Line()
    line.write(Control.BUFFER_RESULTS)
    line.result()
    line.result()
    line.write()
    line.result()
    assert Answer.BUFFERING in line.answers
    for sequence in (1, 2, 3):
        assert line.shown.sequence == sequence
        line.acknowledge(sequence)
    assert Answer.BUFFERING not in line.answers


def test_results_behind_a_stray_acknowledgement_do_not_make_the_sequence_go_back() -> None:
    line = Line(always_buffer=True)
    line.write(Control.RESULTS_ACK)
    line.result()
    line.result()
    assert line.shown.sequence == 0
    line.write()
    assert line.shown.sequence == 1


def test_no_verdict_stands_in_a_fault_and_a_held_result_comes_back() -> None:
    line = Line(always_buffer=True)
    line.result()
    line.live = replace(line.live, state=State.ERROR, fault_code=401, verdict=Verdict.NOT_INSPECTED)
    assert (line.shown.sequence, line.shown.verdict) == (1, Verdict.NOT_INSPECTED)
    assert Reason.DEVICE_FAULT in line.shown.reasons
    line.live = replace(line.live, state=State.READY, fault_code=0)
    assert line.shown.verdict is Verdict.PASS


def test_a_command_is_carried_out_once_and_its_outcome_stays_until_execute_drops() -> None:
    line = Line()
    line.write(Control.EXECUTE, command=1, argument=5)
    assert [(o.action, o.command, o.argument) for o in line.orders] == [(Action.RUN_COMMAND, 1, 5)]
    assert Answer.COMMAND_EXECUTING in line.answers
    line.state = handshake.command_ended(line.state, CommandResult.REFUSED)
    assert line.answers & ~Answer.ONLINE == Answer.COMMAND_FAILED
    assert (line.shown.plc.command_echo, line.shown.plc.command_result) == (1, CommandResult.REFUSED)
    line.write()
    assert line.answers == Answer.ONLINE


def test_a_second_command_while_one_runs_is_told_busy() -> None:
    line = Line()
    line.write(Control.EXECUTE, command=1)
    line.write(command=2)
    line.write(Control.EXECUTE, command=2)
    assert Answer.COMMAND_EXECUTING in line.answers
    line.state = handshake.command_ended(line.state, CommandResult.DONE)
    assert Answer.COMMAND_FAILED in line.answers
    assert (line.actions, line.shown.plc.command_result) == ([Action.RUN_COMMAND], CommandResult.BUSY)


def test_panels_carry_the_id_they_began_with() -> None:
    line = Line(able=True)
    line.write(Control.PANEL_START, panel_id=10)
    line.write(panel_id=11)
    line.write(Control.TRIGGER, panel_id=11)
    line.write(Control.PANEL_START, panel_id=11)
    line.write(Control.PANEL_END)
    line.write(Control.PANEL_END)
    assert [(order.action, order.panel_id) for order in line.orders] == [
        (Action.START_PANEL, 10),
        (Action.BEGIN_CYCLE, 10),
        (Action.END_PANEL, 10),
        (Action.START_PANEL, 11),
        (Action.END_PANEL, 11),
    ]


def test_forgotten_results_are_counted() -> None:
    line = Line(always_buffer=True)
    for _ in range(3):
        line.result()
    line.state = handshake.discarded(line.state)
    assert (line.shown.overruns, line.shown.plc.results_waiting) == (3, 0)
    assert Answer.RESULT_AVAILABLE not in line.answers
    line.result()
    assert line.shown.sequence == 4
