"""When a frame was taken, on a clock that nobody sets."""

from __future__ import annotations

import time


def monotonic_s(taken_at_s: float, within_s: float) -> float:
    """The moment ``taken_at_s`` of Unix time, on this machine's monotonic clock, seconds.

    A moment to come, or longer ago than ``within_s``, says that the clock was set since, or is another machine's: then
    it is now.
    """
    now_s, age_s = time.monotonic(), time.time() - taken_at_s
    return now_s - age_s if 0 <= age_s <= within_s else now_s
