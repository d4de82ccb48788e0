"""The handshake with the line's PLC, carried out: what the PLC writes and the station does, one step each. Pure.

:mod:`inspector.handshake_table` says what follows what. Bits are looked at by their edges: a bit that stays high asks
once, and what answers it stays until the PLC drops it.

Results. With buffering the result shown stays until the PLC acknowledges it, by its sequence, and the next comes from
a FIFO; a result that finds the FIFO full is lost, counted and flagged, never put in another's place. Without buffering
the newest is shown at once; a PLC that acknowledges nevertheless sees it as it was found until it has done so, also
where people change the recipe meanwhile. A buffer that holds results goes on buffering until the PLC has taken them,
whatever BUFFER_RESULTS says, so that a PLC that starts again with zeros loses none.

People. The operator's page has a block of its own, and behind it a second :class:`Handshake` of which only commands and
CLEAR_FAULT are asked: neither side can drop, raise or overwrite what the other has written.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from inspector.handshake_table import (
    OPERATOR_ANSWER,
    TABLE,
    Action,
    Answer,
    CommandResult,
    Control,
    Event,
    Step,
)
from inspector.model import PlcSide, Reason, Snapshot, State, Verdict

FIFO_RESULTS = 8
"""Results that wait behind the one shown."""


@dataclass(frozen=True, slots=True)
class ControlBlock:
    """What the PLC has written, decoded."""

    bits: Control = Control(0)
    acknowledged_sequence: int = 0
    panel_id: int = 0
    command: int = 0
    argument: int = 0


@dataclass(frozen=True, slots=True)
class Order:
    """An action that somebody else carries out, one of :data:`ORDERS`, and when it was asked for on the caller's
    clock. ``panel_id`` 0: the PLC gave none. ``missed``: how often TRIGGER had been missed until then. ``by_operator``:
    of the operator's page. ``mark_refused_after``: a panel mark that came after this one found no room."""

    action: Action
    asked_s: float
    panel_id: int = 0
    command: int = 0
    argument: int = 0
    missed: int = 0
    by_operator: bool = False
    mark_refused_after: bool = False

    @property
    def asker(self) -> str:
        """Whose order it is, in words for the log."""
        return "Operator" if self.by_operator else "PLC"


PANEL_ORDERS = (Action.START_PANEL, Action.END_PANEL)
ORDERS = (Action.BEGIN_CYCLE, Action.CLEAR_FAULTS, Action.RUN_COMMAND, *PANEL_ORDERS)


@dataclass(frozen=True, slots=True)
class Handshake:
    """Everything that the handshake remembers."""

    control: ControlBlock = ControlBlock()
    always_buffer: bool = False
    """Results are buffered whatever BUFFER_RESULTS says."""
    able: bool = False
    """The station waits for a TRIGGER and could inspect at once."""
    cycle: bool = False
    """A TRIGGER was taken and its result is still to come."""
    trigger: Step = Step.TRIGGER_LOW
    result: Step = Step.RESULT_NONE
    command: Step = Step.COMMAND_NONE
    panel: Step = Step.PANEL_NONE
    panel_id: int = 0
    """Id of the panel begun; 0: none was given."""
    buffering: bool = False
    acknowledges: bool = False
    """The PLC says by RESULTS_ACK when it has taken a result: it has done so since the start."""
    shown: Snapshot = Snapshot()
    """The result that the registers show; one without a verdict before the first."""
    waiting: tuple[Snapshot, ...] = ()
    """Results not yet shown, oldest first."""
    flags: Answer = Answer(0)
    """TRIGGER_MISSED, OVERRUN and ACK_MISMATCH as they stand."""
    missed: int = 0
    overruns: int = 0
    command_echo: int = 0
    outcome: CommandResult = CommandResult.NONE

    @property
    def online(self) -> bool:
        """Whether inspections are wanted."""
        return Control.OFFLINE not in self.control.bits

    @property
    def ready(self) -> bool:
        """TRIGGER_READY."""
        return self.able and self.online and not self.cycle and self.trigger is Step.TRIGGER_LOW


Stepped = tuple[Handshake, tuple[Order, ...]]
LINES = ("trigger", "result", "command", "panel")


def written(state: Handshake, block: ControlBlock, now_s: float) -> Stepped:
    """The PLC has written its control block. Edges of one write count in this order: acknowledge, clear fault, panel
    end, panel start, trigger, execute."""
    rises, drops = block.bits & ~state.control.bits, state.control.bits & ~block.bits
    state = replace(state, control=block)
    orders: tuple[Order, ...] = ()
    if Control.CLEAR_FAULT in rises:
        state = replace(state, flags=state.flags & Answer.ACK_MISMATCH)
        orders = (Order(Action.CLEAR_FAULTS, now_s),)
    for bit in _ORDER_OF_EDGES:
        if bit in rises | drops:
            state, more = _fired(state, _event(state, bit, bit in rises), now_s)
            orders += more
    acknowledges = state.acknowledges or Control.RESULTS_ACK in rises
    return _buffered(replace(state, acknowledges=acknowledges)), orders


