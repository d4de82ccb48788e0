"""The PLC's function block, parsed as IEC 61131-3 and carried out call by call against the station's own handshake."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from paper_line import PaperLine
from structured_text import Declared, Program, parsed

from inspector.dialogues import Obeys
from inspector.handshake_table import Answer, Command, CommandResult
from inspector.integrator.structured_text import function_block
from inspector.model import Defect, Verdict
from inspector.publish import registers
from inspector.publish.wire_fields import WordOrder

CALL_S = 0.01
SOURCE = function_block()


class Bench(PaperLine):
    """The block in its PLC, a Modbus client, and a station on paper; time is what the calls make it."""

    def __init__(self, trigger_by_plc: bool = True, order: WordOrder = "high_first") -> None:
        super().__init__(trigger_by_plc, order)
        self.block = Program(SOURCE, "FB_SeedInspector", lambda: self.now_s)
        self.link = True
        self.results: list[tuple[str, int, int]] = []
        self.lost: list[int] = []
        self.ended: list[tuple[bool, int]] = []
        self.block(bEnable=False)

    def run(self, seconds: float, **inputs: Any) -> None:
        for _ in range(round(seconds / CALL_S)):
            self.call(**inputs)

    def until(self, condition: Callable[[], Any], seconds: float = 5.0, **inputs: Any) -> None:
        for _ in range(round(seconds / CALL_S)):
            if condition():
                return
            self.call(**inputs)
        pytest.fail(f"not within {seconds} s")

    def call(self, **inputs: Any) -> None:
        self.passes(CALL_S)
        v = self.block.v
        done = v.bExchange and self.link
        if done and not v.bExchangeDone:
            self._exchange(v)
        self.block(**({"bEnable": True, "bLowWordFirst": self.order == "low_first"} | inputs), bExchangeDone=done)
        if v.bNewResult:
            said = [name for name in ("bPass", "bFail", "bNotInspected") if getattr(v, name)]
            assert len(said) == 1
            self.results.append((said[0], v.stResult.sequence, v.stResult.panel_id))
        else:
            assert (v.bPass, v.bFail, v.bNotInspected) == (False, False, False)
        self.lost += [v.udiLostPanelId] if v.bPanelLost else []
        self.ended += [(v.bCommandDone, v.uiCommandResult)] if v.bCommandDone or v.bCommandFailed else []

    def _exchange(self, v: Any) -> None:
        if v.uiFunction == 3:
            assert (v.uiAddress, v.uiWords) == (registers.RESULT_ADDRESS, registers.RESULT_WORDS)
            v.awRead = dict(enumerate(self.image()))
            return
        assert (v.uiFunction, v.uiAddress) == (16, registers.CONTROL_ADDRESS)
        self.written([v.awWrite[i] for i in range(v.uiWords)])


@pytest.mark.parametrize("order", ["high_first", "low_first"])
def test_a_triggered_panel_is_taken_once_with_its_id(order: WordOrder) -> None:
    at = Bench(order=order)
    at.until(lambda: at.block.v.bReady)
    for number, verdict, said in ((70_001, Verdict.PASS, "bPass"), (70_002, Verdict.FAIL, "bFail")):
        at.until(lambda: at.station.trigger, bTrigger=True, udiPanelId=number)
        at.inspects(verdict)
        at.run(1.0, bTrigger=False)
        assert at.results[-1][::2] == (said, number)
        assert not at.block.v.bTriggerBusy
        assert Answer.RESULT_AVAILABLE not in Answer(at.station.registers["handshake"])
    assert (len(at.results), at.lost) == (2, [])


def test_results_wait_until_the_program_takes_them_and_none_is_lost() -> None:
    at = Bench(trigger_by_plc=False)
    at.until(lambda: at.block.v.bAlive)
    at.run(0.5)
    for _ in range(6):
        at.inspects()
    at.run(1.0, bTake=False)
    assert at.results == []
    at.run(3.0, bTake=True)
    assert [sequence for _, sequence, _ in at.results] == [1, 2, 3, 4, 5, 6]
    assert at.block.v.udiLostResults == 0


def test_what_the_full_fifo_lost_is_counted() -> None:
    at = Bench(trigger_by_plc=False)
    at.until(lambda: at.block.v.bAlive)
    at.run(0.5, bTake=False)
    for _ in range(12):
        at.inspects()
    at.run(4.0, bTake=True)
    at.inspects()
    at.run(1.0)
    assert [sequence for _, sequence, _ in at.results] == [*range(1, 10), 13]
    assert at.block.v.udiLostResults == 3


def test_a_heartbeat_that_stands_still_ends_all_passes_until_it_moves() -> None:
    at = Bench(trigger_by_plc=False)
    at.until(lambda: at.block.v.bReady or at.block.v.bAlive)
    at.beating = False
    at.run(2.5)
    assert (at.block.v.bAlive, at.block.v.bFault, at.block.v.uiError) == (False, True, at.block.v.ERROR_HEARTBEAT)
    at.inspects()
    at.run(3.0)
    assert at.results == []
    at.beating = True
    at.run(2.0)
    assert [said for said, *_ in at.results] == ["bPass"]


def test_without_a_link_there_is_no_result_and_a_trigger_is_given_up() -> None:
    at = Bench()
    at.until(lambda: at.block.v.bReady)
    at.link = False
    at.run(4.0, bTrigger=True, udiPanelId=9)
    assert (at.block.v.bAlive, at.block.v.bReady, at.lost, at.results) == (False, False, [9], [])
    assert at.block.v.uiError == at.block.v.ERROR_TIMEOUT
    at.link = True
    at.until(lambda: at.block.v.bReady, bTrigger=False)


def test_zeroed_registers_are_never_alive() -> None:
    at = Bench()
    at.image = lambda: (0,) * 125  # type: ignore[method-assign]  # a zeroed PLC image
    at.run(5.0)
    assert (at.block.v.bAlive, at.block.v.bReady, at.results) == (False, False, [])
    assert at.block.v.uiError == at.block.v.ERROR_MAP_VERSION


def test_a_torn_block_is_not_used() -> None:
    at = Bench(trigger_by_plc=False)
    at.until(lambda: at.block.v.bAlive)
    whole = at.image
    at.inspects()
    at.image = lambda: (*whole()[:-1], 7)  # type: ignore[method-assign]  # a torn image, read in two
    at.run(1.0)
    assert (at.results, at.block.v.uiError) == ([], at.block.v.ERROR_TORN)


@pytest.mark.parametrize(("accepted", "said"), [(False, "bNotInspected"), (True, "bPass")])
def test_a_simulated_station_passes_nothing_unless_asked_to(accepted: bool, said: str) -> None:
    at = Bench(trigger_by_plc=False)
    at.station.live = replace(at.station.live, simulated=True)
    at.until(lambda: at.block.v.bAlive, bAcceptSimulated=accepted)
    at.inspects()
    at.run(1.0)
    assert [said for said, *_ in at.results] == [said]


def test_a_cycle_that_fails_is_not_inspected_and_the_fault_is_cleared() -> None:
    at = Bench()
    at.until(lambda: at.block.v.bReady)
    at.until(lambda: at.station.trigger, bTrigger=True, udiPanelId=5)
    at.inspects(None)
    at.run(0.5)
    assert [said for said, *_ in at.results] == ["bNotInspected"]
    assert at.block.v.bFault
    at.run(0.5, bTrigger=False, bClearFault=True)
    assert at.block.v.bReady


def test_a_trigger_that_is_never_answered_by_a_result_is_a_lost_panel() -> None:
    at = Bench()
    at.until(lambda: at.block.v.bReady)
    at.until(lambda: at.station.trigger, bTrigger=True, udiPanelId=5)
    at.run(11.0)
    assert (at.lost, at.results) == ([5], [])


@pytest.mark.parametrize("outcome", [CommandResult.DONE, CommandResult.REFUSED])
def test_a_recipe_is_changed_or_the_refusal_told(outcome: CommandResult) -> None:
    at = Bench()
    at.until(lambda: at.block.v.bReady)
    asked = {"bExecute": True, "uiCommand": int(Command.CHANGE_RECIPE), "udiArgument": 70_003}
    at.until(lambda: at.station.command, **asked)
    assert at.station.command is not None
    assert at.station.command.argument == 70_003
    at.station.does(Obeys(outcome))
    at.run(1.0)
    assert at.ended == [(outcome is CommandResult.DONE, outcome)]
    assert (at.block.v.bCommandBusy, at.block.v.bExecute) == (False, True)


def test_a_command_that_nobody_carries_out_has_failed_in_time() -> None:
    at = Bench()
    at.until(lambda: at.block.v.bReady)
    at.run(11.0, bExecute=True, uiCommand=1, udiArgument=2)
    assert at.ended == [(False, 0)]


@settings(max_examples=15)
@given(
    st.floats(0, 60_000, width=32),
    st.integers(0, 2**32 - 1),
    st.sampled_from(("high_first", "low_first")),
    st.floats(-300, 300),
)
def test_the_block_decodes_as_the_register_table_does(
    height_um: float, number: int, order: WordOrder, x_mm: float
) -> None:
    at = Bench(order=order)
    defects = (Defect(x_mm, -x_mm, height_um, None, (0.0, 0.0), (0.0, 0.0)),)
    at.station.live = replace(at.station.live, panel_id=number, overruns=number, defects=defects)
    expected = registers.decode(at.image(), word_order=order)
    at.until(lambda: at.block.v.stLive.map_version)
    expected |= {"heartbeat": at.block.v.stLive.heartbeat, "result_age_ms": at.block.v.stLive.result_age_ms}
    for name, value in vars(at.block.v.stLive).items():
        if name == "defects":
            for slot, defect in value.items():
                for field, each in vars(defect).items():
                    wanted = expected[f"defect_{slot}_{field}"]
                    if wanted is not None:
                        assert each == pytest.approx(wanted), (slot, field)
        elif expected[name] is not None and not (isinstance(expected[name], float) and math.isnan(expected[name])):
            assert value == pytest.approx(expected[name], rel=1e-6, abs=1e-37), name


def test_nothing_is_used_that_is_not_declared() -> None:
    with pytest.raises(NameError, match="bNewResult"):
        Declared(bPass=False).bNewResult = True


@pytest.mark.long
@pytest.mark.timeout(900)
def test_a_parser_of_the_whole_standard_reads_the_same_units() -> None:
    """A quarter of a minute of processor time: Earley's algorithm, over all of IEC 61131-3."""
    from blark.parse import parse_source_code

    read = parse_source_code(SOURCE)
    assert read.exception is None
    names = [str(getattr(item, "name", None) or item.declaration.name) for item in read.transform().items]
    assert names == list(parsed(SOURCE))
