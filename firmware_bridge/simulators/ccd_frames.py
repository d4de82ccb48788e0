"""The frames of a simulated head, written into a named pipe, or into a file as a frame grabber's driver would."""

from __future__ import annotations

import contextlib
import enum
import errno
import os
import stat
import threading
import time
from pathlib import Path

from firmware_bridge.simulators.ccd_state import Sensor, SimulatedCcdHead
from firmware_bridge.wire.raw_frames import RawFormat, RawFrame

LOOK_S = 0.002
"""Between two looks whether a pipe has room: its reader may be busy, or not there."""


class FrameFault(enum.StrEnum):
    """What goes wrong with frames."""

    NONE = "none"
    SILENT = "silent"
    SHORT = "short"
    OLD = "old"


class FrameWriter:
    """Writes frames from a thread: one every 1/``rate_hz`` s (0: none), and one for each :meth:`trigger`.

    An existing file is replaced for each frame; otherwise ``path`` is a named pipe, made if it is not there and then
    taken away at the end. Frames that a pipe's reader does not take are lost, as in a camera, and their numbers are
    missing. ``fault`` may be set at any time: no frames, half frames, or the same frame again and again.
    """

    def __init__(self, head: SimulatedCcdHead, sensor: Sensor, form: RawFormat, path: Path, rate_hz: float) -> None:
        self._head, self._sensor, self._form, self._path = head, sensor, form, path
        self._period_s = 1 / rate_hz if rate_hz else None
        self.fault = FrameFault.NONE
        self._number = 0
        self._last = b""
        self._wanted = threading.Semaphore(0)
        self._stopped = threading.Event()
        self._is_ours = not path.exists()
        if self._is_ours:
            os.mkfifo(path)
        self._is_pipe = stat.S_ISFIFO(path.stat().st_mode)
        self._fd = -1
        self._thread = threading.Thread(target=self._run, name="simulated-frames", daemon=True)
        self._thread.start()

    def trigger(self) -> None:
        """Take one frame: a signal on the head's trigger input."""
        self._wanted.release()

    def stop(self) -> None:
        """Write no more, and take the pipe away if it was made here."""
        self._stopped.set()
        self._wanted.release()
        self._thread.join()
        self._hang_up()
        if self._is_ours:
            self._path.unlink(missing_ok=True)

    def _run(self) -> None:
        while not self._stopped.is_set():
            self._wanted.acquire(timeout=self._period_s)
            if not self._stopped.is_set() and self.fault is not FrameFault.SILENT:
                self._write(self._frame())

    def _frame(self) -> bytes:
        if self.fault is FrameFault.OLD and self._last:
            return self._last
        self._number += 1
        exposure_us = self._head.exposure_us
        image = self._sensor.take(exposure_us)
        self._last = self._form.encode(RawFrame(image, self._number, exposure_us, time.time()))
        return self._last[: self._form.frame_bytes // 2] if self.fault is FrameFault.SHORT else self._last

    def _write(self, data: bytes) -> None:
        with contextlib.suppress(OSError):  # no reader, or one that went
            self._into_pipe(data) if self._is_pipe else self._into_file(data)

    def _into_file(self, data: bytes) -> None:
        """In one step, so that nobody sees half a frame. An old frame is not written again."""
        if self.fault is FrameFault.OLD:
            return
        fresh = self._path.with_name(f".{self._path.name}.{os.getpid()}")
        fresh.write_bytes(data)
        fresh.replace(self._path)

    def _into_pipe(self, data: bytes) -> None:
        """All of it or nothing, unless the reader goes. A short one is the last: then the line is cut."""
        if self._fd < 0:
            self._fd = os.open(self._path, os.O_WRONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        rest = memoryview(data)
        try:
            while rest and not self._stopped.is_set():
                try:
                    rest = rest[os.write(self._fd, rest) :]
                except BlockingIOError:
                    self._stopped.wait(LOOK_S)
        except OSError as error:
            if error.errno == errno.EPIPE:
                self._hang_up()
            raise
        if len(data) < self._form.frame_bytes:
            self._hang_up()

    def _hang_up(self) -> None:
        if self._fd >= 0:
            os.close(self._fd)
        self._fd = -1
