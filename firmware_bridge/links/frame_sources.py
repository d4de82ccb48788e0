"""Where frames come from when a camera's control line does not carry them: a stream of bytes, or one file rewritten.

Every call returns or raises within the time it is given.
"""

from __future__ import annotations

import contextlib
import os
import stat
import threading
import time
from collections import deque
from pathlib import Path
from typing import Protocol

from firmware_bridge.errors import DeviceGone, NoReply, ReplyWrong
from firmware_bridge.links.ports import Port, reason
from firmware_bridge.wire.raw_frames import FrameReader, RawFormat, RawFrame

PAUSE_S, ALIGN_S = 0.005, 1.0
"""Frames without headers are told apart by the pause between two, seconds; a stream without one is given up."""

LOOK_S = 0.002
"""Between two looks at a file: short against a frame's time, long against what a look costs."""


class FrameSource(Protocol):
    """Gives frames in the order in which they were taken; ``name`` goes into every error and frame."""

    name: str

    def open(self) -> None:
        """Raises DeviceGone."""
        ...

    def close(self) -> None:
        """May be called twice, never raises."""
        ...

    def discard(self) -> None:
        """Throw away all that has come up to now, half a frame too. Raises DeviceGone."""
        ...

    def read(self, timeout_s: float) -> RawFrame:
        """The next frame. Raises NoReply, ReplyWrong (short, or of another shape), DeviceGone."""
        ...


class StreamSource:
    """Frames one after another from a named pipe or a character device."""

    def __init__(self, device: str, path: str, form: RawFormat) -> None:
        self._device, self.name, self._form = device, path, form
        self._port: Port | None = None
        self._reader = FrameReader(form)
        self._frames: deque[RawFrame] = deque()
        self._skip = 0

    def open(self) -> None:
        """See the protocol. A pipe may have no writer yet: then no frame comes."""
        self.close()
        try:
            self._port = Port(self._device, self.name, _Stream(self.name))
        except OSError as error:
            raise _cannot_open(self._device, self.name, error) from error
        self._restart()
        if not self._form.header:
            self._align()

    def close(self) -> None:
        """See the protocol."""
        if self._port:
            self._port.close()
        self._port = None

    def _align(self) -> None:
        """Let a frame that is half through pass: what comes after a pause begins a frame. Raises ReplyWrong."""
        port, until_s = self._opened(), time.monotonic() + ALIGN_S
        while port.read(PAUSE_S):
            if time.monotonic() > until_s:
                what = f"{self.name} never pauses between frames, so that none has a beginning"
                raise ReplyWrong(self._device, what, "let its writer put headers before frames")

    def discard(self) -> None:
        """See the protocol. Of a frame that has come in part, the rest is thrown away when it comes."""
        port, until_s = self._opened(), time.monotonic() + LOOK_S
        while time.monotonic() < until_s and (data := port.read(0)):
            self._reader.receive(data)
        self._frames.clear()
        self._skip = int(self._reader.pending_bytes > 0)

    def read(self, timeout_s: float) -> RawFrame:
        """See the protocol."""
        port, until_s = self._opened(), time.monotonic() + timeout_s
        noise = self._reader.dropped_bytes
        while not self._frames:
            try:
                data = port.read(until_s - time.monotonic())
            except DeviceGone:
                self._raise_if_short("and then it was closed")
                raise
            if not data and time.monotonic() >= until_s:
                self._raise_if_short(f"in {timeout_s:.3g} s")
                raise self._nothing(timeout_s, self._reader.dropped_bytes - noise)
            self._take(self._reader.receive(data))
        if not self._form.header:
            self._end(port)
        return self._frames.popleft()

    def _end(self, port: Port) -> None:
        """Without headers, what follows a frame before the next pause is whole frames, or its shape is another one and
        the next frames would be shifted. Raises ReplyWrong."""
        until_s = time.monotonic() + ALIGN_S
        with contextlib.suppress(DeviceGone):  # the frame is whole: whoever asks for the next one will see it
            while time.monotonic() < until_s and (data := port.read(PAUSE_S)):
                self._take(self._reader.receive(data))
        if beyond := self._reader.pending_bytes:
            self._restart()
            what = f"{self.name} gave {beyond} bytes beyond a frame's {self._form.frame_bytes}"
            raise ReplyWrong(self._device, what, "check the frame's width, height and bits")

    def _take(self, frames: list[RawFrame]) -> None:
        old, self._skip = self._skip, max(self._skip - len(frames), 0)
        self._frames += frames[old:]

    def _raise_if_short(self, when: str) -> None:
        """Half a frame is no frame; it is told once, and what comes after it is a new one."""
        if pending := self._reader.pending_bytes:
            self._restart()
            what = f"{self.name} gave {pending} of a frame's {self._form.frame_bytes} bytes {when}"
            raise ReplyWrong(self._device, what, "check the frame's width, height and bits, and its cable")

    def _restart(self) -> None:
        self._reader = FrameReader(self._form)
        self._frames.clear()
        self._skip = 0

    def _nothing(self, timeout_s: float, noise: int) -> NoReply | ReplyWrong:
        if noise:
            what = f"{self.name} gave {noise} bytes and no frame's header that fits"
            return ReplyWrong(self._device, what, "check the frame's width, height and bits")
        return NoReply(
            self._device, f"no frame from {self.name} in {timeout_s:.3g} s", "check trigger and frame grabber"
        )

    def _opened(self) -> Port:
        if self._port is None:
            raise DeviceGone(self._device, "not open", "open it first")
        return self._port


