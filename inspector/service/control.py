"""The handshake at work: the server's thread brings what is written, the cycle's thread what the station does.

One lock, one state (:class:`~inspector.handshake.Handshake`); whatever changes it shows in the registers before the
call returns, so that the answer to a write is read with the next request.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from firmware_bridge.wire.modbus import DeviceBusy, IllegalValue
from inspector import handshake
from inspector.handshake import PANEL_ORDERS, ControlBlock, Handshake, Order
from inspector.handshake_table import Action, CommandResult, Step
from inspector.model import Snapshot
from inspector.publish.plc_server import PlcServer
from inspector.publish.registers import (
    CONTROL_ADDRESS,
    CONTROL_WORDS,
    OPERATOR_ADDRESS,
    WordOrder,
    decode_control,
    decode_operator,
)

if TYPE_CHECKING:
    from inspector.service.posting import Poster

log = logging.getLogger(__name__)

PANEL_MARKS = 64
"""So many panel starts and ends may wait for the cycle; a write that makes more is refused as busy."""


class PlcControl:
    """What PLC and operator ask of the station, and what they are shown. ``wake`` ends the cycle's wait; called in any
    thread.

    ``first`` is what the registers show before anything else.
    """

    def __init__(self, first: Snapshot, wake: Callable[[], None], *, clock: Callable[[], float] = time.monotonic):
        self._lock = threading.Lock()
        self._live, self._wake, self._clock = first, wake, clock
        self._state = Handshake(shown=first)
        self._operator = Handshake()
        self._words = dict.fromkeys((CONTROL_ADDRESS, OPERATOR_ADDRESS), (0,) * CONTROL_WORDS)
        self._word_order: WordOrder = "high_first"
        self._server: PlcServer | None = None
        self._poster: Poster | None = None
        self._trigger: Order | None = None
        self._commands: deque[Order] = deque()
        self._obeyed: Order | None = None
        self._marks: list[Order] = []
        self._clear = False

    def serve(self, server: PlcServer, word_order: WordOrder, always_buffer: bool) -> None:
        """Show the registers here from now on, and as these settings say."""
        with self._lock:
            self._server, self._word_order = server, word_order
            self._state = replace(self._state, always_buffer=always_buffer)
            self._show()

    def post(self, poster: Poster | None) -> None:
        """Hand every result to this poster from now on, beside showing it; None: to none."""
        with self._lock:
            self._poster = poster
            self._show()

    def write(self, address: int, words: Sequence[int]) -> None:
        """PLC or operator writes into its block. Raises IllegalValue if it means nothing, DeviceBusy if it has a panel
        mark that finds no room; then nothing is written."""
        by_operator = address >= OPERATOR_ADDRESS
        first = OPERATOR_ADDRESS if by_operator else CONTROL_ADDRESS
        with self._lock:
            before, at = self._words[first], address - first
            written = (*before[:at], *words, *before[at + len(words) :])
            if written == before:
                return
            try:
                block = (decode_operator if by_operator else decode_control)(written, self._word_order)
            except ValueError as error:
                raise IllegalValue from error
            self._take(block, by_operator)
            self._words[first] = written
            self._show()
        self._wake()

    def publish(self, snapshot: Snapshot) -> None:
        """What the station is and has found; a new sequence is a new result. Counts as a beat."""
        with self._lock:
            is_new = snapshot.sequence != self._live.sequence
            if is_new:
                self._state = handshake.resulted(self._state, snapshot)
            self._live = snapshot
            self._show(snapshot if is_new else None, beat=True)

    def ready(self, able: bool) -> None:
        """Whether the station waits for a TRIGGER and could inspect at once."""
        with self._lock:
            self._step(handshake.ready(self._state, able))

    @property
    def station(self) -> Snapshot:
        """The station with its newest result, as it is shown to whoever fetches no results one by one. Never waits."""
        return handshake.station_view(self._state, self._live)

    @property
    def online(self) -> bool:
        """Whether the PLC wants inspections."""
        return self._state.online

    @property
    def trigger_s(self) -> float:
        """When the TRIGGER came whose cycle has not ended; infinite if there is none."""
        trigger = self._trigger
        return math.inf if trigger is None else trigger.asked_s

    @property
    def panel_id(self) -> int:
        """Id of the panel in view as the PLC gave it: with the TRIGGER taken last, or with PANEL_START; 0: none."""
        trigger = self._trigger
        return self._state.panel_id if trigger is None else trigger.panel_id

    @property
    def missed(self) -> int:
        """How often TRIGGER rose when the station was not ready."""
        return self._state.missed

    @property
    def missed_before(self) -> int:
        """:attr:`missed` as it was when the TRIGGER came whose cycle has not ended; as it is if there is none."""
        trigger = self._trigger
        return self._state.missed if trigger is None else trigger.missed

    @property
    def asks(self) -> bool:
        """Whether :meth:`take_command`, :meth:`take_clear` or :meth:`take_panel_marks` has something."""
        return bool(self._commands) or self._clear or bool(self._marks)

    def cycle_ended(self, able: bool) -> None:
        """The cycle that a TRIGGER began, if one did, has brought its result; ``able`` as for :meth:`ready`."""
        with self._lock:
            self._trigger = None
            self._step(handshake.cycle_ended(handshake.ready(self._state, able)))

    def cycle_lost(self) -> None:
        """There will be no cycle for the TRIGGER taken: it is counted as missed."""
        with self._lock:
            self._trigger = None
            self._step(handshake.cycle_lost(handshake.ready(self._state, False)))

    def take_command(self) -> Order | None:
        """The command to be carried out, once; :meth:`command_ended` answers it before the next is taken."""
        with self._lock:
            self._obeyed = self._commands.popleft() if self._commands else None
            return self._obeyed

    def command_ended(self, outcome: CommandResult) -> None:
        """How the command taken last ended; whose it was is told."""
        with self._lock:
            if self._obeyed is not None and self._obeyed.by_operator:
                self._operator = handshake.command_ended(self._operator, outcome)
                self._show()
            else:
                self._step(handshake.command_ended(self._state, outcome))

    @property
    def untaken(self) -> int:
        """How many results are held for the PLC, the one it is offered included; 0 where the newest wins."""
        with self._lock:
            state = self._state
            return (len(state.waiting) + (state.result is Step.RESULT_OFFERED)) if state.buffering else 0

    def discard_results(self) -> None:
        """Forget the results that were not acknowledged."""
        with self._lock:
            self._step(handshake.discarded(self._state))

    def take_clear(self) -> bool:
        """Whether a CLEAR_FAULT has risen since this was asked last."""
        with self._lock:
            clear, self._clear = self._clear, False
            return clear

    def take_panel_marks(self) -> list[Order]:
        """Panel starts and ends since this was asked last, in their order."""
        with self._lock:
            marks, self._marks = self._marks, []
            return marks

    def _take(self, block: ControlBlock, by_operator: bool) -> None:
        """What was written is a step of its writer's handshake; what follows is kept for the cycle."""
        if by_operator:
            self._operator, orders = handshake.written(self._operator, block, self._clock())
        else:
            stalled = self._server is not None and self._server.stalled
            state = handshake.ready(self._state, self._state.able and not stalled)
            stepped, orders = handshake.written(state, block, self._clock())
            self._make_room(sum(order.action in PANEL_ORDERS for order in orders))
            self._state = stepped
        for order in orders:
            match order.action:
                case Action.BEGIN_CYCLE:
                    self._trigger = order
                case Action.RUN_COMMAND:
                    self._commands.append(replace(order, by_operator=by_operator))
                case Action.CLEAR_FAULTS:
                    self._clear = True
                case _:
                    self._marks.append(order)

    def _make_room(self, marks: int) -> None:
        """Raise DeviceBusy if so many marks more are too many; the panel that they would have ended is told."""
        if not marks or len(self._marks) + marks <= PANEL_MARKS:
            return
        last = self._marks[-1]
        if not last.mark_refused_after:
            log.error("%d panel marks wait for a cycle that does not take them: the PLC is answered busy", PANEL_MARKS)
        self._marks[-1] = replace(last, mark_refused_after=True)
        raise DeviceBusy

    def _step(self, state: Handshake) -> None:
        if state != self._state:
            self._state = state
            self._show()

    def _show(self, result: Snapshot | None = None, *, beat: bool = False) -> None:
        if self._poster is not None:
            self._poster.show(handshake.station_view(self._state, self._live), result)
        if self._server is None:
            return
        shown = handshake.view(self._state, self._live)
        operator = handshake.operator_side(self._operator, self._words[OPERATOR_ADDRESS])
        shown = replace(shown, plc=replace(shown.plc, control=self._words[CONTROL_ADDRESS]), operator=operator)
        if beat:
            self._server.publish(shown)
        else:
            self._server.show(shown)
