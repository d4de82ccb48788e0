"""Lit pixels of a dark frame and the components they form, at the cost of one pass over memory.

The pass takes each row's maximum; only rows that reach the threshold are looked at again, and from there on the
work is in proportion to what is lit. The loops are in `_lit.c` and `_background.c`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from firmware_bridge import native
from firmware_bridge.native import out
from inspector.detect.kernel import Pixels
from inspector.model import FloatArray

TILE_ROWS, TILE_COLUMNS, SAMPLES = 6, 8, 8
"""The background is taken in 6 x 8 tiles from 8 x 8 samples of each: 3072 pixels say enough of a smooth panel."""
LEAST_NOISE_DN = 0.5
"""Noise assumed at the least: quantisation hides what is smaller."""
HALF_ROOT_PI = math.sqrt(math.pi) / 2

_background = native.function("inspector.detect._kernel", "background_of", "piiiiiipp")


@dataclass(frozen=True)
class Background:
    """The dark panel: median grey value of each tile (rows, columns) DN, noise (standard deviation) and black DN.

    ``level_dn`` is the whole frame's, the median of the tiles; ``darkest_dn`` and ``brightest_dn`` their extremes.
    """

    tiles_dn: FloatArray
    noise_dn: float
    black_dn: float
    level_dn: float
    darkest_dn: float
    brightest_dn: float

    def flat(self) -> bool:
        """True where one threshold serves the whole frame."""
        return self.brightest_dn - self.darkest_dn <= 3 * self.noise_dn


def background(pixels: Pixels) -> Background:
    """Estimate the background of an image (H, W), not empty, from samples. Raises MemoryError.

    The tiles are medians. The noise comes from neighbouring pixels: they differ by noise, whatever the shading. The
    mean of |differences| of a Gaussian is 2/sqrt(pi) standard deviations, and unlike a median it sees through rounding;
    the few that highlights make large are cut at three times the mean.
    """
    (down, rows, deep), (right, columns, wide) = _grid(pixels.image.shape)
    tiles, told = np.empty((rows, columns)), np.empty(5)
    if _background(pixels.described, down, right, rows, columns, deep, wide, out(tiles), out(told)) < 0:
        raise MemoryError("no memory for the frame's background")
    black, step, level, darkest, brightest = told.tolist()
    return Background(tiles, max(step * HALF_ROOT_PI, LEAST_NOISE_DN), black, level, darkest, brightest)


@lru_cache(maxsize=4)
def _grid(shape: tuple[int, int]) -> tuple[tuple[int, int, int], tuple[int, int, int]]:
    """Down and across: the step between samples, how many tiles, how many samples in each. Kept for the latest few."""
    return _samples(shape[0], TILE_ROWS), _samples(shape[1], TILE_COLUMNS)


def _samples(length: int, tiles: int) -> tuple[int, int, int]:
    """Along one side: the step between samples, how many tiles, and how many samples in each."""
    step = max(length // (tiles * SAMPLES), 1)
    count = len(range(step // 2, length, step))
    return step, min(count, tiles), count // min(count, tiles)