class FileSource:
    """The one frame that a file (in shared memory) holds at a time: new when the file was written or replaced.

    A writer that replaces the file (writes another and renames it) never shows half a frame; one that writes in place
    is read again until the file kept still meanwhile.
    """

    def __init__(self, device: str, path: str, form: RawFormat) -> None:
        self._device, self.name, self._form = device, path, form
        self._path = Path(path)
        self._seen: tuple[int, int] | None = None
        self._closed = threading.Event()
        self._closed.set()

    def open(self) -> None:
        """See the protocol; what the file holds now is an old frame."""
        self._closed.clear()
        try:
            self.discard()
        except DeviceGone:
            self.close()
            raise

    def close(self) -> None:
        """See the protocol; a read that waits in another thread ends at once."""
        self._closed.set()

    def discard(self) -> None:
        """See the protocol."""
        self._seen = self._signature()

    def read(self, timeout_s: float) -> RawFrame:
        """See the protocol."""
        until_s = time.monotonic() + timeout_s
        while time.monotonic() < until_s:
            before = self._signature()
            if before != self._seen:
                data = self._content()
                if self._signature() == before:
                    return self._frame(before, data, until_s)
            self._closed.wait(LOOK_S)
        what = f"{self.name} holds an old frame, and no new one came in {timeout_s:.3g} s"
        raise NoReply(self._device, what, "check trigger and frame grabber")

    def _frame(self, signature: tuple[int, int], data: bytes, until_s: float) -> RawFrame:
        """The frame, if it is whole; a writer in place may still be at it, for which it is given the time there is."""
        reader = FrameReader(self._form)
        frames = reader.receive(data)
        if len(frames) == 1 and not reader.pending_bytes and not reader.dropped_bytes:
            self._seen = signature
            return frames[0]
        if len(data) < self._form.frame_bytes and self._changes(signature, until_s):
            return self.read(until_s - time.monotonic())
        self._seen = signature
        what = f"{self.name} holds {len(data)} bytes that are no frame of {self._form.frame_bytes}"
        raise ReplyWrong(self._device, what, "check the frame's width, height and bits")

    def _changes(self, signature: tuple[int, int], until_s: float) -> bool:
        while time.monotonic() < until_s:
            if self._signature() != signature:
                return True
            self._closed.wait(LOOK_S)
        return False

    def _signature(self) -> tuple[int, int]:
        """What changes when the file is replaced or written: inode and time of the last change, nanoseconds."""
        if self._closed.is_set():
            raise DeviceGone(self._device, "not open", "open it first")
        try:
            found = self._path.stat()
        except OSError as error:
            raise _cannot_open(self._device, self.name, error) from error
        return found.st_ino, found.st_mtime_ns

    def _content(self) -> bytes:
        try:
            return self._path.read_bytes()
        except OSError as error:
            raise _cannot_open(self._device, self.name, error) from error


class RawSource:
    """A stream or a file of raw frames, whichever the path is when it is opened."""

    def __init__(self, device: str, path: str, form: RawFormat) -> None:
        self._device, self.name, self._form = device, path, form
        self._source: FrameSource | None = None

    def open(self) -> None:
        """See the protocol."""
        self.close()
        try:
            is_file = stat.S_ISREG(os.stat(self.name).st_mode)
        except OSError as error:
            raise _cannot_open(self._device, self.name, error) from error
        self._source = (FileSource if is_file else StreamSource)(self._device, self.name, self._form)
        self._source.open()

    def close(self) -> None:
        """See the protocol."""
        if self._source:
            self._source.close()
        self._source = None

    def discard(self) -> None:
        """See the protocol."""
        self._opened().discard()

    def read(self, timeout_s: float) -> RawFrame:
        """See the protocol."""
        return self._opened().read(timeout_s)

    def _opened(self) -> FrameSource:
        if self._source is None:
            raise DeviceGone(self._device, "not open", "open it first")
        return self._source


class _Stream:
    """A pipe or device as a port wants it."""

    def __init__(self, path: str) -> None:
        # Without O_NONBLOCK the open itself would wait until a pipe has a writer.
        self._fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)

    def fileno(self) -> int:
        return self._fd

    def close(self) -> None:
        os.close(self._fd)


def _cannot_open(device: str, path: str, error: OSError) -> DeviceGone:
    return DeviceGone(device, f"cannot open {path}: {reason(error)}", "check the frame grabber and its permissions")
