"""The compiled inner loops of detection (`_lit.c`, `_fit.c`, `_bloom.c`) with arrays for pointers."""

from __future__ import annotations

import struct
from ctypes import byref, c_double
from dataclasses import dataclass

import numpy as np

from inspector import native
from inspector.model import FloatArray, Image, IntArray
from inspector.native import out

_MODULE = "inspector.detect._kernel"
_components = native.function(_MODULE, "kernel_components", "ippp")
_detect = native.function(_MODULE, "kernel_detect", "ppiiiddipppppippp")
_fit = native.function(_MODULE, "kernel_fit", "ppippp")
_bloom_fit = native.function(_MODULE, "bloom_fit", "iiippddippippp")

SPOT_COLUMNS, FOUND_COLUMNS = 11, 16
"""Columns of the tables that `kernel_detect` and `kernel_fit` fill; the C files number them."""
LIT_ROOM, SPOT_ROOM = 4096, 256
"""Room for lit pixels and spots at first; a fuller frame is gone through again with as much as it needs."""


def packed(image: Image) -> Image:
    """The image with each row's pixels side by side and in native byte order; a copy only where it is needed."""
    if image.strides[1] == image.itemsize and image.dtype.isnative and image.strides[0] >= 0:
        return image
    return image.astype(np.uint8, order="C") if image.itemsize == 1 else image.astype(np.uint16, order="C")


def _packed_image(image: Image) -> bytes:
    """The image as the kernel takes it; ``image`` must be :func:`packed` and outlive the call."""
    return struct.pack("P4q", image.ctypes.data, image.itemsize, *image.shape, image.strides[0])


@dataclass(frozen=True)
class Detected:
    """Lit pixels (m,) in row-major order with their component and clipped plateau (-1: not clipped); spots (n, 11).

    The first ``plateaus`` spots are clipped plateaus, the others local maxima; ``largest`` is the frame's largest DN.
    """

    rows: IntArray
    columns: IntArray
    grey_dn: FloatArray
    component: IntArray
    plateau: IntArray
    spots: FloatArray
    components: int
    plateaus: int
    largest: float


def detect(
    image: Image, thresholds_dn: FloatArray, most: int, saturated_dn: float, hot_share: float
) -> Detected | None:
    """Pixels above thresholds given at tile centres (rows, columns), and the spots in them; None past ``most`` pixels.

    Between tile centres thresholds are bilinear, and go on straight beyond them. Raises MemoryError.
    """
    rows_of_tiles, columns_of_tiles = thresholds_dn.shape
    tiles = thresholds_dn.astype(np.float64).tobytes()
    room, spot_room = LIT_ROOM, SPOT_ROOM
    while True:
        places, grey, table = np.empty((4, room), np.int64), np.empty(room), np.empty((spot_room, SPOT_COLUMNS))
        counts, largest = np.zeros(4, np.int64), c_double()
        done = _detect(
            _packed_image(image), tiles, rows_of_tiles, columns_of_tiles, most, saturated_dn, hot_share, room,
            out(places[0]), out(places[1]), out(grey), out(places[2]), out(places[3]), spot_room, out(table),
            out(counts), byref(largest),
        )  # fmt: skip
        if done == -1:
            return None
        if done < 0:
            raise MemoryError("no memory for the frame's spots")
        lit, components, spots, plateaus = counts.tolist()
        if lit <= room and spots <= spot_room:
            rows, columns, component, plateau = places[:, :lit]
            return Detected(
                rows, columns, grey[:lit], component, plateau, table[:spots], components, plateaus, largest.value
            )
        room, spot_room = max(room, lit), max(spot_room, spots)


def components(rows: IntArray, columns: IntArray) -> IntArray:
    """8-connected component numbers (n,) of pixels given in row-major order, in order of first pixel.

    Raises MemoryError.
    """
    label = np.empty(len(rows), np.int64)
    if _components(len(rows), rows.astype(np.int64).tobytes(), columns.astype(np.int64).tobytes(), out(label)) < 0:
        raise MemoryError("no memory for the frame's components")
    return label


def fit(image: Image, rules: bytes, spots: FloatArray, typical: bytes) -> FloatArray:
    """Fit n spots given as rows (n, 6); what was found (n, 16). See fit.py. Raises MemoryError."""
    n = len(spots)
    found = np.empty((n, FOUND_COLUMNS))
    if _fit(_packed_image(image), rules, n, spots.tobytes(), typical, out(found)) < 0:
        raise MemoryError(f"no memory to fit {n} spots")
    return found


@dataclass(frozen=True)
class BloomFit:
    """Parameters (m,), their covariance (m, m), the sum of squares reached and each pixel's deviation (h, w)."""

    theta: FloatArray
    covariance: FloatArray
    cost: float
    deviation: FloatArray


def bloom_fit(
    light: FloatArray,
    weight: FloatArray,
    *,
    along_rows: bool,
    full_dn: float,
    end_variance: float,
    start: FloatArray,
    prior: FloatArray,
    rounds: int,
) -> BloomFit:
    """Fit spots and the overflow of their charge to a patch (h, w): `bloom_fit` of `_bloom.c`.

    ``start`` (3 k + 5,) and ``prior`` (inverse variances about it): k times x, y, log flux; level, slopes, log blur
    variance, kept. ``along_rows``: charge runs along a column. Raises MemoryError.
    """
    height, width = light.shape
    theta, m = start.copy(), len(start)
    covariance, deviation, cost = np.empty((m, m)), np.empty((height, width)), c_double()
    done = _bloom_fit(
        height, width, int(along_rows), light.tobytes(), weight.tobytes(), full_dn, end_variance, (m - 5) // 3,
        out(theta), prior.tobytes(), rounds, out(covariance), byref(cost), out(deviation),
    )  # fmt: skip
    if done < 0:
        raise MemoryError("no memory to fit a bloomed patch")
    return BloomFit(theta, covariance, cost.value, deviation)
