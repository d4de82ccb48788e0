"""Signals as flags that the cycle looks at, and as something that wakes it: it never waits deaf.

Rules. A signal that comes during a plain step waits for the step's end. One that comes while the cycle waits in
:meth:`Signals.wait` wakes it. One that asks to stop during :meth:`Signals.interruptible` raises :class:`StopRequested`
there, since a camera may be waited for longer than a stop may take.
"""

from __future__ import annotations

import contextlib
import select
import signal
import socket
import time
from collections import deque
from collections.abc import Iterator

TRIGGERS = 1000
"""More triggers than this, while nobody takes them, are forgotten."""


class StopRequested(BaseException):
    """The service is to stop; no Exception, so that nothing on the way takes it for a failure."""


class Signals:
    """SIGTERM and SIGINT ask to stop, SIGHUP to read the settings again, SIGUSR1 for one inspection."""

    def __init__(self) -> None:
        self.stop = False
        self.reload = False
        self._triggers: deque[float] = deque(maxlen=TRIGGERS)
        self._interruptible = False
        self._woken, self._wake = socket.socketpair()
        self._woken.setblocking(False)
        self._wake.setblocking(False)

    def install(self) -> None:
        """Take the process' signals; in its main thread only."""
        signal.set_wakeup_fd(self._wake.fileno(), warn_on_full_buffer=False)
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: self._stop_now())
        signal.signal(signal.SIGHUP, lambda *_: self.request_reload())
        signal.signal(signal.SIGUSR1, lambda *_: self.request_trigger())

    def _stop_now(self) -> None:
        self.request_stop()
        if self._interruptible:
            self._interruptible = False
            raise StopRequested

    def request_stop(self) -> None:
        """Stop after this step; from any thread."""
        self.stop = True
        self.wake()

    def request_reload(self) -> None:
        """Read the settings again after this cycle; from any thread."""
        self.reload = True
        self.wake()

    def request_trigger(self) -> None:
        """One inspection, if the station is triggered so; from any thread."""
        self._triggers.append(time.monotonic())
        self.wake()

    def take_triggers(self) -> list[float]:
        """When triggers came since this was asked last, monotonic seconds."""
        taken = []
        with contextlib.suppress(IndexError):
            while True:
                taken.append(self._triggers.popleft())
        return taken

    @contextlib.contextmanager
    def interruptible(self) -> Iterator[None]:
        """What runs inside may be left at once when a stop is asked for. Raises StopRequested."""
        self._interruptible = True
        try:
            if self.stop:
                raise StopRequested
            yield
        finally:
            self._interruptible = False

    def wait(self, timeout_s: float) -> None:
        """Until a signal comes or the time is over."""
        if self.stop or self.reload:
            return
        select.select([self._woken], [], [], max(timeout_s, 0.0))
        with contextlib.suppress(BlockingIOError):
            self._woken.recv(4096)

    def wake(self) -> None:
        """End a wait: something has come that concerns the cycle; from any thread."""
        with contextlib.suppress(BlockingIOError):
            self._wake.send(b"!")
