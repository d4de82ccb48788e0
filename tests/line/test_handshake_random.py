"""The handshake under PLCs that are slow, impatient, crash and lose their connection: on the table, then over TCP.

With buffering no result is lost unless `overruns` says so, none is taken twice, and `sequence` never goes back.
HANDSHAKE_EXAMPLES says how many stories are tried.
"""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from inspector import handshake
from inspector.handshake import FIFO_RESULTS, ControlBlock, Handshake
from inspector.handshake_table import Action, Answer, CommandResult, Control, Step
from inspector.model import Snapshot, State, Verdict
from inspector.publish.plc_server import PlcServer
from inspector.publish.registers import CONTROL_ADDRESS
from inspector.service.control import PlcControl
from tests.line.conftest import Plc
from tests.support.plc_program import PlcProgram

VERDICTS = st.sampled_from(Verdict)
EXAMPLES = int(os.environ.get("HANDSHAKE_EXAMPLES", "20"))
ENOUGH_SCANS = 4 * (FIFO_RESULTS + 2)
"""Scans in which a PLC takes everything that waits: two a result, and some to get into step."""


def image(shown: Snapshot) -> dict[str, int]:
    """What the PLC's program looks at; that the registers show the same is for the run over TCP."""
    sequence = shown.sequence % 2**32
    return {
        "handshake": shown.plc.answers,
        "sequence": sequence % 0x10000,
        "sequence_u32": sequence,
        "verdict": shown.verdict,
    }


class Station(RuleBasedStateMachine):
    """A station on the table, and what must hold whatever the PLC does."""

    always_buffer = False

    @initialize(first=st.sampled_from((0, 65530)), impatient=st.booleans())
    def begin(self, first: int, impatient: bool) -> None:
        """Also from where the register wraps."""
        self.live = Snapshot(state=State.READY, sequence=first)
        self.state = Handshake(shown=self.live, always_buffer=self.always_buffer)
        self.made: dict[int, Verdict] = {}
        self.acknowledged: list[int] = []
        self.kept: set[int] = set()
        self.lowest = first
        self.rises = self.begun = 0
        self.plc = PlcProgram(impatient=impatient, last_taken=first)

    def write(self, bits: Control, number: int, command: int = 0) -> None:
        before = self.state
        self.state, orders = handshake.written(self.state, ControlBlock(bits, number, 7, command), 0.0)
        self.rises += Control.TRIGGER in bits & ~before.control.bits
        self.begun += [order.action for order in orders].count(Action.BEGIN_CYCLE)
        if before.result is Step.RESULT_OFFERED and self.state.result is Step.RESULT_TAKEN:
            assert number == before.shown.sequence % 0x10000
            self.acknowledged.append(before.shown.sequence)

    @rule(verdict=VERDICTS, times=st.sampled_from((1, 1, 1, FIFO_RESULTS + 2)))
    def inspects(self, verdict: Verdict, times: int) -> None:
        for _ in range(times):
            self.inspects_one(verdict)

    def inspects_one(self, verdict: Verdict) -> None:
        if verdict is not Verdict.NOT_INSPECTED:
            self.live = replace(self.live, fault_code=0, state=State.READY)
        self.live = replace(self.live, sequence=self.live.sequence + 1, verdict=verdict, result_at_s=0.0)
        self.made[self.live.sequence] = verdict
        self.state = handshake.cycle_ended(handshake.resulted(self.state, self.live))

    @rule(able=st.booleans())
    def is_able(self, able: bool) -> None:
        self.state = handshake.ready(self.state, able)

    @rule(fault=st.sampled_from((0, 0, 301)))
    def has_fault(self, fault: int) -> None:
        state = State.ERROR if fault else State.READY
        self.live = replace(self.live, fault_code=fault, state=state, verdict=Verdict.NOT_INSPECTED)

    @invariant()
    def the_sequence_never_goes_back(self) -> None:
        shown = handshake.view(self.state, self.live)
        assert shown.sequence >= self.lowest
        self.lowest = shown.sequence
        assert shown.verdict in (Verdict.NOT_INSPECTED, self.made.get(shown.sequence))
        if self.live.fault_code:
            assert shown.verdict is Verdict.NOT_INSPECTED

    @property
    def held(self) -> list[int]:
        """Results that the PLC can still take."""
        waiting = [result.sequence for result in self.state.waiting]
        return [self.state.shown.sequence, *waiting] if self.state.result is Step.RESULT_OFFERED else waiting

    @invariant()
    def what_was_kept_once_is_taken_held_or_counted(self) -> None:
        if self.state.buffering:
            self.kept |= set(self.held)
        assert len(self.kept - set(self.held) - set(self.acknowledged)) <= self.state.overruns
        assert len(self.state.waiting) <= FIFO_RESULTS

    @invariant()
    def triggers_are_taken_or_counted(self) -> None:
        assert self.rises == self.begun + self.state.missed
        assert not (self.state.ready and self.state.cycle)

    @invariant()
    def acknowledged_ones_rise(self) -> None:
        assert self.acknowledged == sorted(set(self.acknowledged))


