"""Dialogues of a PLC and the station, for the integrator's page: what each side does, and what the registers then show.

Only what is done is written here. What the registers show follows from the handshake's table, by carrying each step
out on paper (:func:`played`); a test plays the same dialogues over the wire and compares every value.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from inspector import handshake, snapshots
from inspector.faults import Fault
from inspector.handshake import ControlBlock, Handshake, Order
from inspector.handshake_table import Action, Command, CommandResult, Control
from inspector.lifecycle import Event, after
from inspector.model import Frame, FrameResult, Snapshot, State, Verdict
from inspector.publish import registers

TRACKED = (
    "handshake",
    "state",
    "fault_code",
    "sequence",
    "verdict",
    "panel_id",
    "recipe_id",
    "results_waiting",
    "missed_triggers",
    "overruns",
    "command_echo",
    "command_result",
)
"""Registers that a dialogue follows."""

Registers = dict[str, int]
_FRAME = Frame(np.zeros((1, 1), np.uint8), "on paper")
_C, _NONE = Control, Control(0)


@dataclass(frozen=True, slots=True)
class Writes:
    """The PLC writes its control block."""

    control: Control = Control(0)
    acknowledged_sequence: int = 0
    control_panel_id: int = 0
    command: int = 0
    command_argument: int = 0


@dataclass(frozen=True, slots=True)
class Reconnects:
    """The PLC's connection breaks, and it makes another; nothing was written."""


@dataclass(frozen=True, slots=True)
class Inspects:
    """The station inspects a panel. Without a verdict its program fails."""

    verdict: Verdict | None = Verdict.PASS


@dataclass(frozen=True, slots=True)
class Obeys:
    """The station carries the PLC's command out, or refuses it."""

    outcome: CommandResult = CommandResult.DONE


Deed = Writes | Reconnects | Inspects | Obeys


@dataclass(frozen=True, slots=True)
class Dialogue:
    """One story; ``trigger`` is the settings' `cycle.trigger.kind`."""

    title: str
    text: str
    deeds: tuple[Deed, ...]
    trigger: Literal["plc", "free_running"] = "plc"


def _acknowledged(*sequences: int, keep: Control = _NONE) -> tuple[Deed, ...]:
    """The PLC acknowledges results, one after the other."""
    return tuple(
        deed
        for sequence in sequences
        for deed in (Writes(keep | _C.RESULTS_ACK, acknowledged_sequence=sequence), Writes(keep))
    )


def _recipe(recipe_id: int, control: Control = _C.EXECUTE) -> Writes:
    """The PLC asks for another recipe, or has just dropped EXECUTE."""
    return Writes(control, command=Command.CHANGE_RECIPE, command_argument=recipe_id)


