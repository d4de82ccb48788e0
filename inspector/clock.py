"""Whether the machine's clock is kept right: the Unix times of logs and records are only as good as it is.

The cycle itself runs by the monotonic clock and needs no right time.
"""

from __future__ import annotations

import ctypes
import logging
import math
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

log = logging.getLogger(__name__)

TIME_ERROR = 5
"""What adjtimex(2) returns while nothing keeps the clock right."""
TIMEX_BYTES = 512
"""More than any platform's struct timex; all zero asks without changing anything."""
STAMP = Path("/run/systemd/timesync/synchronized")
"""The file that systemd-timesyncd(8) touches each time it has set the clock right."""
STAMP_LASTS_S = 7200.0
"""It does so every 34 minutes at least, unless it is told otherwise; three times missed count."""
ASK_AGAIN_S = 60.0


def synchronised() -> bool:
    """Whether anything is known to keep the clock right: the kernel says so, or, to a service that may not ask it
    (ProtectClock=), systemd-timesyncd."""
    buffer = ctypes.create_string_buffer(TIMEX_BYTES)
    state = int(ctypes.CDLL(None, use_errno=True).adjtimex(buffer))
    if state >= 0:
        return state != TIME_ERROR
    with suppress(OSError):
        return time.time() - STAMP.stat().st_mtime < STAMP_LASTS_S
    return False


class ClockWatch:
    """Asks now and then whether the clock is kept right, and says in the log when that changes."""

    def __init__(self, ask: Callable[[], bool] = synchronised, clock: Callable[[], float] = time.monotonic) -> None:
        self._ask, self._clock = ask, clock
        self._due_s, self._right = -math.inf, True

    @property
    def unsynchronised(self) -> bool:
        """Whether nothing is known to keep the clock right; at most a minute old."""
        now_s = self._clock()
        if now_s >= self._due_s:
            self._due_s, before = now_s + ASK_AGAIN_S, self._right
            self._right = self._ask()
            if before is not self._right:
                self._say()
        return not self._right

    def _say(self) -> None:
        if self._right:
            log.info("the clock is kept right again")
        else:
            log.warning(
                "nothing keeps the clock right: times in logs and records may be wrong; timedatectl set-ntp true"
            )
