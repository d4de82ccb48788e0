"""Frames from a pipe or a file that the test itself writes: what is old is thrown away, what is half is told."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from firmware_bridge import errors
from firmware_bridge.links.frame_sources import RawSource
from firmware_bridge.wire.raw_frames import RawFormat, RawFrame

FORMS = {header: RawFormat(8, 6, 8, header) for header in (True, False)}


def frame(form: RawFormat, number: int) -> bytes:
    return form.encode(RawFrame(np.full((6, 8), number, np.uint8), number))


@pytest.fixture(params=FORMS.values(), ids=["headed", "bare"])
def form(request: pytest.FixtureRequest) -> RawFormat:
    made: RawFormat = request.param
    return made


@pytest.fixture
def piped(form: RawFormat, tmp_path: Path) -> Iterator[tuple[RawSource, int]]:
    """A source, open, and the end of its pipe that frames are written into."""
    path = tmp_path / "pipe"
    os.mkfifo(path)
    source = RawSource("camera", str(path), form)
    source.open()
    writer = os.open(path, os.O_WRONLY)
    yield source, writer
    source.close()
    os.close(writer)


def test_what_came_before_is_thrown_away_and_the_rest_of_a_half_frame_too(
    form: RawFormat, piped: tuple[RawSource, int]
) -> None:
    source, writer = piped
    os.write(writer, frame(form, 1) + frame(form, 2)[:20])
    source.discard()
    os.write(writer, frame(form, 2)[20:] + frame(form, 3))
    assert source.read(5.0).image[0, 0] == 3
    os.write(writer, frame(form, 4)[:-1])
    with pytest.raises(errors.ReplyWrong, match=f"gave {form.frame_bytes - 1} of a frame's {form.frame_bytes} bytes"):
        source.read(0.05)
    os.write(writer, frame(form, 5))
    assert source.read(5.0).image[0, 0] == 5


def test_frames_that_are_longer_than_they_should_be_are_told_and_shift_none(
    form: RawFormat, piped: tuple[RawSource, int]
) -> None:
    source, writer = piped
    for number in range(1, 5):
        os.write(writer, frame(form, number) + bytes(form.width_px))
        if form.header:  # the next header is found again, whatever stands before it
            assert (source.read(5.0).image == number).all()
            continue
        with pytest.raises(errors.ReplyWrong, match=f"gave 8 bytes beyond a frame's {form.frame_bytes}; check the fra"):
            source.read(5.0)
    os.write(writer, frame(form, 8) + frame(form, 9))
    assert [(source.read(5.0).image == number).all() for number in (8, 9)] == [True, True]


def test_opened_in_the_middle_of_a_frame_it_begins_with_the_next(form: RawFormat, piped: tuple[RawSource, int]) -> None:
    source, writer = piped
    os.write(writer, frame(form, 1)[40:])
    source.open()
    os.write(writer, frame(form, 2))
    assert source.read(5.0).image[0, 0] == 2


def test_without_a_writer_there_is_no_frame_and_then_there_is(form: RawFormat, tmp_path: Path) -> None:
    path = tmp_path / "pipe"
    os.mkfifo(path)
    source = RawSource("camera", str(path), form)
    source.open()
    with pytest.raises(errors.NoReply, match=r"no frame from .* in 0\.05 s"):
        source.read(0.05)
    path.write_bytes(frame(form, 1))
    assert source.read(5.0).image[0, 0] == 1
    with pytest.raises(errors.DeviceGone, match="closed by the other side"):
        source.read(5.0)
    source.close()
    with pytest.raises(errors.DeviceGone, match="not open"):
        source.discard()


def test_a_file_is_new_when_it_was_replaced_or_written_in_place(form: RawFormat, tmp_path: Path) -> None:
    path, fresh = tmp_path / "frame", tmp_path / "fresh"
    path.write_bytes(frame(form, 1))
    source = RawSource("camera", str(path), form)
    source.open()
    with pytest.raises(errors.NoReply, match="holds an old frame"):
        source.read(0.05)
    fresh.write_bytes(frame(form, 2))
    fresh.replace(path)
    assert source.read(5.0).image[0, 0] == 2
    # In two halves, in place: the first is no frame yet.
    with path.open("wb", buffering=0) as half:
        half.write(frame(form, 3)[:20])
        threading.Timer(0.05, lambda: path.write_bytes(frame(form, 3))).start()
        assert source.read(20.0).image[0, 0] == 3
    path.unlink()
    with pytest.raises(errors.DeviceGone, match="No such file"):
        source.read(5.0)
    source.close()
    with pytest.raises(errors.DeviceGone, match="not open"):
        source.read(5.0)