DIALOGUES = (
    Dialogue(
        "One panel",
        "Wait for TRIGGER_READY, raise TRIGGER with the panel's id, wait for TRIGGER_ACK, drop TRIGGER. The result"
        " comes with RESULT_AVAILABLE; acknowledge it by its sequence, wait until RESULT_AVAILABLE is off, and drop"
        " RESULTS_ACK.",
        (Writes(_C.TRIGGER, control_panel_id=77), Writes(), Inspects(), *_acknowledged(1)),
    ),
    Dialogue(
        "A trigger that comes too early",
        "A TRIGGER that rises while TRIGGER_READY is off is counted, flagged and never made up for. It gets no"
        " TRIGGER_ACK: treat that panel as not inspected. CLEAR_FAULT drops the flag, not the count.",
        (
            Writes(_C.TRIGGER, control_panel_id=5),
            Writes(),
            Writes(_C.TRIGGER, control_panel_id=6),
            Writes(),
            Inspects(Verdict.FAIL),
            Writes(_C.CLEAR_FAULT),
            Writes(),
        ),
    ),
    Dialogue(
        "Results that are kept",
        "With BUFFER_RESULTS each result stays until it is acknowledged; the next comes from the FIFO as soon as"
        " RESULTS_ACK has dropped.",
        (
            Writes(_C.BUFFER_RESULTS),
            Inspects(),
            Inspects(Verdict.FAIL),
            Inspects(),
            *_acknowledged(1, 2, 3, keep=_C.BUFFER_RESULTS),
        ),
        "free_running",
    ),
    Dialogue(
        "A PLC that is too slow",
        "A result that finds the FIFO full is lost: OVERRUN is set, `overruns` counts it, and the gap in `sequence`"
        " shows which it was. What was waiting is not touched.",
        (
            Writes(_C.BUFFER_RESULTS),
            *(Inspects() for _ in range(handshake.FIFO_RESULTS + 2)),
            *_acknowledged(*range(1, handshake.FIFO_RESULTS + 2), keep=_C.BUFFER_RESULTS),
            Inspects(),
            Writes(_C.BUFFER_RESULTS | _C.CLEAR_FAULT),
        ),
        "free_running",
    ),
    Dialogue(
        "The newest wins",
        "Without BUFFER_RESULTS each result is shown at once, also over one that was not acknowledged. While"
        " RESULTS_ACK is high nothing is offered.",
        (
            Inspects(),
            Inspects(Verdict.FAIL),
            Writes(_C.RESULTS_ACK, acknowledged_sequence=2),
            Inspects(),
            Writes(),
        ),
        "free_running",
    ),
    Dialogue(
        "An acknowledgement of another result",
        "It takes nothing. Drop RESULTS_ACK, read the block again and acknowledge what it shows. An acknowledgement of"
        " nothing takes nothing either, but holds back results until it drops.",
        (
            Writes(_C.BUFFER_RESULTS | _C.RESULTS_ACK, acknowledged_sequence=9),
            Inspects(),
            Writes(_C.BUFFER_RESULTS),
            Writes(_C.BUFFER_RESULTS | _C.RESULTS_ACK, acknowledged_sequence=9),
            Writes(_C.BUFFER_RESULTS),
            *_acknowledged(1, 1, keep=_C.BUFFER_RESULTS),
        ),
        "free_running",
    ),
    Dialogue(
        "A PLC that starts again",
        "Its zeros take nothing and lose nothing: a buffer that holds results goes on buffering until they are taken. A"
        " lost connection changes nothing either; write again what the answer did not come for.",
        (
            Writes(_C.BUFFER_RESULTS),
            Inspects(),
            Inspects(Verdict.FAIL),
            Writes(_C.BUFFER_RESULTS | _C.RESULTS_ACK, acknowledged_sequence=1),
            Reconnects(),
            Writes(),
            Inspects(),
            Writes(_C.BUFFER_RESULTS),
            *_acknowledged(2, 3, keep=_C.BUFFER_RESULTS),
        ),
        "free_running",
    ),
    Dialogue(
        "Panel start and end",
        "Results between PANEL_START and PANEL_END carry the id given with PANEL_START, whatever control_panel_id says"
        " by then. PANEL_ACTIVE answers both; a second PANEL_START ends the panel before. Here each frame is a result;"
        " with `panel.frames.kind: plc` all frames between start and end are one, and a PANEL_END without its start is"
        " a panel that was not inspected.",
        (
            Writes(_C.PANEL_START, control_panel_id=501),
            Writes(control_panel_id=502),
            Writes(_C.TRIGGER, control_panel_id=502),
            Inspects(),
            Writes(),
            Writes(_C.PANEL_START, control_panel_id=502),
            Writes(_C.PANEL_END),
            Writes(),
            Writes(_C.PANEL_END),
            Writes(),
        ),
    ),
    Dialogue(
        "Another recipe",
        "Set command and argument, raise EXECUTE, wait for COMMAND_COMPLETED or COMMAND_FAILED, drop EXECUTE. The old"
        " recipe stays until the new one has proved whole. A TRIGGER that rises meanwhile is taken, and its panel"
        " inspected by the new one; TRIGGER_READY is off as long as the lamp must follow to another level.",
        (_recipe(2), Obeys(), Writes()),
    ),
    Dialogue(
        "A recipe that is refused",
        "The old recipe stays; `command_result` says why, and the station's log where.",
        (_recipe(9), Obeys(CommandResult.REFUSED), Writes()),
    ),
    Dialogue(
        "A PLC that does not wait",
        "EXECUTE dropped and raised again while a command is carried out: that command goes on, the new one is refused"
        " as BUSY. EXECUTE dropped early: the outcome is in `command_result` alone.",
        (
            _recipe(2),
            _recipe(1, _NONE),
            _recipe(1),
            _recipe(1, _NONE),
            _recipe(1),
            Obeys(),
            Writes(),
            _recipe(1),
            Writes(),
            Obeys(),
        ),
    ),
    Dialogue(
        "Results that nobody wants",
        "DISCARD_RESULTS forgets what was not acknowledged, and counts it as overruns.",
        (
            Writes(_C.BUFFER_RESULTS | _C.TRIGGER),
            Inspects(),
            Writes(_C.BUFFER_RESULTS),
            Writes(_C.BUFFER_RESULTS | _C.EXECUTE, command=Command.DISCARD_RESULTS),
            Obeys(),
            Writes(),
        ),
    ),
    Dialogue(
        "A fault",
        "A cycle that fails is a result too: NOT_INSPECTED, and to be acknowledged. While a fault lasts no verdict"
        " stands, not even a PASS that was waiting. Faults end by themselves; one that only a frame could end, as here,"
        " is forgotten at CLEAR_FAULT.",
        (
            Writes(_C.TRIGGER, control_panel_id=30),
            Writes(),
            Inspects(None),
            Writes(_C.CLEAR_FAULT),
            Writes(),
        ),
    ),
    Dialogue(
        "Offline and online",
        "Offline the station stays ready, with lamp and module kept, and inspects nothing.",
        (Writes(_C.OFFLINE), Writes(_C.OFFLINE | _C.TRIGGER), Writes(_C.OFFLINE), Writes()),
    ),
)


