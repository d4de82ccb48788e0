"""Lit pixels of a dark frame and the components they form, at the cost of one pass over memory.

The pass takes each row's maximum; only rows that reach the threshold are looked at again, and from there on the
work is in proportion to what is lit. The loops are in `_kernel.c`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from inspector.detect import kernel
from inspector.model import FloatArray, Image, IntArray

TILE_ROWS, TILE_COLUMNS, SAMPLES = 6, 8, 8
"""The background is taken in 6 x 8 tiles from 8 x 8 samples of each: 3072 pixels say enough of a smooth panel."""
LEAST_NOISE_DN = 0.5
"""Noise assumed at the least: quantisation hides what is smaller."""


@dataclass(frozen=True)
class Background:
    """The dark panel: median grey value of each tile (rows, columns) DN, noise (standard deviation) and black DN."""

    tiles_dn: FloatArray
    noise_dn: float
    black_dn: float

    @property
    def level_dn(self) -> float:
        """The whole frame's background, DN."""
        return float(np.median(self.tiles_dn))

    def flat(self) -> bool:
        """True where one threshold serves the whole frame."""
        return float(np.ptp(self.tiles_dn)) <= 3 * self.noise_dn

    def at(self, rows: IntArray, columns: IntArray, shape: tuple[int, int]) -> FloatArray:
        """Background (n,) DN at pixels, bilinear between tile centres and constant beyond them."""
        r, c = (_tile_position(i, n, k) for i, n, k in zip((rows, columns), shape, self.tiles_dn.shape, strict=True))
        r0, c0 = (np.minimum(x.astype(np.intp), max(k - 2, 0)) for x, k in zip((r, c), self.tiles_dn.shape, strict=True))
        r1, c1 = (np.minimum(x + 1, k - 1) for x, k in zip((r0, c0), self.tiles_dn.shape, strict=True))
        t, fr, fc = self.tiles_dn, r - r0, c - c0
        return (t[r0, c0] * (1 - fr) + t[r1, c0] * fr) * (1 - fc) + (t[r0, c1] * (1 - fr) + t[r1, c1] * fr) * fc


def _tile_position(index: IntArray, length: int, tiles: int) -> FloatArray:
    """Where pixels lie between tile centres, in tiles, clipped to the outermost centres."""
    return np.clip((index + 0.5) * tiles / length - 0.5, 0, tiles - 1)


def background(image: Image) -> Background:
    """Estimate the background from a grid of samples: tile medians, noise from differences between neighbouring pixels."""
    height, width = image.shape
    down, right = max(height // (TILE_ROWS * SAMPLES), 1), max(width // (TILE_COLUMNS * SAMPLES), 1)
    sample = image[down // 2 :: down, right // 2 :: right]
    tiles_r, tiles_c = min(len(sample), TILE_ROWS), min(sample.shape[1], TILE_COLUMNS)
    deep, wide = sample.shape[0] // tiles_r, sample.shape[1] // tiles_c
    sample = sample[: deep * tiles_r, : wide * tiles_c]
    blocks = np.sort(sample.reshape(tiles_r, deep, tiles_c, wide).swapaxes(1, 2).reshape(tiles_r, tiles_c, -1), axis=2)
    tiles = blocks[:, :, deep * wide // 2].astype(np.float64)
    return Background(tiles, max(_noise(image, down, right), LEAST_NOISE_DN), float(blocks[:, :, 0].min()))


def _noise(image: Image, down: int, right: int) -> float:
    """Standard deviation of single pixels, DN, from neighbours on a grid: they differ by noise, whatever the shading.

    The mean of |differences| of a Gaussian is 2/sqrt(pi) standard deviations, and unlike a median it sees through
    rounding; the few that highlights make large are cut at three times the mean.
    """
    left = image[down // 2 :: down, right // 2 : -1 : right].astype(np.int32)
    step = np.abs(left - image[down // 2 :: down, right // 2 + 1 :: right][:, : left.shape[1]])
    if step.size == 0:
        return 0.0
    return float(np.minimum(step, 3 * step.mean() + 1).mean()) * float(np.sqrt(np.pi)) / 2


@dataclass(frozen=True)
class Lit:
    """Lit pixels in row-major order: rows, columns, grey (n,), and the component (n,) each belongs to."""

    rows: IntArray
    columns: IntArray
    grey_dn: FloatArray
    component: IntArray
    count: int
    threshold_dn: float


def find(image: Image, thresholds_dn: FloatArray, most_share: float) -> Lit | None:
    """The pixels above thresholds given at tile centres; None if they are more than this share of the frame."""
    found = kernel.lit(image, thresholds_dn, int(most_share * image.size) + 1)
    if found is None:
        return None
    rows, columns, grey = found
    label = kernel.components(rows, columns)
    return Lit(rows, columns, grey, label, int(label.max(initial=-1)) + 1, float(thresholds_dn.max()))
