"""The operator's block beside the PLC's: two writers, neither of which can undo what the other asks for."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from inspector.faults import Fault
from inspector.handshake_table import Answer, Command, CommandResult, Control
from inspector.model import State, Verdict
from inspector.publish.registers import OPERATOR_ADDRESS, OPERATOR_WORDS
from tests.line.conftest import Plc
from tests.line.test_daemon import bench, shown
from tests.line.test_plc_trigger import Line, line

__all__ = ["bench", "line", "shown"]

RECIPES = [{"id": n, "name": name} for n, name in ((1, "one"), (2, "two"), (3, "three"))]
ENDED = Answer.COMMAND_COMPLETED | Answer.COMMAND_FAILED


class Operator:
    """People's side, over a connection of its own."""

    def __init__(self, at: Line, wait_until: Callable[..., Any]) -> None:
        self.wire, self._wait_until = Plc(at.station.daemon.port), wait_until

    def read(self) -> dict[str, Any]:
        return self.wire.read(OPERATOR_ADDRESS, OPERATOR_WORDS)

    def write(self, bits: int = 0, command: int = 0, argument: int = 0) -> int:
        return self.wire.write(OPERATOR_ADDRESS, bits, 0, 0, 0, command, 0, argument >> 16, argument & 0xFFFF)

    def answered(self, answers: Answer) -> dict[str, Any]:
        def met() -> dict[str, Any] | None:
            told = self.read()
            return told if Answer(told["operator_handshake"]) & answers else None

        return dict(self._wait_until(met, str(answers)))

    def execute(self, command: int, argument: int = 0) -> int:
        """How the command ended."""
        assert self.write(Control.EXECUTE, command, argument) == 0
        told = self.answered(ENDED)
        assert self.write() == 0
        assert not self.read()["operator_handshake"]
        return int(told["operator_command_result"])


@pytest.fixture
def people(wait_until: Callable[..., Any]) -> Iterator[Callable[[Line], Operator]]:
    with contextlib.ExitStack() as stack:

        def come(at: Line) -> Operator:
            operator = Operator(at, wait_until)
            stack.callback(operator.wire.close)
            return operator

        yield come


def test_a_recipe_changed_by_people_shows_in_none_of_the_plcs_answers(
    line: Callable[..., Line], people: Callable[[Line], Operator]
) -> None:
    at = line(recipe=1, recipes=RECIPES)
    operator, before = people(at), at.until_set(Answer.TRIGGER_READY)
    assert operator.execute(Command.CHANGE_RECIPE, 2) == CommandResult.DONE
    after = at.until(lambda r: r["state"] == State.READY, "ready")
    assert after["recipe_id"] == 2
    unmoved = ("handshake", "command_echo", "command_result", "missed_triggers")
    assert [after[name] for name in unmoved] == [before[name] for name in unmoved]
    assert operator.execute(Command.CHANGE_RECIPE, 9) == CommandResult.REFUSED
    assert at.plc.read()["recipe_id"] == 2


def test_a_plc_that_writes_its_block_each_cycle_takes_nothing_back(
    line: Callable[..., Line], people: Callable[[Line], Operator]
) -> None:
    at = line(recipe=1, recipes=RECIPES)
    operator = people(at)
    at.until_set(Answer.TRIGGER_READY)
    at.control(Control.TRIGGER)  # the cycle waits for its frame: whatever is asked now waits behind it
    at.until(lambda r: r["state"] == State.SINGLE_EXECUTION, "inspecting")
    operator.write(Control.EXECUTE, Command.CHANGE_RECIPE, 2)
    at.control(Control.EXECUTE, 0, 0, 0, Command.CHANGE_RECIPE, 0, 0, 3)
    at.control(0, *[0] * 7)
    assert operator.read()["operator_handshake"] == Answer.COMMAND_EXECUTING
    at.station.camera.permits.release()
    assert operator.answered(ENDED)["operator_command_result"] == CommandResult.DONE
    done = at.until(lambda r: r["recipe_id"] == 3, "the PLC's recipe, which it asked for later")
    assert (done["sequence"], done["missed_triggers"]) == (1, 0)
    assert (operator.read()["operator_argument"], at.plc.read(500, 16)["command_argument"]) == (2, 0)


def test_a_verdict_that_the_plc_has_not_yet_taken_outlasts_a_recipe_changed_by_people(
    line: Callable[..., Line], people: Callable[[Line], Operator]
) -> None:
    """Without BUFFER_RESULTS. The command waits behind the cycle, so no PLC could have read the result before it."""
    at = line(recipe=1, recipes=RECIPES)
    operator = people(at)
    for sequence, recipe in ((1, 2), (2, 3)):
        at.until_set(Answer.TRIGGER_READY)
        at.control(Control.TRIGGER, 0, 0, 70 + sequence)
        at.until(lambda r: r["state"] == State.SINGLE_EXECUTION, "inspecting")
        at.control()
        operator.write(Control.EXECUTE, Command.CHANGE_RECIPE, recipe)
        at.station.camera.permits.release()
        operator.answered(ENDED)
        operator.write()
        result = at.until_set(Answer.RESULT_AVAILABLE)
        told = (result["sequence"], result["panel_id"], result["recipe_id"], result["verdict"])
        if sequence == 2:
            assert told == (2, 72, 2, Verdict.PASS)
        at.control(Control.RESULTS_ACK, sequence)
        after = at.until_off(Answer.RESULT_AVAILABLE)
        assert (after["recipe_id"], after["verdict"]) == (recipe, Verdict.NOT_INSPECTED)
        at.control()