@dataclass(slots=True)
class PaperStation:
    """A station that does on paper what the service does; recipe 1 is in use."""

    by_plc: bool
    state: Handshake = field(default_factory=Handshake)
    live: Snapshot = field(default_factory=lambda: Snapshot(state=State.INITIALIZED, recipe_id=1))
    trigger: Order | None = None
    command: Order | None = None

    def __post_init__(self) -> None:
        if self.by_plc:
            self.live = snapshots.waiting(self.live, Fault.NONE)
            self._is_ready()

    @property
    def registers(self) -> Registers:
        """What the registers show, as far as a dialogue follows them."""
        shown = registers.encode(handshake.view(self.state, self.live), 0.0, 0)
        values = registers.decode([int.from_bytes(shown[i : i + 2], "big") for i in range(0, len(shown), 2)])
        return {name: int(values[name] or 0) for name in TRACKED}

    def does(self, deed: Deed) -> None:
        """The station after ``deed``."""
        match deed:
            case Writes():
                self._hears(deed)
            case Inspects():
                self._inspects(deed.verdict)
            case Obeys():
                self._obeys(deed.outcome)
            case Reconnects():
                pass

    def _hears(self, deed: Writes) -> None:
        online = self.state.online
        block = ControlBlock(*(getattr(deed, name) for name in deed.__slots__))
        self.state, orders = handshake.written(self.state, block, 0.0)
        for order in orders:
            match order.action:
                case Action.BEGIN_CYCLE:
                    self.trigger = order
                    self.live = replace(self.live, state=after(self.live.state, Event.STARTED_SINGLE))
                case Action.RUN_COMMAND:
                    self.command = order
                case Action.CLEAR_FAULTS:
                    self.live = snapshots.cleared(self.live)
                    self._is_ready()
        if online and not self.state.online:
            self.live = replace(self.live, state=after(self.live.state, Event.STOPPED))

    def _inspects(self, verdict: Verdict | None) -> None:
        times, running = snapshots.Times(0.0, 0.0, 0.0), self.live
        if verdict is None:
            shown = snapshots.not_inspected(running, Fault.INTERNAL, times)
        else:
            shown = snapshots.inspected(running, _FRAME, FrameResult(_FRAME.name, verdict), times)
        if self.by_plc:
            shown = replace(shown, state=after(shown.state, Event.FINISHED, Event.STOPPED))
        panel_id = self.trigger.panel_id if self.trigger else self.state.panel_id
        self.live, self.trigger = replace(shown, panel_id=panel_id or shown.panel_id), None
        self.state = handshake.cycle_ended(handshake.resulted(self.state, self.live))
        self._is_ready()

    def _obeys(self, outcome: CommandResult) -> None:
        assert self.command is not None
        if outcome is CommandResult.DONE:
            if self.command.command == Command.DISCARD_RESULTS:
                self.state = handshake.discarded(self.state)
            else:
                self.live = replace(self.live, recipe_id=self.command.argument)
        self.state = handshake.command_ended(self.state, outcome)

    def _is_ready(self) -> None:
        self.state = handshake.ready(self.state, self.by_plc and snapshots.can_inspect(self.live))


def played(dialogue: Dialogue) -> Iterator[tuple[Deed | None, Registers]]:
    """Each deed, and what the registers show after it; first what they show at the beginning."""
    station = PaperStation(dialogue.trigger == "plc")
    yield None, station.registers
    for deed in dialogue.deeds:
        station.does(deed)
        yield deed, station.registers
