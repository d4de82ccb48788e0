"""Packed grey values against the formats' definitions, bit by bit."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_bridge.camera_settings import GenicamCameraSettings
from firmware_bridge.wire.image import ImageWrong
from firmware_bridge.wire.pixel_formats import FORMATS, unpack


def packed(name: str, values: list[int], bits: int) -> bytes:
    """The bytes of values, from the words of PFNC 2.4 and, for the formats named Packed, of GigE Vision 1.2."""
    if name.endswith("Packed"):
        data = bytearray()
        for first, second in zip(values[::2], [*values[1::2], *[0] * (len(values) % 2)], strict=True):
            low = (1 << (bits - 8)) - 1
            data += bytes([first >> (bits - 8), first & low | (second & low) << 4, second >> (bits - 8)])
        return bytes(data[: (len(values) * 12 + 7) // 8])
    width = bits if name.endswith("p") else -(-bits // 8) * 8
    stream = sum(value << at * width for at, value in enumerate(values))
    return stream.to_bytes((len(values) * width + 7) // 8, "little")


@pytest.mark.parametrize("name", FORMATS)
@settings(max_examples=40, deadline=None)
@given(data=st.data())
def test_what_was_packed_comes_back(name: str, data: st.DataObject) -> None:
    row = FORMATS[name]
    width_px, height_px = data.draw(st.integers(1, 9)), data.draw(st.integers(1, 5))
    count = width_px * height_px
    values = data.draw(st.lists(st.integers(0, (1 << row.bits) - 1), min_size=count, max_size=count))
    image = unpack(row.code, packed(name, values, row.bits), width_px, height_px)
    assert image.dtype == (np.uint8 if row.bits == 8 else np.uint16)
    assert image.flags.c_contiguous
    assert image.flags.writeable
    assert image.tolist() == np.reshape(values, (height_px, width_px)).tolist()


@pytest.mark.parametrize(("name", "data", "values"), [
    ("Mono12Packed", b"\xab\x6c\x45", [0xABC, 0x456]),
    ("Mono12p", b"\xbc\x6a\x45", [0xABC, 0x456]),
    ("Mono10Packed", b"\xff\x12\x80", [0x3FE, 0x201]),
    ("Mono10p", b"\xff\x03\x00\x00\xff", [0x3FF, 0, 0, 0x3FC]),
    ("Mono12", b"\xbc\x0a\x56\x04", [0xABC, 0x456]),
])  # fmt: skip
def test_examples(name: str, data: bytes, values: list[int]) -> None:
    assert unpack(FORMATS[name].code, data, len(values), 1).tolist() == [values]


@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize("change", [-1, 1])
def test_another_number_of_bytes_is_refused(name: str, change: int) -> None:
    row = FORMATS[name]
    size = row.size_bytes(7, 3)
    with pytest.raises(ImageWrong, match=rf"holds {size + change} bytes, not the {size} of 7 x 3 {name}"):
        unpack(row.code, bytes(size + change), 7, 3)


def test_another_format_is_refused() -> None:
    with pytest.raises(ImageWrong, match="pixel format 0x02180014; set the camera to one of Mono8, Mono10"):
        unpack(0x02180014, bytes(3), 1, 1)


def test_settings_name_every_format() -> None:
    assert get_args(GenicamCameraSettings.model_fields["pixel_format"].annotation) == tuple(FORMATS)
