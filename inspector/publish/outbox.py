"""Results on their way into a PLC's registers: in order, each until it has arrived, bounded. Pure.

A result has arrived when the PLC acknowledges it by its sequence or, if it does not acknowledge, when it is written. A
result that finds no room is lost and counted, never put in another's place.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from inspector import handshake
from inspector.handshake_table import Answer
from inspector.model import Snapshot

OF_THE_POLLED = Answer.RESULT_AVAILABLE | Answer.BUFFERING | Answer.OVERRUN | Answer.ACK_MISMATCH
"""Answers that concern results which a PLC fetches, and say nothing to one that is written to."""


@dataclass(frozen=True, slots=True)
class Outbox:
    """``room``: how many results may wait behind the one on its way, or that has arrived last: ``shown``."""

    room: int
    acknowledges: bool
    """Whether the PLC tells which result it has taken."""
    shown: Snapshot
    under_way: bool = False
    """``shown`` has not arrived."""
    written: bool = False
    """``shown`` was written whole since it was put under way."""
    waiting: tuple[Snapshot, ...] = ()
    lost: int = 0

    @property
    def undelivered(self) -> int:
        """How many results have not arrived."""
        return len(self.waiting) + self.under_way


def added(box: Outbox, result: Snapshot) -> Outbox:
    """A new result."""
    if box.under_way and len(box.waiting) >= box.room:
        return replace(box, lost=box.lost + 1)
    return _next(replace(box, waiting=(*box.waiting, result)))


def posted(box: Outbox, sequence: int) -> Outbox:
    """The block with this result was written whole."""
    if not box.under_way or box.shown.sequence != sequence:
        return box
    return replace(box, written=True) if box.acknowledges else _arrived(box)


def acknowledged(box: Outbox, number: int) -> Outbox:
    """The PLC's register says that it took the result of this 16-bit sequence last."""
    if box.under_way and box.written and box.shown.sequence % 0x10000 == number:
        return _arrived(box)
    return box


def view(box: Outbox, live: Snapshot) -> Snapshot:
    """What is written: the station as it is now, with the result that is on its way or has arrived last."""
    shown = handshake.with_result(live, box.shown) if box.under_way or box.shown.sequence != live.sequence else live
    answers = Answer(live.plc.answers) & ~OF_THE_POLLED
    answers |= (Answer.RESULT_AVAILABLE if box.under_way else Answer(0)) | (Answer.OVERRUN if box.lost else Answer(0))
    plc = replace(live.plc, answers=int(answers), results_waiting=len(box.waiting))
    return replace(shown, plc=plc, overruns=box.lost)


def _arrived(box: Outbox) -> Outbox:
    return _next(replace(box, under_way=False, written=False))


def _next(box: Outbox) -> Outbox:
    """The oldest result that waits goes under way, if none is."""
    if box.under_way or not box.waiting:
        return box
    return replace(box, shown=box.waiting[0], waiting=box.waiting[1:], under_way=True, written=False)
