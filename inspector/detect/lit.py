"""Lit pixels of a dark frame and the components they form, at the cost of one pass over memory.

The pass takes each row's maximum; only rows that reach the threshold are looked at again, and from there on the
work is in proportion to what is lit. The loops are in `_lit.c` and `_background.c`.
"""

from __future__ import annotations

import math
from ctypes import byref, c_double
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from inspector import native
from inspector.model import FloatArray, Image, IntArray
from inspector.native import out

TILE_ROWS, TILE_COLUMNS, SAMPLES = 6, 8, 8
"""The background is taken in 6 x 8 tiles from 8 x 8 samples of each: 3072 pixels say enough of a smooth panel."""
LEAST_NOISE_DN = 0.5
"""Noise assumed at the least: quantisation hides what is smaller."""
HALF_ROOT_PI = math.sqrt(math.pi) / 2

_background = native.function("inspector.detect._background", "background_of", "piiiiiiiiiippp")
_at = native.function("inspector.detect._background", "background_at", "iiiipippp")


@dataclass(frozen=True)
class Background:
    """The dark panel: median grey value of each tile (rows, columns) DN, noise (standard deviation) and black DN."""

    tiles_dn: FloatArray
    noise_dn: float
    black_dn: float

    @cached_property
    def level_dn(self) -> float:
        """The whole frame's background, the median of the tiles, DN."""
        grey = sorted(self.tiles_dn.ravel().tolist())
        return float(grey[(len(grey) - 1) // 2] + grey[len(grey) // 2]) / 2

    def flat(self) -> bool:
        """True where one threshold serves the whole frame."""
        return float(self.tiles_dn.max() - self.tiles_dn.min()) <= 3 * self.noise_dn

    def at(self, rows: IntArray, columns: IntArray, shape: tuple[int, int]) -> FloatArray:
        """Background (n,) DN at pixels, bilinear between tile centres and straight on beyond them."""
        level = np.empty(len(rows))
        _at(
            *shape,
            *self.tiles_dn.shape,
            self.tiles_dn.tobytes(),
            len(rows),
            rows.tobytes(),
            columns.tobytes(),
            out(level),
        )
        return level


def background(image: Image) -> Background:
    """Estimate the background of a :func:`inspector.detect.kernel.packed` image (H, W), not empty, from samples.

    The tiles are medians. The noise comes from neighbouring pixels: they differ by noise, whatever the shading. The
    mean of |differences| of a Gaussian is 2/sqrt(pi) standard deviations, and unlike a median it sees through rounding;
    the few that highlights make large are cut at three times the mean.
    """
    (down, rows, deep), (right, columns, wide) = _grid(image.shape)
    tiles, darkest, step = np.empty((rows, columns)), c_double(), c_double()
    done = _background(
        image.ctypes.data, image.itemsize, *image.shape, image.strides[0], down, right, rows, columns, deep, wide,
        out(tiles), byref(darkest), byref(step),
    )  # fmt: skip
    if done < 0:
        raise MemoryError("no memory for the frame's background")
    return Background(tiles, max(step.value * HALF_ROOT_PI, LEAST_NOISE_DN), darkest.value)


@lru_cache(maxsize=4)
def _grid(shape: tuple[int, int]) -> tuple[tuple[int, int, int], tuple[int, int, int]]:
    """Down and across: the step between samples, how many tiles, how many samples in each. Kept for the latest few."""
    return _samples(shape[0], TILE_ROWS), _samples(shape[1], TILE_COLUMNS)


def _samples(length: int, tiles: int) -> tuple[int, int, int]:
    """Along one side: the step between samples, how many tiles, and how many samples in each."""
    step = max(length // (tiles * SAMPLES), 1)
    count = len(range(step // 2, length, step))
    return step, min(count, tiles), count // min(count, tiles)