def test_a_trigger_while_the_lamp_follows_a_recipe_changed_by_people_is_missed_and_flagged(
    line: Callable[..., Line], people: Callable[[Line], Operator]
) -> None:
    """The PLC may have read TRIGGER_READY just before."""
    brighter = [{"id": 1, "name": "one", "lamp_percent": 40}, {"id": 2, "name": "two", "lamp_percent": 60}]
    at = line(recipe=1, recipes=brighter, lamp={"settle_s": 60})
    operator = people(at)
    at.until_set(Answer.TRIGGER_READY)
    assert operator.execute(Command.CHANGE_RECIPE, 2) == CommandResult.DONE
    settles = at.until_off(Answer.TRIGGER_READY)
    at.control(Control.TRIGGER)
    missed = at.until_set(Answer.TRIGGER_MISSED)
    assert (missed["missed_triggers"], missed["sequence"], missed["recipe_id"]) == (1, 0, 2)
    assert Answer.TRIGGER_ACK not in Answer(missed["handshake"])
    assert settles["sequence"] == 0


def test_a_trigger_that_rises_while_people_change_the_recipe_is_inspected_by_the_new_one(
    line: Callable[..., Line], people: Callable[[Line], Operator], monkeypatch: pytest.MonkeyPatch
) -> None:
    at = line(recipe=1, recipes=RECIPES)
    operator = people(at)
    at.until_set(Answer.TRIGGER_READY)
    prove = at.station.daemon._cycle.prove

    def triggered_meanwhile(recipe: Any) -> None:
        at.control(Control.TRIGGER, 0, 0, 77)
        prove(recipe)

    monkeypatch.setattr(at.station.daemon._cycle, "prove", triggered_meanwhile)
    at.station.camera.permits.release()
    assert operator.execute(Command.CHANGE_RECIPE, 2) == CommandResult.DONE
    result = at.until_set(Answer.RESULT_AVAILABLE)
    assert (result["panel_id"], result["recipe_id"], result["verdict"]) == (77, 2, Verdict.PASS)
    assert result["missed_triggers"] == 0


def test_ready_is_not_taken_back_while_people_change_the_recipe(
    line: Callable[..., Line], people: Callable[[Line], Operator], monkeypatch: pytest.MonkeyPatch
) -> None:
    at = line(recipe=1, recipes=RECIPES)
    operator = people(at)
    at.until_set(Answer.TRIGGER_READY)
    control, told = at.station.daemon._control, []
    ready = control.ready
    monkeypatch.setattr(control, "ready", lambda able: (told.append(able), ready(able)))
    for recipe in (2, 3, 1):
        assert operator.execute(Command.CHANGE_RECIPE, recipe) == CommandResult.DONE
    at.until_set(Answer.TRIGGER_READY)
    assert told
    assert all(told)


def test_people_cannot_trigger_nor_take_a_result_nor_forget_one(
    line: Callable[..., Line], people: Callable[[Line], Operator]
) -> None:
    at = line(plc={"port": 0, "buffer_results": True})
    operator = people(at)
    at.until_set(Answer.TRIGGER_READY)
    for bit in Control:
        refused = operator.write(bit)
        assert refused == (0 if bit in (Control.CLEAR_FAULT, Control.EXECUTE) else 3)
        operator.write()
    for word in (1, 2, 3, 5, 8, 15):
        assert operator.wire.write(OPERATOR_ADDRESS + word, 1) == 3
    for word in (16, 18, 31):
        assert operator.wire.write(OPERATOR_ADDRESS + word, 1) == 2
    at.control(Control.TRIGGER)
    at.station.camera.permits.release()
    held = at.until_set(Answer.RESULT_AVAILABLE)
    assert operator.execute(Command.DISCARD_RESULTS) == CommandResult.NOT_AVAILABLE
    assert at.plc.read()["sequence"] == held["sequence"]
    assert Answer.RESULT_AVAILABLE in Answer(at.plc.read()["handshake"])


def test_a_fault_that_people_clear_leaves_the_plcs_flags_to_the_plc(
    line: Callable[..., Line], people: Callable[[Line], Operator]
) -> None:
    at = line()
    operator = people(at)
    at.until_set(Answer.TRIGGER_READY)
    at.station.says = {1: RuntimeError("a fault of the program")}
    at.control(Control.TRIGGER)
    at.control()
    at.control(Control.TRIGGER)  # missed
    at.control()
    at.station.camera.permits.release()
    at.until(lambda r: r["fault_code"] == Fault.INTERNAL, "the fault")
    assert operator.write(Control.CLEAR_FAULT) == 0
    cleared = at.until(lambda r: not r["fault_code"], "no fault")
    assert Answer.TRIGGER_MISSED in Answer(cleared["handshake"])
