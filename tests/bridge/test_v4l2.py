"""Frames over Video4Linux's own interface, against a kernel's side of it that is played here over real memory."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from firmware_bridge import errors
from firmware_bridge.links import v4l2
from firmware_bridge.links.v4l2 import BUFFER, FORMAT, REQUEST, V4l2Source
from firmware_bridge.wire.raw_frames import RawFormat

WIDTH_PX, HEIGHT_PX, LINE_BYTES = 6, 4, 8
"""Drivers pad lines: so does this one, by two bytes."""

PAGE = os.sysconf("SC_PAGE_SIZE")


class Kernel:
    """What answers the requests: buffers in a file, and a frame for each that is queued here."""

    def __init__(self, path: Path) -> None:
        self.path = path
        path.write_bytes(bytes(PAGE * v4l2.BUFFERS))
        self.code = b"GREY"
        self.queued: deque[int] = deque()
        self.full: deque[bytes] = deque()
        self.streaming = self.gone = False

    def show(self, number: int, level: int, *, flags: int = 0, size: int = LINE_BYTES * HEIGHT_PX) -> None:
        index = self.queued.popleft()
        with self.path.open("r+b") as memory:
            memory.seek(index * PAGE)
            memory.write((bytes([level]) * WIDTH_PX + b"\xee\xee") * HEIGHT_PX)
        self.full.append(BUFFER.pack(index, 1, size, flags, 0, 0, 0, b"", number, 1, index * PAGE, PAGE, 0, 0))

    def ioctl(self, fd: int, request: int, argument: bytes) -> bytes:
        if self.gone:
            raise OSError(19, "No such device")
        if request == v4l2.SET_FORMAT:
            return FORMAT.pack(1, WIDTH_PX, HEIGHT_PX, self.code, 1, LINE_BYTES, LINE_BYTES * HEIGHT_PX, *[0] * 6)
        if request == v4l2.REQUEST_BUFFERS:
            return REQUEST.pack(v4l2.BUFFERS, 1, 1, 0, 0)
        index = BUFFER.unpack(argument)[0] if len(argument) == BUFFER.size else 0
        if request == v4l2.QUERY_BUFFER:
            return BUFFER.pack(index, 1, 0, 0, 0, 0, 0, b"", 0, 1, index * PAGE, PAGE, 0, 0)
        if request == v4l2.QUEUE_BUFFER:
            self.queued.append(index)
            return argument
        if request == v4l2.TAKE_BUFFER:
            if not self.full:
                raise BlockingIOError
            return self.full.popleft()
        assert request == v4l2.STREAM_ON
        self.streaming = True
        return argument


@pytest.fixture
def kernel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Kernel:
    played = Kernel(tmp_path / "video0")
    monkeypatch.setattr(v4l2.fcntl, "ioctl", played.ioctl)
    return played


@pytest.fixture
def source(kernel: Kernel) -> Iterator[V4l2Source]:
    made = V4l2Source("camera", str(kernel.path), RawFormat(WIDTH_PX, HEIGHT_PX, 8))
    yield made
    made.close()


def test_frames_come_in_order_without_the_lines_padding(kernel: Kernel, source: V4l2Source) -> None:
    source.open()
    assert kernel.streaming
    for number in (0, 1, 5, 6, 7, 8):
        kernel.show(number, 10 + number)
        frame = source.read(1.0)
        assert frame.number == number
        assert np.array_equal(frame.image, np.full((HEIGHT_PX, WIDTH_PX), 10 + number, np.uint8))
    assert len(kernel.queued) == v4l2.BUFFERS, "every buffer was given back"


def test_what_had_come_is_thrown_away(kernel: Kernel, source: V4l2Source) -> None:
    source.open()
    kernel.show(1, 1)
    kernel.show(2, 2)
    source.discard()
    kernel.show(3, 3)
    assert source.read(1.0).number == 3


@pytest.mark.parametrize(("fault", "says"), [({"flags": v4l2.FLAG_ERROR}, "damaged"), ({"size": 20}, "20 bytes of 32")])
def test_damaged_and_short_frames_are_told(kernel: Kernel, source: V4l2Source, fault: Any, says: str) -> None:
    source.open()
    kernel.show(1, 1, **fault)
    with pytest.raises(errors.ReplyWrong, match=says):
        source.read(1.0)
    kernel.show(2, 2)
    assert source.read(1.0).number == 2


def test_no_frame_is_told_in_time(kernel: Kernel, source: V4l2Source) -> None:
    source.open()
    with pytest.raises(errors.NoReply, match=r"no frame from .*video0 in 0.05 s; check trigger"):
        source.read(0.05)


def test_another_format_is_refused(kernel: Kernel, source: V4l2Source, descriptors: Any) -> None:
    before, kernel.code = descriptors(), b"YUYV"
    with pytest.raises(errors.ReplyWrong, match="gives 6 x 4 YUYV, not 6 x 4 GREY; see v4l2-ctl"):
        source.open()
    assert descriptors() == before


def test_a_device_that_goes_or_is_none_is_told(kernel: Kernel, source: V4l2Source, monkeypatch: Any) -> None:
    source.open()
    kernel.gone = True
    for use in (source.discard, lambda: source.read(1.0), source.open):
        with pytest.raises(errors.DeviceGone, match=r"video0: No such device; check the camera's cable"):
            use()
    monkeypatch.undo()
    with pytest.raises(errors.DeviceGone, match="Inappropriate ioctl"):
        source.open()
    missing = V4l2Source("camera", str(kernel.path.with_name("none")), RawFormat(6, 4, 8))
    with pytest.raises(errors.DeviceGone, match="No such file"):
        missing.open()


def test_it_closes_twice_and_opens_again_and_leaves_nothing_behind(
    kernel: Kernel, source: V4l2Source, descriptors: Any
) -> None:
    before = descriptors()
    for _ in range(10):
        kernel.queued.clear()
        source.open()
        source.close()
        source.close()
    assert descriptors() == before
    for use in (source.discard, lambda: source.read(1.0)):
        with pytest.raises(errors.DeviceGone, match="not open"):
            use()
