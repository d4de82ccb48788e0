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
    width: int


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
    if len(a) == 0:
        return label
    while True:
        lower = np.minimum(label[a], label[b])
        new = label.copy()
        np.minimum.at(new, label[a], lower)
        np.minimum.at(new, label[b], lower)
        np.minimum.at(new, a, lower)
        np.minimum.at(new, b, lower)
        new = new[new]
        if (new == label).all():
            return (np.cumsum(label == np.arange(count)) - 1)[label]
        label = new
