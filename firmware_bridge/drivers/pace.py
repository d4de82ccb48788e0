"""When the next frame of a camera without hardware is due."""

from __future__ import annotations

import math
import threading
import time

from firmware_bridge.errors import DeviceGone, NoReply


class Pace:
    """Ticks at ``rate_hz`` (0: whenever asked), from :meth:`start` to :meth:`stop`."""

    def __init__(self, rate_hz: float, deadline_s: float, device: str) -> None:
        self._period_s, self._deadline_s, self._device = (1 / rate_hz if rate_hz else 0.0), deadline_s, device
        self._due_s = 0.0
        self._stopped = threading.Event()
        self._stopped.set()

    def start(self) -> None:
        """The first frame is due now."""
        self._due_s = time.monotonic()
        self._stopped.clear()

    def stop(self) -> None:
        """No more frames; a wait in another thread ends at once. May be called twice."""
        self._stopped.set()

    def wait(self) -> None:
        """Wait for the next tick; those that passed while nobody asked are not made up for.

        Raises DeviceGone if it is stopped, NoReply if the tick is not due within the deadline.
        """
        wait_s = self._due_s - time.monotonic()
        if self._stopped.wait(min(wait_s, self._deadline_s) if wait_s > 0 else 0):
            raise DeviceGone(self._device, "closed", "open it first")
        if wait_s > self._deadline_s:
            raise NoReply(self._device, f"no frame in {self._deadline_s:g} s", "raise rate_hz or deadline_s")
        if self._period_s:
            ticks = math.floor((time.monotonic() - self._due_s) / self._period_s) + 1
            self._due_s += max(ticks, 1) * self._period_s
