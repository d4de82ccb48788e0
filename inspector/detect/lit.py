"""Lit pixels of a dark frame and the components they form, at the cost of one pass over memory.

The pass takes each row's maximum; only rows that reach the threshold are looked at again, and from there on the
work is in proportion to what is lit.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

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
    rows, columns = (
        np.linspace(0, n - 1, min(n, tiles * SAMPLES)).astype(np.intp)
        for n, tiles in zip(image.shape, (TILE_ROWS, TILE_COLUMNS), strict=True)
    )
    sample = image[np.ix_(rows, columns)].astype(np.float64)
    step = sample - image[np.ix_(rows, np.maximum(columns - 1, 0))]
    tiles_r, tiles_c = (min(k, t) for k, t in zip(sample.shape, (TILE_ROWS, TILE_COLUMNS), strict=True))
    deep, wide = len(rows) // tiles_r, len(columns) // tiles_c
    blocks = sample[: deep * tiles_r, : wide * tiles_c].reshape(tiles_r, deep, tiles_c, wide).swapaxes(1, 2)
    tiles = np.median(blocks.reshape(tiles_r, tiles_c, -1), axis=2)
    # Neighbours differ by noise alone, whatever the panel's shading. The largest 5 % may be highlights; the mean of the
    # other |differences| of a Gaussian is 1.0137 standard deviations, and unlike a median it sees through rounding.
    steps = np.sort(np.abs(step[:, 1:]), axis=None)
    spread = float(steps[: max(int(0.95 * len(steps)), 1)].mean()) / 1.0137 if len(steps) else 0.0
    return Background(tiles, max(spread, LEAST_NOISE_DN), float(np.quantile(sample, 0.002)))


@dataclass(frozen=True)
class Lit:
    """Lit pixels in row-major order: rows, columns, grey (n,), and the component (n,) each belongs to."""

    rows: IntArray
    columns: IntArray
    grey_dn: FloatArray
    component: IntArray
    count: int
    threshold_dn: float


def above(
    image: Image, row_peaks: npt.NDArray[np.generic], threshold_dn: float, most: float
) -> tuple[IntArray, IntArray] | None:
    """Rows and columns of pixels above a threshold; None if they are more than the share ``most`` of the frame.

    ``row_peaks`` (H,) is each row's maximum: the one pass over the frame's memory.
    """
    rows = np.flatnonzero(row_peaks > threshold_dn)
    return _where(image[rows] > threshold_dn, rows, most * image.size)


def above_background(
    image: Image, row_peaks: npt.NDArray[np.generic], ground: Background, rise_dn: float, most: float
) -> tuple[IntArray, IntArray] | None:
    """The same above an uneven background: a row is looked at where its maximum tops its darkest tile."""
    height, width = image.shape
    everywhere = np.arange(height)
    darkest = ground.tiles_dn.min(axis=1)
    low = np.interp((everywhere + 0.5) * len(darkest) / height - 0.5, np.arange(len(darkest)), darkest)
    rows = everywhere[row_peaks > low + rise_dn]
    tops = np.empty((len(rows), width), image.dtype)
    grid = cv2.resize(ground.tiles_dn.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    np.floor(np.minimum(grid[rows] + rise_dn, np.iinfo(image.dtype).max), out=tops, casting="unsafe")
    return _where(image[rows] > tops, rows, most * image.size)


def _where(lit: npt.NDArray[np.bool_], rows: IntArray, most: float) -> tuple[IntArray, IntArray] | None:
    """Frame coordinates of what is lit in the chosen rows, unless there is too much of it."""
    if np.count_nonzero(lit) > most:
        return None
    which, columns = np.nonzero(lit)
    return rows[which], columns


def components(rows: IntArray, columns: IntArray, width: int) -> IntArray:
    """8-connected component numbers (n,) of pixels given in row-major order; numbered in order of first pixel.

    Runs of neighbouring pixels are joined with the runs they touch in the row above; labels then fall to the least
    number reachable (min-label propagation with pointer jumping).
    """
    if len(rows) == 0:
        return np.empty(0, np.intp)
    stride = width + 2  # two columns of air, so that a row's end never touches the next row's start
    flat = rows * stride + columns
    new_run = np.empty(len(flat), np.bool_)
    new_run[0] = True
    np.not_equal(flat[1:], flat[:-1] + 1, out=new_run[1:])
    run_of_pixel = np.cumsum(new_run) - 1
    first = flat[new_run]
    last = flat[np.append(np.flatnonzero(new_run)[1:] - 1, len(flat) - 1)]
    lowest = np.searchsorted(last, first - stride - 1)
    beyond = np.searchsorted(first, last - stride + 1, side="right")
    touching = np.maximum(beyond - lowest, 0)
    below = np.repeat(np.arange(len(first)), touching)
    above = np.repeat(lowest - np.cumsum(touching) + touching, touching) + np.arange(touching.sum())
    return least_labels(len(first), above, below)[run_of_pixel]


def least_labels(count: int, a: IntArray, b: IntArray) -> IntArray:
    """Consecutive labels (count,) of the connected components of a graph with edges a-b."""
    label = np.arange(count)
    while True:
        lower = np.minimum(label[a], label[b])
        new = label.copy()
        np.minimum.at(new, label[a], lower)
        np.minimum.at(new, label[b], lower)
        np.minimum.at(new, a, lower)
        np.minimum.at(new, b, lower)
        new = new[new]
        if np.array_equal(new, label):
            return np.unique(label, return_inverse=True)[1]
        label = new
