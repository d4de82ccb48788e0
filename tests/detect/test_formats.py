"""The same frame in every form that an array can have gives the same highlights, to the last bit."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from drawn import Drawing, lattice

from inspector.detect import highlights
from inspector.model import Highlights, Image
from inspector.optics import Sensor
from inspector.recipe import Detection


def read_only(image: Image) -> Image:
    image = image.copy()
    image.flags.writeable = False
    return image


def inside_a_larger_frame(image: Image) -> Image:
    larger = np.full((image.shape[0] + 20, image.shape[1] + 30), np.iinfo(image.dtype).max, image.dtype)
    larger[7:-13, 11:-19] = image
    return larger[7:-13, 11:-19]


def at_odd_addresses(image: Image) -> Image:
    stride = image.shape[1] * image.itemsize + 1
    memory = bytearray(1 + image.shape[0] * stride)
    odd: Image = np.ndarray(image.shape, image.dtype, memory, 1, (stride, image.itemsize))
    odd[:] = image
    return odd


def one_channel_of_three(image: Image) -> Image:
    return np.repeat(image[:, :, None], 3, axis=2)[:, :, 1]


FORMS: dict[str, Callable[[Image], Image]] = {
    "Fortran order": np.asfortranarray,
    "read-only": read_only,
    "inside a larger frame": inside_a_larger_frame,
    "at odd addresses": at_odd_addresses,
    "one channel of three": one_channel_of_three,
    "every second row": lambda image: np.repeat(image, 2, axis=0)[::2],
    "every second column": lambda image: np.repeat(image, 2, axis=1)[:, ::2],
    "turned back": lambda image: image[::-1, ::-1].copy()[::-1, ::-1],
    "big endian": lambda image: image.astype(image.dtype.newbyteorder(">")),
    "big endian, inside, read-only": lambda image: read_only(
        inside_a_larger_frame(image.astype(image.dtype.newbyteorder(">")))
    ),
    "unaligned": lambda image: np.frombuffer(b"x" + image.tobytes(), image.dtype, offset=1).reshape(image.shape),
}


def same(a: Highlights, b: Highlights) -> bool:
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in Highlights.__slots__)


@pytest.mark.parametrize("full_dn", [255.0, 65535.0], ids=["8 bits", "16 bits"])
@pytest.mark.parametrize("form", FORMS)
def test_any_stride_and_byte_order(form: str, full_dn: float) -> None:
    drawing = Drawing(shape=(240, 331), full_dn=full_dn)
    xy = lattice(6, 5, drawing.shape, np.random.default_rng(0))
    image = drawing.draw(xy, drawing.full_dn * np.linspace(0.2, 4, len(xy)))
    plain = highlights.find(image, Detection(), drawing.sensor)
    assert len(plain) == len(xy)
    given = FORMS[form](image)
    before = given.tobytes()
    assert same(highlights.find(given, Detection(), drawing.sensor), plain)
    assert given.tobytes() == before


@pytest.mark.parametrize("full_dn", [1023.0, 4095.0, 65535.0])
def test_depth_is_told_from_a_frame_under_the_8_bit_default(full_dn: float) -> None:
    """A 16-bit frame of 10, 12 or 16 bits whose calibration says nothing of its depth."""
    drawing = Drawing(shape=(240, 320), full_dn=full_dn)
    xy = lattice(6, 5, drawing.shape, np.random.default_rng(1))
    image = drawing.draw(xy, full_dn * np.linspace(0.4, 4, len(xy)))
    told = highlights.find(image, Detection(), Sensor(black_dn=3.0))
    assert same(told, highlights.find(image, Detection(), drawing.sensor))