class AnyPlc(Station):
    """A PLC that writes anything."""

    @rule(
        bits=st.integers(0, sum(Control)).map(Control),
        number=st.integers(0, 0xFFFF),
        shown=st.booleans(),
        command=st.integers(0, 4),
    )
    def writes_anything(self, bits: Control, number: int, shown: bool, command: int) -> None:
        self.write(bits, self.state.shown.sequence % 0x10000 if shown else number, command)

    @rule(outcome=st.sampled_from(CommandResult))
    @precondition(lambda self: self.state.command in (Step.COMMAND_RUNS, Step.COMMAND_LEFT, Step.COMMAND_CROWDED))
    def obeys(self, outcome: CommandResult) -> None:
        self.state = handshake.command_ended(self.state, outcome)

    @rule()
    def discards(self) -> None:
        self.state = handshake.discarded(self.state)

    @invariant()
    def nothing_is_offered_while_acknowledged(self) -> None:
        if self.state.result is Step.RESULT_TAKEN:
            assert Control.RESULTS_ACK in self.state.control.bits


class RightPlc(Station):
    """A PLC whose program is right, and everything around it wrong: slow, lossy, restarted."""

    always_buffer = True

    @rule(written=st.booleans(), read=st.booleans(), twice=st.booleans())
    def scans(self, written: bool = True, read: bool = True, twice: bool = False) -> None:
        """A scan whose read or write may be lost on the way, or arrive twice."""
        if read:
            bits, number = self.plc.scan(image(handshake.view(self.state, self.live)))
            for _ in range(written + (written and twice)):
                self.write(Control(bits), number)

    @rule()
    def wants_a_panel(self) -> None:
        self.plc.wants_trigger = True

    @rule(zeros=st.booleans())
    def crashes(self, zeros: bool) -> None:
        self.plc.crash()
        if zeros:
            self.write(Control(0), 0)

    @invariant()
    def every_result_is_taken_waits_or_is_counted(self) -> None:
        held = self.held
        assert [sequence for sequence, _ in self.plc.taken] == sorted({sequence for sequence, _ in self.plc.taken})
        settled = set(self.acknowledged) | set(held)
        assert len(settled) == len(self.acknowledged) + len(held)
        assert len(self.made) - len(settled) == self.state.overruns
        assert set(self.acknowledged) <= {sequence for sequence, _ in self.plc.taken}
        assert not self.state.overruns or Answer.OVERRUN in Answer(handshake.view(self.state, self.live).plc.answers)

    def teardown(self) -> None:
        """Left alone, the PLC comes to have everything."""
        self.live = replace(self.live, fault_code=0, state=State.READY)
        for _ in range(ENOUGH_SCANS):
            self.scans()
            self.every_result_is_taken_waits_or_is_counted()
        taken = {sequence for sequence, _ in self.plc.taken}
        assert len(self.made) - len(taken) == self.state.overruns
        assert self.state.result is Step.RESULT_NONE


TestAnyPlc = AnyPlc.TestCase
TestAnyPlc.settings = settings(max_examples=EXAMPLES, stateful_step_count=60, deadline=None)
TestRightPlc = RightPlc.TestCase
TestRightPlc.settings = settings(max_examples=EXAMPLES, stateful_step_count=80, deadline=None)