_ORDER_OF_EDGES = (
    Control.RESULTS_ACK,
    Control.PANEL_END,
    Control.PANEL_START,
    Control.TRIGGER,
    Control.EXECUTE,
)


def _event(state: Handshake, bit: Control, rises: bool) -> Event | None:
    """What an edge of the PLC's means now."""
    if bit is Control.TRIGGER:
        ready = Event.TRIGGER_WHEN_READY if state.ready else Event.TRIGGER_WHEN_NOT_READY
        return ready if rises else Event.TRIGGER_DROPS
    if bit is Control.RESULTS_ACK:
        is_shown = state.shown.sequence % 0x10000 == state.control.acknowledged_sequence
        return (Event.ACK_OF_SHOWN if is_shown else Event.ACK_OF_OTHER) if rises else Event.ACK_DROPS
    if bit is Control.EXECUTE:
        return Event.EXECUTE_RISES if rises else Event.EXECUTE_DROPS
    if not rises:
        return None
    return Event.PANEL_STARTS if bit is Control.PANEL_START else Event.PANEL_ENDS


def resulted(state: Handshake, result: Snapshot) -> Handshake:
    """The station has a new result."""
    state = _buffered(state)
    if not state.buffering:
        # The newest wins; while RESULTS_ACK is still high it is shown, and offered when that drops.
        offered = state.result is Step.RESULT_OFFERED
        return _offered(replace(state, shown=result, waiting=() if offered else (result,)))
    room = FIFO_RESULTS + (state.result is Step.RESULT_NONE)
    if len(state.waiting) >= room:
        return replace(state, overruns=state.overruns + 1, flags=state.flags | Answer.OVERRUN)
    return _offered(replace(state, waiting=(*state.waiting, result)))


def ready(state: Handshake, able: bool) -> Handshake:
    """Whether the station waits for a TRIGGER and could inspect at once."""
    return replace(state, able=able)


def cycle_ended(state: Handshake) -> Handshake:
    """The cycle that a TRIGGER began has brought its result."""
    return replace(state, cycle=False)


def cycle_lost(state: Handshake) -> Handshake:
    """A TRIGGER was taken, and there will be no cycle: the station is triggered otherwise now."""
    return _counted_missed(replace(state, cycle=False)) if state.cycle else state


def command_ended(state: Handshake, outcome: CommandResult) -> Handshake:
    """The command is carried out, or could not be."""
    return _fired(replace(state, outcome=outcome), Event.COMMAND_ENDS, 0.0)[0]


def discarded(state: Handshake) -> Handshake:
    """Results that were not acknowledged are forgotten, and counted as overruns."""
    lost = len(state.waiting) + (state.result is Step.RESULT_OFFERED)
    state = replace(state, waiting=(), overruns=state.overruns + lost)
    return _buffered(_fired(state, Event.DISCARD, 0.0)[0])


def view(state: Handshake, live: Snapshot) -> Snapshot:
    """What the registers show: ``live`` is the station as it is now, with its newest result."""
    shown, station = state.shown, station_view(state, live)
    kept = state.result is Step.RESULT_OFFERED and (state.buffering or state.acknowledges)
    return with_result(station, shown) if kept or shown.sequence != live.sequence else station


def station_view(state: Handshake, live: Snapshot) -> Snapshot:
    """The station with its newest result, whatever is held: only the handshake's own registers are added."""
    return replace(
        live,
        missed_triggers=live.missed_triggers + state.missed,
        overruns=live.overruns + state.overruns,
        plc=PlcSide(int(_answers(state)), len(state.waiting), state.command_echo, int(state.outcome)),
    )


def operator_side(state: Handshake, words: tuple[int, ...]) -> PlcSide:
    """What the operator's block shows: ``state`` is a handshake of its own, of which only commands are asked."""
    return PlcSide(int(_answers(state) & OPERATOR_ANSWER), 0, state.command_echo, int(state.outcome), words)


def _fired(state: Handshake, event: Event | None, now_s: float) -> Stepped:
    """Each line of the handshake after ``event``, and what others are to do."""
    orders: tuple[Order, ...] = ()
    for line in LINES:
        row = TABLE.get((getattr(state, line), event)) if event else None
        if row is not None:
            next_step: dict[str, Any] = {line: row[0]}
            state = replace(state, **next_step)
            for action in row[1]:
                if action in ORDERS:
                    orders += (_order(state, action, now_s),)
                state = _DO[action](state)
    return _offered(state), orders


