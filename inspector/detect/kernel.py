"""The compiled inner loops of detection (`_lit.c`, `_measure.c`, `_fit.c`, `_bloom.c`) with arrays for pointers."""

from __future__ import annotations

import struct
from ctypes import byref, c_double
from dataclasses import dataclass

import numpy as np

from firmware_bridge import native
from firmware_bridge.native import out
from inspector.model import FloatArray, Image, IntArray

_MODULE = "inspector.detect._kernel"
_detect = native.function(_MODULE, "kernel_detect", "ppiiiddippippp")
_measure = native.function(_MODULE, "kernel_measure", "piipppiipipppp")
_bloom_fit = native.function(_MODULE, "bloom_fit", "iiippddippippp")

SPOT_COLUMNS, FOUND_COLUMNS = 11, 16
"""Columns of the tables of spots and of what the fit found; `_kernel.h` numbers them."""
LIT_ROOM, SPOT_ROOM = 4096, 256
"""Room for lit pixels and spots at first; a fuller frame is gone through again with as much as it needs."""
_IMAGE = struct.Struct("P4q")


@dataclass(frozen=True)
class Pixels:
    """An image (H, W) with each row's pixels side by side, and the same as the C functions take it."""

    image: Image
    described: bytes
    """`Image` of `_kernel.h`: good as long as ``image`` is."""


def packed(image: Image) -> Pixels:
    """The image in native byte order, rows packed; a copy only where it is needed."""
    if not (image.strides[1] == image.itemsize and image.dtype.isnative and image.strides[0] >= 0):
        image = image.astype(np.uint8, order="C") if image.itemsize == 1 else image.astype(np.uint16, order="C")
    return Pixels(image, _IMAGE.pack(image.ctypes.data, image.itemsize, *image.shape, image.strides[0]))


@dataclass(frozen=True)
class Detected:
    """Lit pixels (m,) in row-major order with their component and clipped plateau (-1: not clipped); spots (n, 11).

    The first ``plateaus`` spots are clipped plateaus, the others local maxima; ``largest`` is the frame's largest DN.
    ``longest_px`` is the greatest extent of a plateau; ``mean_taller_px`` how much taller than wide they are on
    average, ``most_taller_px`` the largest size of that.
    """

    rows: IntArray
    columns: IntArray
    component: IntArray
    plateau: IntArray
    grey_dn: FloatArray
    spots: FloatArray
    components: int
    plateaus: int
    largest: float
    longest_px: float
    mean_taller_px: float
    most_taller_px: float


def detect(
    pixels: Pixels, thresholds_dn: FloatArray, most: int, saturated_dn: float, hot_share: float
) -> Detected | None:
    """Pixels above thresholds given at tile centres (rows, columns), and the spots in them; None past ``most`` pixels.

    Between tile centres thresholds are bilinear, and go on straight beyond them. Raises MemoryError.
    """
    given = (pixels.described, thresholds_dn.tobytes(), *thresholds_dn.shape, most, saturated_dn, hot_share)
    room, spot_room = LIT_ROOM, SPOT_ROOM
    while True:
        places, grey, table = np.empty((4, room), np.int64), np.empty(room), np.empty((spot_room, SPOT_COLUMNS))
        counts, told = np.zeros(4, np.int64), np.zeros(4)
        done = _detect(*given, room, out(places), out(grey), spot_room, out(table), out(counts), out(told))
        if done == -1:
            return None
        if done < 0:
            raise MemoryError("no memory for the frame's spots")
        lit, components, spots, plateaus = counts.tolist()
        if lit <= room and spots <= spot_room:
            rows, columns, component, plateau = places[:, :lit]
            return Detected(
                rows, columns, component, plateau, grey[:lit], table[:spots], components, plateaus, *told.tolist()
            )
        room, spot_room = max(room, lit), max(spot_room, spots)


@dataclass(frozen=True)
class Measured:
    """n spots: flags (n,), what the fit found (n, 16), and of it what is believed.

    That is: centres (n, 2), their covariance (n, 2, 2), flux (n,) and the deviation (n,) of its logarithm.
    """

    flags: IntArray
    found: FloatArray
    xy_px: FloatArray
    covariance_px2: FloatArray
    flux_dn: FloatArray
    flux_sigma: FloatArray


def measure(
    pixels: Pixels,
    tiles_dn: FloatArray,
    rules: bytes,
    standards: bytes,
    components: int,
    spots: FloatArray,
    start: FloatArray,
) -> Measured:
    """Flag and fit the spots of a table (n, 11). Raises MemoryError.

    ``tiles_dn`` (rows, columns) is the ground at tile centres; ``rules`` are fit.py's, ``standards`` highlights.py's.
    ``start`` (k, 16) is what an earlier fit found of the first k spots, NaN of one that starts anew.
    """
    n = len(spots)
    flags, found, believed = np.empty(n, np.int64), np.empty((n, FOUND_COLUMNS)), np.empty(8 * n)
    done = _measure(
        pixels.described, *tiles_dn.shape, tiles_dn.tobytes(), rules, standards, components, n, spots.tobytes(),
        len(start), start.tobytes(), out(flags), out(found), out(believed),
    )  # fmt: skip
    if done < 0:
        raise MemoryError(f"no memory to fit {n} spots")
    xy, covariance = believed[: 2 * n].reshape(n, 2), believed[2 * n : 6 * n].reshape(n, 2, 2)
    return Measured(flags, found, xy, covariance, believed[6 * n : 7 * n], believed[7 * n :])


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
