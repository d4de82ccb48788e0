"""Results written into a PLC's registers, by a thread of its own: the inspection never waits for the PLC.

The block is written in two requests of which the second has `sequence`: a PLC that finds `sequence` equal to
`sequence_end` has a whole result. Whatever was not acknowledged when the connection broke is written again; the same
sequence is the same result.
"""

from __future__ import annotations

import contextlib
import logging
import math
import struct
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Protocol

from firmware_bridge.errors import BridgeError
from firmware_bridge.wire.modbus import MAX_WRITE_REGISTERS, Table
from inspector.model import Snapshot
from inspector.outage import Outage
from inspector.publish import outbox
from inspector.publish.outbox import Outbox
from inspector.publish.plc_server import as_stalled
from inspector.publish.plc_settings import PostSettings
from inspector.publish.registers import RESULT_WORDS, WordOrder, encode

log = logging.getLogger(__name__)

HEAD_WORDS = RESULT_WORDS - MAX_WRITE_REGISTERS
"""Written last, with `sequence`; what follows fits one request."""
LOOK_S = 0.05
"""While an acknowledgement is awaited, the PLC's register is read this often."""
STOP_DEADLINE_S = 2.0
"""The cycle waits no longer for this to end; a thread that still waits for its PLC then ends by itself, and whoever
comes after it waits for that."""


class Master(Protocol):
    """The PLC's registers; every method raises BridgeError."""

    def open(self) -> None: ...
    def close(self) -> None: ...
    def read(self, table: Table, address: int, count: int = 1) -> list[int]: ...
    def write_many(self, address: int, values: list[int]) -> None: ...


class Poster:
    """Writes results into the registers behind ``master``. ``stalled``: whether the inspection has stopped turning.

    ``turn`` is held from the first request to the end: of posters that share it, one begins to write when the one
    before has written its last, so that a PLC gets no part of a block between two of another's, nor one from before it.
    """

    def __init__(
        self,
        settings: PostSettings,
        master: Master,
        first: Snapshot,
        *,
        turn: threading.Lock,
        word_order: WordOrder = "high_first",
        stalled: Callable[[], bool] = lambda: False,
    ) -> None:
        self._settings, self._master, self._turn_to_write = settings, master, turn
        self._word_order, self._stalled = word_order, stalled
        self._box = Outbox(settings.queue, settings.acknowledge_address is not None, first)
        self._live = first
        self._changed = threading.Condition()
        self._new, self._stopping, self._given_up = True, False, False
        self._open, self._written_s = False, -math.inf
        self._delay_s = settings.retry_first_s
        self._outage = Outage(f"posting to {settings.host}:{settings.port}")
        self._full = False
        self._started_s = time.monotonic()
        self._thread = threading.Thread(target=self._run, name="post", daemon=True)

    @property
    def box(self) -> Outbox:
        """What has not arrived, at this moment."""
        return self._box

    def start(self) -> None:
        """Begin to write. A PLC that is away is said in the log, and tried again."""
        self._thread.start()

    def stop(self) -> Outbox:
        """End; what has not arrived."""
        with self._changed:
            self._stopping = True
            self._changed.notify()
        if self._thread.is_alive():
            self._thread.join(STOP_DEADLINE_S)
            self._given_up = self._thread.is_alive()
        return self._box

    def take_over(self, box: Outbox) -> None:
        """Go on with what another poster had not delivered; before :meth:`start`."""
        for result in ((box.shown,) if box.under_way else ()) + box.waiting:
            self._add(result)
        self._box = replace(self._box, lost=self._box.lost + box.lost)

    def show(self, live: Snapshot, result: Snapshot | None = None) -> None:
        """The station as it is now, and the new result if there is one. Never waits for the PLC."""
        with self._changed:
            self._live = live
            if result is not None:
                self._add(result)
            self._new = True
            self._changed.notify()

    def _add(self, result: Snapshot) -> None:
        lost = self._box.lost
        self._box = outbox.added(self._box, result)
        full = self._box.lost > lost
        if full and not self._full:
            log.error("posting: %d results wait for the PLC; later ones are lost, and counted", self._settings.queue)
        self._full = full

    def _run(self) -> None:
        with self._turn_to_write:
            self._until_stopped()
            with contextlib.suppress(BridgeError):
                if self._open and self._new and not self._given_up:
                    self._turn()  # that the station goes off
            self._master.close()

    def _until_stopped(self) -> None:
        while not self._stopping:
            try:
                self._turn()
            except BridgeError as error:
                self._failed(error)
            except Exception as error:
                self._failed(error, traceback=True)
            else:
                self._delay_s = self._settings.retry_first_s
                self._wait(LOOK_S if self._awaits else self._settings.period_s, for_news=True)

    @property
    def _awaits(self) -> bool:
        """Whether an acknowledgement is awaited."""
        return self._box.acknowledges and self._box.under_way

    def _turn(self) -> None:
        """Write what is to be shown, and look which result the PLC has taken."""
        if not self._open:
            self._master.open()
            self._open, self._written_s = True, -math.inf
        if self._more or time.monotonic() >= self._written_s + self._settings.period_s:
            with self._changed:
                self._new = False
                shown = outbox.view(self._box, self._live)
            self._write(shown)
            self._outage.ends()
            with self._changed:
                self._box = outbox.posted(self._box, shown.sequence)
        if self._settings.acknowledge_address is not None and self._awaits:
            (number,) = self._master.read(Table.HOLDING_REGISTERS, self._settings.acknowledge_address)
            with self._changed:
                self._box = outbox.acknowledged(self._box, number)

    def _write(self, shown: Snapshot) -> None:
        """The whole block, `sequence` last."""
        self._written_s = now_s = time.monotonic()
        shown = as_stalled(shown) if self._stalled() else shown
        block = encode(shown, now_s, int(now_s - self._started_s), self._word_order)
        words = list(struct.unpack(f">{RESULT_WORDS}H", block))
        self._master.write_many(self._settings.address + HEAD_WORDS, words[HEAD_WORDS:])
        self._master.write_many(self._settings.address, words[:HEAD_WORDS])

    def _failed(self, error: Exception, *, traceback: bool = False) -> None:
        self._outage.begins(error, traceback=traceback)
        self._master.close()
        self._open = False
        self._wait(self._delay_s, for_news=False)
        self._delay_s = min(2 * self._delay_s, self._settings.retry_longest_s)

    def _wait(self, timeout_s: float, *, for_news: bool) -> None:
        """Until the time is over, or this ends, or (if wanted) there is something to write."""
        with self._changed:
            self._changed.wait_for(lambda: self._stopping or (for_news and self._more), timeout_s)

    @property
    def _more(self) -> bool:
        """Whether there is something that was not yet written."""
        return self._new or (self._box.under_way and not self._box.written)
