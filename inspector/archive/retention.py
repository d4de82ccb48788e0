"""Which recorded sessions are to go. Pure: sizes, ages and free space come from the caller."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

DAY_S = 86_400.0
BYTES_PER_MB = 1e6
LEAP_S = 90 * DAY_S
"""Of a longer time without any frame nobody can tell whether the line stood still or the clock was set ahead (a year
mistyped, a machine that began in 1970): frames from before it go for want of space, not by their age."""


@dataclass(frozen=True, slots=True)
class Held:
    """A session on the disk: name, size, when its last frame was written (Unix time), and its number of frames."""

    name: str
    size_bytes: int
    newest_s: float
    frames: int


@dataclass(frozen=True, slots=True)
class Limits:
    """How old sessions may be, how much they may take together, and what must stay free of the disk."""

    days: float
    most_mb: float
    least_free_bytes: float


def overdue(held: Sequence[Held], limits: Limits, now_s: float, free_bytes: float) -> list[str]:
    """Sessions to delete, the oldest first, so that age, size and free space are as set; ``held`` is oldest first."""
    size, free, going = sum(h.size_bytes for h in held), free_bytes, list[str]()
    old = _too_old(held, limits.days * DAY_S, now_s)
    for session in held:
        if session.name in old or size > limits.most_mb * BYTES_PER_MB or free < limits.least_free_bytes:
            going.append(session.name)
            size -= session.size_bytes
            free += session.size_bytes
    return going


def _too_old(held: Sequence[Held], longest_s: float, now_s: float) -> set[str]:
    """Those that are older than that by a clock that can be believed: not those before a gap that it may have leapt."""
    old, later_s = set[str](), now_s
    for session in sorted((h for h in held if h.newest_s <= now_s), key=lambda h: h.newest_s, reverse=True):
        if later_s - session.newest_s > max(longest_s, LEAP_S):
            break
        if now_s - session.newest_s > longest_s:
            old.add(session.name)
        later_s = session.newest_s
    return old


def past_the_last(held: Sequence[Held], last: int) -> list[str]:
    """Sessions without which the last so many frames are still there; ``held`` is oldest first."""
    left, going = sum(h.frames for h in held), list[str]()
    for session in held:
        if left - session.frames < last:
            break
        going.append(session.name)
        left -= session.frames
    return going
