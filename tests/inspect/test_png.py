"""PNG files of any filter, depth and size give the pixels that were put in, whichever way they are decoded."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from firmware_bridge.wire import image
from inspector.model import Image

IMAGES = st.sampled_from([np.uint8, np.uint16]).flatmap(
    lambda kind: arrays.arrays(kind, st.tuples(st.integers(1, 5), st.integers(1, 7) | st.integers(15, 37)))
)


def paeth(left: int, above: int, corner: int) -> int:
    """The predictor of that name (PNG specification, 9.4)."""
    away = [(abs(left + above - corner - value), value) for value in (left, above, corner)]
    return min(away, key=lambda pair: pair[0])[1]


def filtered(pixels: Image, kinds: Sequence[int]) -> bytes:
    """The rows' bytes, each less what its filter foretells: 0 nothing, 1 left, 2 above, 3 their mean, 4 Paeth."""
    depth, out = pixels.dtype.itemsize, bytearray()
    rows = [list(row.astype(pixels.dtype.newbyteorder(">")).tobytes()) for row in pixels]
    for y, (row, kind) in enumerate(zip(rows, kinds, strict=True)):
        over = rows[y - 1] if y else [0] * len(row)
        out.append(kind)
        for x, byte in enumerate(row):
            left, corner = (row[x - depth], over[x - depth]) if x >= depth else (0, 0)
            told = (0, left, over[x], (left + over[x]) // 2, paeth(left, over[x], corner))[kind]
            out.append((byte - told) % 256)
    return bytes(out)


def chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def png(pixels: Image, raw: bytes, *more: bytes) -> bytes:
    """A file of these filtered rows, their bytes in two chunks."""
    height, width = pixels.shape
    header = struct.pack(">IIBBBBB", width, height, 8 * pixels.dtype.itemsize, 0, 0, 0, 0)
    packed = zlib.compress(raw)
    parts = (chunk(b"IDAT", packed[:3]), chunk(b"IDAT", packed[3:]))
    return b"".join([image.PNG, chunk(b"IHDR", header), *more, *parts, chunk(b"IEND", b"")])


@given(IMAGES, st.data())
def test_any_filter_gives_the_pixels_back(pixels: Image, data: st.DataObject) -> None:
    one = st.integers(0, 4).map(lambda kind: [kind] * len(pixels))
    each = st.lists(st.integers(0, 4), min_size=len(pixels), max_size=len(pixels))
    file = png(pixels, filtered(pixels, data.draw(one | each)))
    got = image.decode(file)
    assert got.dtype == pixels.dtype
    assert np.array_equal(got, pixels)


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_a_frame_as_opencv_writes_it_is_the_same(kind: type) -> None:
    pixels = np.random.default_rng(1).integers(0, 256, (40, 50)).astype(kind)
    assert np.array_equal(image.decode(cv2.imencode(".png", pixels)[1].tobytes()), pixels)


@given(IMAGES, st.data())
def test_whatever_rows_say_no_memory_is_written_beside_the_pixels(pixels: Image, data: st.DataObject) -> None:
    height, width, depth = *pixels.shape, pixels.dtype.itemsize
    raw = data.draw(st.binary(min_size=height * (1 + width * depth), max_size=height * (1 + width * depth)))
    size, edge = height * width * depth, 64
    room = np.full(size + 2 * edge, 0xA5, np.uint8)
    done = image._png_rows(raw, height, width, depth, room.ctypes.data + edge)
    known = [n <= 4 for n in raw[:: 1 + width * depth]]
    assert done == (known + [False]).index(False)
    assert (room[:edge] == 0xA5).all()
    assert (room[edge + max(done, 1) * width * depth :] == 0xA5).all()  # the first row is made ready before it is known


@given(IMAGES, st.data())
def test_a_damaged_stream_gives_an_image_or_is_refused(pixels: Image, data: st.DataObject) -> None:
    """Bytes changed or lost before the checksums are made, so that nothing but the inflating is to notice them."""
    packed = bytearray(zlib.compress(filtered(pixels, [1] * len(pixels))))
    for at in data.draw(st.lists(st.integers(0, len(packed) - 1), min_size=1, max_size=4)):
        packed[at] = data.draw(st.integers(0, 255))
    header = struct.pack(">IIBBBBB", *pixels.shape[::-1], 8 * pixels.dtype.itemsize, 0, 0, 0, 0)
    kept = packed[: data.draw(st.integers(0, len(packed)))]
    parts = (chunk(b"IHDR", header), chunk(b"IDAT", bytes(kept)), chunk(b"IEND", b""))
    try:
        got = image.decode(image.PNG + b"".join(parts))
    except image.ImageWrong:
        return
    assert (got.shape, got.dtype) == (pixels.shape, pixels.dtype)


@pytest.mark.parametrize("lost", [1, 9, 30])
def test_a_file_with_too_few_pixels_is_refused(lost: int) -> None:
    pixels = np.arange(30, dtype=np.uint8).reshape(5, 6)
    with pytest.raises(image.ImageWrong):
        image.decode(png(pixels, filtered(pixels, [1] * 5)[:-lost]))


def test_a_grey_image_with_a_transparent_value_is_not_passed_as_grey() -> None:
    pixels = np.arange(30, dtype=np.uint8).reshape(5, 6)
    file = png(pixels, filtered(pixels, [1] * 5), chunk(b"tRNS", b"\0\7"))
    before = cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_UNCHANGED)
    if before.ndim == 2:
        assert np.array_equal(image.decode(file), before)
    else:
        with pytest.raises(image.ImageWrong, match="colour"):
            image.decode(file)