class Wire:
    """A station's registers on a port; a PLC whose connection may break at any byte."""

    def __init__(self, first: int) -> None:
        self.live = Snapshot(state=State.READY, sequence=first)
        self.control = PlcControl(self.live, lambda: None)
        self.server = PlcServer(port=0, stall_after_s=120.0, on_control=self.control.write)
        self.server.start()
        self.control.serve(self.server, "high_first", True)
        self.plc: Plc | None = None

    def inspects(self, verdict: Verdict) -> None:
        self.live = replace(self.live, sequence=self.live.sequence + 1, verdict=verdict, result_at_s=0.0)
        self.control.publish(self.live)
        self.control.cycle_ended(True)

    def connected(self) -> Plc:
        if self.plc is None:
            self.plc = Plc(self.server.port)
        return self.plc

    def breaks(self, request: bytes = b"") -> None:
        """Send so much of a request, wait for no answer, and reset the connection."""
        plc, self.plc = self.connected(), None
        plc.reset(request)

    def close(self) -> None:
        if self.plc:
            self.plc.close()
        self.server.stop()


STEPS = st.lists(
    st.one_of(
        st.tuples(st.just("inspects"), VERDICTS),
        st.tuples(st.just("scans"), st.integers(1, 5)),
        st.tuples(st.just("wants"), st.none()),
        st.tuples(st.just("crashes"), st.booleans()),
        st.tuples(st.just("breaks"), st.integers(0, 17)),
    ),
    min_size=10,
    max_size=60,
)


@settings(max_examples=EXAMPLES, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(STEPS, st.booleans(), st.sampled_from((0, 65530)))
def test_over_tcp_each_result_is_taken_once(steps: list[tuple[str, Any]], impatient: bool, first: int) -> None:
    with contextlib.closing(Wire(first)) as wire:
        plc = PlcProgram(impatient=impatient, last_taken=first)
        last = first
        made: dict[int, int] = {}

        def scan(cut: int | None = None) -> dict[str, Any]:
            """Read, decide, write; or let the connection break after so many bytes of the write."""
            nonlocal last
            read = wire.connected().read()
            assert read["sequence_u32"] >= last
            last = read["sequence_u32"]
            words = plc.scan(read)
            if cut is None:
                assert wire.connected().write(CONTROL_ADDRESS, *words) == 0
            else:
                wire.breaks(Plc.write_request(CONTROL_ADDRESS, *words)[:cut])
            return read

        for name, how in steps:
            match name:
                case "inspects":
                    wire.inspects(how)
                    made[wire.live.sequence] = how
                case "scans":
                    for _ in range(how):
                        scan()
                case "wants":
                    plc.wants_trigger = True
                case "crashes":
                    plc.crash()
                    wire.breaks()
                    if how:
                        assert wire.connected().write(CONTROL_ADDRESS, *[0] * 16) == 0
                case "breaks":
                    scan(how)
        for _ in range(ENOUGH_SCANS):
            read = scan()
        taken = dict(plc.taken)
        assert [sequence for sequence, _ in plc.taken] == sorted(taken)
        assert all(made[sequence] == verdict for sequence, verdict in taken.items())
        assert len(made) - len(taken) == read["overruns"]
        assert Answer.RESULT_AVAILABLE not in Answer(read["handshake"])


def test_results_come_while_the_plc_takes_them(wait_until: Callable[..., Any]) -> None:
    """Two threads, as in the service; the PLC is faster at times and slower at times."""
    results = 300
    with contextlib.closing(Wire(0)) as wire:
        plc = PlcProgram(last_taken=0)
        done = threading.Event()

        def station() -> None:
            for _ in range(results):
                wire.inspects(Verdict.PASS)
            done.set()

        thread = threading.Thread(target=station)
        thread.start()

        def drained() -> bool:
            read = wire.connected().read()
            words = plc.scan(read)
            assert wire.connected().write(CONTROL_ADDRESS, *words) == 0
            missing = results - len(plc.taken) - read["overruns"]
            return done.is_set() and missing == 0

        wait_until(drained, "everything taken or counted")
        thread.join(20)
        sequences = [sequence for sequence, _ in plc.taken]
        assert sequences == sorted(set(sequences))
