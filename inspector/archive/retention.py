"""Which recorded sessions are to go. Pure: sizes, ages and free space come from the caller."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

DAY_S = 86_400.0
BYTES_PER_MB = 1e6


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
    for session in held:
        old = now_s - session.newest_s > limits.days * DAY_S
        if not (old or size > limits.most_mb * BYTES_PER_MB or free < limits.least_free_bytes):
            break
        going.append(session.name)
        size -= session.size_bytes
        free += session.size_bytes
    return going


def past_the_last(held: Sequence[Held], last: int) -> list[str]:
    """Sessions without which the last so many frames are still there; ``held`` is oldest first."""
    left, going = sum(h.frames for h in held), list[str]()
    for session in held:
        if left - session.frames < last:
            break
        going.append(session.name)
        left -= session.frames
    return going
