"""Frames from a Video4Linux device, asked for through the kernel's own interface (linux/videodev2.h).

OpenCV's capture would wait ten seconds for a frame whatever it is told, and keeps the driver's frame counter to
itself; here a frame has its deadline, and one that the driver lost shows as a gap. 64-bit machines only.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import mmap
import os
import select
import struct
import time

import numpy as np

from firmware_bridge.errors import DeviceGone, NoReply, ReplyWrong
from firmware_bridge.links.ports import reason
from firmware_bridge.wire.raw_frames import RawFormat, RawFrame

CAPTURE, MEMORY_MAP, FIELD_NONE = 1, 1, 1
BUFFERS = 4
"""One being filled, one waiting, one being read, one to spare."""

FLAG_ERROR = 0x40
"""V4L2_BUF_FLAG_ERROR: the driver says that the frame is damaged."""

PIXEL_FORMATS = {8: b"GREY", 16: b"Y16 "}

# struct v4l2_format (with v4l2_pix_format), v4l2_requestbuffers, v4l2_buffer.
FORMAT = struct.Struct("@I4x2I4s9I152x")
REQUEST = struct.Struct("@5I")
BUFFER = struct.Struct("@5I4x2q16s2IQ3I4x")


def _ioctl(direction: int, number: int, size: int) -> int:
    """The _IOW (1) and _IOWR (3) macros of linux/ioctl.h, for type 'V'."""
    return direction << 30 | size << 16 | ord("V") << 8 | number


SET_FORMAT = _ioctl(3, 5, FORMAT.size)
REQUEST_BUFFERS = _ioctl(3, 8, REQUEST.size)
QUERY_BUFFER = _ioctl(3, 9, BUFFER.size)
QUEUE_BUFFER = _ioctl(3, 15, BUFFER.size)
TAKE_BUFFER = _ioctl(3, 17, BUFFER.size)
STREAM_ON, STREAM_OFF = _ioctl(1, 18, 4), _ioctl(1, 19, 4)


class V4l2Source:
    """Implements :class:`firmware_bridge.links.frame_sources.FrameSource` over /dev/video... in grey."""

    def __init__(self, device: str, path: str, form: RawFormat) -> None:
        self._device, self.name, self._form = device, path, form
        self._fd = -1
        self._line_bytes = 0
        self._maps: list[mmap.mmap] = []

    def open(self) -> None:
        """See the protocol. Raises ReplyWrong if the device has no grey format of this shape."""
        self.close()
        try:
            self._fd = os.open(self.name, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
            self._set_format()
            self._map_buffers()
            fcntl.ioctl(self._fd, STREAM_ON, struct.pack("@I", CAPTURE))
        except OSError as error:
            self.close()
            raise self._gone("cannot open", error) from error
        except ReplyWrong:
            self.close()
            raise

    def close(self) -> None:
        """See the protocol."""
        for mapped in self._maps:
            mapped.close()
        self._maps = []
        if self._fd >= 0:
            os.close(self._fd)  # stops the stream too
        self._fd = -1

    def discard(self) -> None:
        """See the protocol."""
        try:
            for _ in range(BUFFERS):
                self._give_back(self._take()[0])
        except BlockingIOError:
            return
        except OSError as error:
            raise self._gone("cannot read", error) from error

    def read(self, timeout_s: float) -> RawFrame:
        """See the protocol; a damaged frame (the driver's word) or a short one raises ReplyWrong."""
        until_s = time.monotonic() + timeout_s
        try:
            index, size, flags, number = self._wait(until_s)
            data = bytes(self._maps[index][:size])
            self._give_back(index)
        except TimeoutError:
            what = f"no frame from {self.name} in {timeout_s:.3g} s"
            raise NoReply(self._device, what, "check trigger and camera") from None
        except OSError as error:
            raise self._gone("cannot read", error) from error
        return self._frame(data, flags, number)

    def _frame(self, data: bytes, flags: int, number: int) -> RawFrame:
        wanted = self._line_bytes * self._form.height_px
        if flags & FLAG_ERROR or len(data) < wanted:
            what = f"{self.name} gave {len(data)} bytes of {wanted}" + (", damaged" if flags & FLAG_ERROR else "")
            raise ReplyWrong(self._device, what, "check the camera's cable")
        lines = np.frombuffer(data, np.uint8, wanted).reshape(self._form.height_px, self._line_bytes)
        pixels = lines[:, : self._form.width_px * self._form.bits // 8]
        return RawFrame(self._form.decode(pixels.tobytes()).image, number)

    def _set_format(self) -> None:
        form, code = self._form, PIXEL_FORMATS[self._form.bits]
        wanted = FORMAT.pack(CAPTURE, form.width_px, form.height_px, code, FIELD_NONE, *[0] * 8)
        _, width_px, height_px, got, _, self._line_bytes, *_ = FORMAT.unpack(self._call(SET_FORMAT, wanted))
        if (width_px, height_px, got) != (form.width_px, form.height_px, code):
            what = f"{self.name} gives {width_px} x {height_px} {got.decode(errors='replace').strip()}"
            asked = f"{form.width_px} x {form.height_px} {code.decode().strip()}"
            raise ReplyWrong(self._device, f"{what}, not {asked}", "see v4l2-ctl --list-formats-ext for what it has")

    def _map_buffers(self) -> None:
        count, *_ = REQUEST.unpack(self._call(REQUEST_BUFFERS, REQUEST.pack(BUFFERS, CAPTURE, MEMORY_MAP, 0, 0)))
        for index in range(count):
            described = BUFFER.unpack(self._call(QUERY_BUFFER, _buffer(index)))
            offset, length = described[10] & 0xFFFFFFFF, described[11]
            self._maps.append(mmap.mmap(self._fd, length, offset=offset))
            self._give_back(index)

    def _take(self) -> tuple[int, int, int, int]:
        """Index, bytes used, flags and frame number of the oldest full buffer. Raises BlockingIOError if none is."""
        taken = BUFFER.unpack(self._call(TAKE_BUFFER, _buffer(0)))
        return taken[0], taken[2], taken[3], taken[8]

    def _give_back(self, index: int) -> None:
        self._call(QUEUE_BUFFER, _buffer(index))

    def _call(self, request: int, argument: bytes) -> bytes:
        if self._fd < 0:
            raise DeviceGone(self._device, "not open", "open it first")
        return fcntl.ioctl(self._fd, request, argument)

    def _wait(self, until_s: float) -> tuple[int, int, int, int]:
        """As :meth:`_take`, waiting for it. Raises TimeoutError."""
        if self._fd < 0:
            raise DeviceGone(self._device, "not open", "open it first")
        poll = select.poll()
        poll.register(self._fd, select.POLLIN)
        while True:
            ready = poll.poll(max(until_s - time.monotonic(), 0.0) * 1000)
            if ready and ready[0][1] & (select.POLLERR | select.POLLHUP | select.POLLNVAL):
                raise OSError(errno.ENODEV, os.strerror(errno.ENODEV))
            if ready:
                # Some drivers say that a frame is ready when none is.
                with contextlib.suppress(BlockingIOError):
                    return self._take()
            if time.monotonic() >= until_s:
                raise TimeoutError

    def _gone(self, what: str, error: OSError) -> DeviceGone:
        return DeviceGone(self._device, f"{what} {self.name}: {reason(error)}", "check the camera's cable and driver")


def _buffer(index: int) -> bytes:
    return BUFFER.pack(index, CAPTURE, 0, 0, 0, 0, 0, b"", 0, MEMORY_MAP, 0, 0, 0, 0)
