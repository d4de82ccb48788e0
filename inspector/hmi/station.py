"""The station as the page sees it: polled over Modbus TCP like any PLC's client, by a thread that also commands.

One thread owns the connection, so that a command's steps and the looks between them never cross.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Protocol

from firmware_bridge.errors import BridgeError, Refused
from firmware_bridge.wire.modbus import MAX_READ_REGISTERS, Table
from inspector.hmi import commands, history
from inspector.hmi.commands import Asked, Deed
from inspector.hmi.look import Link, Look, Words
from inspector.outage import Outage
from inspector.publish import registers
from inspector.publish.registers import LIST_ADDRESS, OPERATOR_ADDRESS, OPERATOR_WORDS, RESULT_ADDRESS, RESULT_WORDS
from inspector.publish.statistics_registers import STATISTICS_ADDRESS, STATISTICS_WORDS

log = logging.getLogger(__name__)

POLL_S, COMMAND_POLL_S = 0.2, 0.05
RETRY_S = 1.0


class Master(Protocol):
    """The station's registers; every method raises BridgeError."""

    def open(self) -> None: ...
    def close(self) -> None: ...
    def read(self, table: Table, address: int, count: int = 1) -> list[int]: ...
    def write_many(self, address: int, values: list[int]) -> None: ...


class Busy(Exception):
    """A command is being carried out."""


class Away(Exception):
    """The station does not answer."""


class StationLink:
    """Looks at the station until stopped, whatever becomes of it; ``look`` may be read by any thread."""

    def __init__(
        self,
        master: Master,
        where: str,
        word_order: registers.WordOrder,
        *,
        clock: Callable[[], float] = time.monotonic,
        wall: Callable[[], float] = time.time,
    ) -> None:
        self._master, self._word_order, self._clock, self._wall = master, word_order, clock, wall
        self.look = Look()
        self._outage, self._open = Outage(f"station at {where}"), False
        self._changed, self._stopping = threading.Condition(), False
        self._numbers = itertools.count(1)
        self._thread = threading.Thread(target=self._run, name="station", daemon=True)

    def start(self) -> None:
        """Begin to look."""
        self._thread.start()

    def stop(self) -> None:
        """End, and close the connection."""
        with self._changed:
            self._stopping = True
            self._changed.notify()
        self._thread.join(5)

    def ask(self, deed: Deed, argument: int) -> Asked:
        """Have a command carried out; it shows in ``look``. Raises Busy or Away, and then nothing is sent."""
        with self._changed:
            asked, now_s = self.look.asked, self._clock()
            if self.look.link(now_s) is not Link.UP:
                raise Away
            if asked is not None and not asked.over:
                raise Busy
            asked = Asked(next(self._numbers), deed, argument, now_s)
            self.look = replace(self.look, asked=asked)
            self._changed.notify()
        log.info("command %d: %s, argument %d", asked.number, deed.name, argument)
        return asked

    def _run(self) -> None:
        while not self._stopping:
            try:
                self._turn()
                self._outage.ends()
                pause_s = POLL_S if self.look.asked is None or self.look.asked.over else COMMAND_POLL_S
            except BridgeError as error:
                self._away(error)
                pause_s = RETRY_S
            except Exception as error:  # the page goes on whatever the registers hold
                self._away(error, traceback=True)
                pause_s = RETRY_S
            self._pause(pause_s)
        self._master.close()

    def _pause(self, longest_s: float) -> None:
        """Until the next look is due; at once if a command is asked for."""
        with self._changed:
            before = self.look.asked
            self._changed.wait_for(lambda: self._stopping or self.look.asked is not before, longest_s)

    def _turn(self) -> None:
        """One look at everything, and the next step of a command."""
        if not self._open:
            self._master.open()
            self._open = True
        block = self._read(RESULT_ADDRESS, RESULT_WORDS)
        operator = self._read(OPERATOR_ADDRESS, OPERATOR_WORDS)
        statistics = self._read(STATISTICS_ADDRESS, STATISTICS_WORDS)
        defects, listed_for = self._defects(block)
        now_s, last = self._clock(), self.look
        beats = last.block is not None and last.block["heartbeat"] != block["heartbeat"]
        with self._changed:
            self.look = replace(
                self.look,
                block=block,
                defects=defects,
                listed_for=listed_for,
                statistics=statistics,
                why="",
                reached_s=now_s if last.block is None else last.reached_s,
                read_s=now_s,
                heartbeat_s=now_s if beats else last.heartbeat_s,
                seen=history.after(last.seen, history.result_of(block, self._wall())),
            )
        self._command(operator)

    def _command(self, operator: Words) -> None:
        asked = self.look.asked
        if asked is None or asked.over:
            return
        asked, words = commands.step(asked, operator, self._clock())
        self._note(asked)  # first: a request whose answer is lost may have been carried out
        if words is not None:
            try:
                self._master.write_many(OPERATOR_ADDRESS, self._ordered(words))
            except Refused as error:
                log.error("command %d refused: %s", asked.number, error)
                self._note(commands.refused(asked))

    def _note(self, asked: Asked) -> None:
        with self._changed:
            self.look = replace(self.look, asked=asked)
        if asked.over:
            log.info("command %d: %s %s", asked.number, asked.outcome.value, asked.code.name)

    def _ordered(self, words: Sequence[int]) -> list[int]:
        swap = self._word_order == "low_first"
        return [*words[:6], *(words[:5:-1] if swap else words[6:])]

    def _away(self, error: Exception, *, traceback: bool = False) -> None:
        self._outage.begins(error, traceback=traceback)
        self._open = False
        with contextlib.suppress(BridgeError):
            self._master.close()
        with self._changed:
            asked = self.look.asked and commands.overdue(self.look.asked, self._clock())
            self.look = Look(why=str(error), seen=self.look.seen, asked=asked)

    def _read(self, address: int, count: int) -> Words:
        words = self._master.read(Table.INPUT_REGISTERS, address, count)
        return registers.decode(words, address, self._word_order)

    def _defects(self, block: Words) -> tuple[tuple[Words, ...], tuple[Any, ...]]:
        """The defects of the result that the block shows, highest first, and of which result they are. They come in
        several reads: of another result than the block's, they are read with the next look."""
        wanted = (block["sequence_u32"], block["verdict"], block["defect_count"])
        if wanted == self.look.listed_for:
            return self.look.defects, wanted
        count = min(int(block["defect_count"] or 0), registers.LIST_DEFECTS)
        if count == 0:
            return (), wanted
        end = registers.FIRST_LIST_DEFECT + count * registers.DEFECT_WORDS
        words: list[int] = []
        while len(words) < end:
            part = min(MAX_READ_REGISTERS, end - len(words))
            words += self._master.read(Table.INPUT_REGISTERS, LIST_ADDRESS + len(words), part)
        (last,) = self._master.read(Table.INPUT_REGISTERS, LIST_ADDRESS + registers.LIST_END)
        if not words[0] == last == block["sequence"]:
            return (), ()
        listed = registers.decode(words, LIST_ADDRESS, self._word_order)
        names = [field.name for field in registers.DEFECT_FIELDS]
        return tuple({n: listed[f"list_defect_{i}_{n}"] for n in names} for i in range(1, count + 1)), wanted
