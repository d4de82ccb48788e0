"""Raw frames: the documented bytes, found again in any pieces and through noise."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_bridge.wire.raw_frames import FrameReader, RawFormat, RawFrame

IMAGE = np.arange(12, dtype=np.uint8).reshape(3, 4)
HEADED = RawFormat(4, 3, 8, header=True)


def test_pixels_are_rows_from_the_top_low_byte_first() -> None:
    assert RawFormat(4, 3, 8).encode(RawFrame(IMAGE)) == bytes(range(12))
    deep = IMAGE.astype(np.uint16) * 256 + 1
    assert RawFormat(4, 3, 16).encode(RawFrame(deep))[:4] == b"\x01\x00\x01\x01"
    (frame,) = FrameReader(RawFormat(4, 3, 16)).receive(b"\x01\x00\x01\x01" * 6)
    assert frame.image.dtype == np.uint16
    assert frame.image[0].tolist() == [1, 257, 1, 257]
    assert frame.number is frame.exposure_us is frame.taken_at_s is None


def test_the_header_is_as_documented() -> None:
    data = struct.pack("<4sIHHHHdd", b"CCDF", 7, 4, 3, 8, 0, 5000.0, 1.5e9) + bytes(range(12))
    assert HEADED.encode(RawFrame(IMAGE, 7, 5000.0, 1.5e9)) == data
    (frame,) = FrameReader(HEADED).receive(data)
    assert (frame.number, frame.exposure_us, frame.taken_at_s) == (7, 5000.0, 1.5e9)
    assert np.array_equal(frame.image, IMAGE)
    (unknown,) = FrameReader(HEADED).receive(HEADED.encode(RawFrame(IMAGE, 8)))
    assert unknown.exposure_us is unknown.taken_at_s is None


@pytest.mark.parametrize("noise", [b"", b"x", b"CCDF", b"CCDF" * 20, bytes(200), b"CCDFCCD", b"CC"])
@pytest.mark.parametrize("step", [1, 7, 1000])
def test_the_next_good_frame_is_found_after_noise(noise: bytes, step: int) -> None:
    good = b"".join(HEADED.encode(RawFrame(IMAGE, number)) for number in (1, 2))
    data = good + noise + good
    reader = FrameReader(HEADED)
    frames = [f for at in range(0, len(data), step) for f in reader.receive(data[at : at + step])]
    assert [frame.number for frame in frames] == [1, 2, 1, 2]
    assert reader.dropped_bytes == len(noise)


def test_a_frame_of_another_shape_is_noise() -> None:
    other = RawFormat(3, 4, 8, header=True).encode(RawFrame(IMAGE.reshape(4, 3), 1))
    reader = FrameReader(HEADED)
    assert reader.receive(other * 3) == []
    assert reader.dropped_bytes >= 3 * 32


@settings(max_examples=40, deadline=None)
@given(st.lists(st.one_of(st.binary(max_size=60), st.just(b"CCDF"), st.just(HEADED.encode(RawFrame(IMAGE, 1))))))
def test_random_streams_do_no_harm(pieces: list[bytes]) -> None:
    reader = FrameReader(HEADED)
    for piece in pieces:
        reader.receive(piece)
        assert reader.pending_bytes < HEADED.frame_bytes
    good = HEADED.encode(RawFrame(IMAGE, 9))
    assert reader.receive(bytes(HEADED.frame_bytes) + good)[-1].number == 9