def _order(state: Handshake, action: Action, now_s: float) -> Order:
    """What somebody else is to do; a panel that has begun keeps the id it began with."""
    block = state.control
    begun = state.panel is Step.PANEL_BEGUN and action is not Action.START_PANEL
    panel_id = state.panel_id if begun or action is Action.END_PANEL else block.panel_id
    return Order(action, now_s, panel_id, block.command, block.argument, state.missed)


def _offered(state: Handshake) -> Handshake:
    """The next result of the FIFO is offered if none is."""
    row = TABLE.get((state.result, Event.RESULT_WAITS)) if state.waiting else None
    return _offer_next(replace(state, result=row[0])) if row else state


def _offer_next(state: Handshake) -> Handshake:
    return replace(state, shown=state.waiting[0], waiting=state.waiting[1:])


def _buffered(state: Handshake) -> Handshake:
    """Buffering ends when the PLC has taken what is held, no sooner."""
    holds = state.buffering and (bool(state.waiting) or state.result is not Step.RESULT_NONE)
    wanted = state.always_buffer or Control.BUFFER_RESULTS in state.control.bits
    return replace(state, buffering=wanted or holds)


def _counted_missed(state: Handshake) -> Handshake:
    return replace(state, missed=state.missed + 1, flags=state.flags | Answer.TRIGGER_MISSED)


_DO: dict[Action, Callable[[Handshake], Handshake]] = {
    Action.BEGIN_CYCLE: lambda s: replace(s, cycle=True),
    Action.COUNT_MISSED: _counted_missed,
    Action.OFFER_NEXT: _offer_next,
    Action.FLAG_MISMATCH: lambda s: replace(s, flags=s.flags | Answer.ACK_MISMATCH),
    Action.DROP_MISMATCH: lambda s: replace(s, flags=s.flags & ~Answer.ACK_MISMATCH),
    Action.RUN_COMMAND: lambda s: replace(s, command_echo=s.control.command, outcome=CommandResult.NONE),
    Action.KEEP_OUTCOME: lambda s: s,
    Action.REFUSE_AS_BUSY: lambda s: replace(s, outcome=CommandResult.BUSY),
    Action.START_PANEL: lambda s: replace(s, panel_id=s.control.panel_id),
    Action.END_PANEL: lambda s: replace(s, panel_id=0),
}


def _answers(state: Handshake) -> Answer:
    """The bits of the `handshake` register."""
    runs = state.command in (Step.COMMAND_RUNS, Step.COMMAND_LEFT, Step.COMMAND_CROWDED)
    done, well = state.command is Step.COMMAND_DONE, state.outcome is CommandResult.DONE
    bits = {
        Answer.ONLINE: state.online,
        Answer.TRIGGER_READY: state.ready,
        Answer.TRIGGER_ACK: state.trigger is Step.TRIGGER_TAKEN,
        Answer.RESULT_AVAILABLE: state.result is Step.RESULT_OFFERED,
        Answer.BUFFERING: state.buffering,
        Answer.PANEL_ACTIVE: state.panel is Step.PANEL_BEGUN,
        Answer.COMMAND_EXECUTING: runs,
        Answer.COMMAND_COMPLETED: done and well,
        Answer.COMMAND_FAILED: done and not well,
    }
    set_bits = state.flags
    for bit, is_set in bits.items():
        set_bits |= bit if is_set else Answer(0)
    return set_bits


OF_A_RESULT = (
    "sequence",
    "acquisition_id",
    "panel_id",
    "panel_frames",
    "extent",
    "recipe_id",
    "verdict",
    "reasons",
    "defects",
    "unpaired_count",
    "result_at_s",
    "elapsed_us",
    "cycle_us",
    "response_us",
    "lamp_read_v",
    "exposure_us",
    "configuration_hash",
    "recipe_hash",
    "simulated",
)
"""What of a snapshot belongs to its result; the rest tells of the station as it is."""


def with_result(live: Snapshot, result: Snapshot) -> Snapshot:
    """The station as it is, with an older result. In a fault no verdict stands; the result itself keeps its own."""
    shown = replace(live, **{name: getattr(result, name) for name in OF_A_RESULT})
    if not live.fault_code and live.state not in (State.ERROR, State.HALTED):
        return shown
    return replace(shown, verdict=Verdict.NOT_INSPECTED, reasons=shown.reasons | Reason.DEVICE_FAULT, defects=())
