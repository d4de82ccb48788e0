"""Lit components -> spots: one for each saturated lobe and each local maximum beside them."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from inspector.detect import kernel
from inspector.model import FloatArray, Image, IntArray

BLOOM_PX, BLOOM_LEAST_PX = 0.75, 2
"""Lobes longer by this much along one axis, on average, and one by so many pixels, tell of charge running over."""
LOBE_BLUR_PX, LOBE_REACH_PX = 0.8, 2
"""Saturated plateaus are blurred by this to show their lobes; the kernel's half size."""
SINGLE_PX = 4
"""Plateaus no longer than this are one spot's."""
LARGEST_PX = 400
"""Plateaus of more pixels are no spots, however they are parted."""
MOST_PARTED = 200
"""In a frame with more large plateaus none is parted: it is over-exposed beyond what the time is worth."""
PARTED_PX = 2.5
"""Runs of one spot have one middle; two that differ by more belong to two."""
SADDLE_SHARE = 0.965
"""Two lobes are two only where the blurred grey value between them falls below this share of the lower."""


X, Y, COMPONENT, SATURATED_PX, NARROW_PX, LONGER_PX, COMPONENT_PX, COMPONENT_X, COMPONENT_Y, AT_EDGE, IS_HOT = range(11)
"""Columns of a spot's row, as `_kernel.h` numbers them."""


@dataclass(frozen=True)
class Spots:
    """Where to fit n spots: those with a saturated lobe first, then the local maxima.

    ``table`` (n, 11): centre x, y px; component; clipped pixels; the lobe's lesser extent and how much it is taller
    than wide; its component's pixels and their plain centroid, whether that touches the frame's edge; whether it is
    hot.
    ``bloom``: rows and columns from a clipped pixel to where its charge ran over, (0, 0) if it did not.
    """

    table: FloatArray
    bloom: tuple[int, int]

    def __len__(self) -> int:
        return len(self.table)

    @property
    def centre_px(self) -> FloatArray:
        """Centres (n, 2) x, y before they are fitted."""
        return self.table[:, : Y + 1]

    @cached_property
    def component(self) -> IntArray:
        """Which component (n,) each lies in."""
        return self.table[:, COMPONENT].astype(np.intp)

    @cached_property
    def clipped(self) -> npt.NDArray[np.bool_]:
        """Which spots (n,) have clipped pixels."""
        return self.table[:, SATURATED_PX] > 0

    def with_more(self, hosts: IntArray, centre_px: FloatArray) -> Spots:
        """The same and one more spot in the component of each of the ``hosts`` (m,), at ``centre_px`` (m, 2)."""
        more = self.table[hosts]
        more[:, : Y + 1] = centre_px
        more[:, SATURATED_PX : LONGER_PX + 1] = more[:, IS_HOT:] = 0.0
        return replace(self, table=np.vstack([self.table, more]))


def find_spots(image: Image, found: kernel.Detected, saturated_dn: float) -> Spots:
    """The spots of a frame; pixels of at least ``saturated_dn`` count as clipped."""
    if found.longest_px <= SINGLE_PX:
        return Spots(found.spots, _bloom(found.mean_taller_px, found.most_taller_px))
    lobes = _lobes(image, found, saturated_dn)
    longer = lobes[:, LONGER_PX]
    bloom = _bloom(float(longer.mean()), float(np.abs(longer).max()))
    return Spots(np.vstack([lobes, found.spots[found.plateaus :]]), bloom)


def _lobes(image: Image, found: kernel.Detected, saturated_dn: float) -> FloatArray:
    """Rows of the table for the lobes of all plateaus: parted where they have a waist, or runs with two middles."""
    clipped = np.flatnonzero(found.plateau >= 0)
    rows, columns, plateau = found.rows[clipped], found.columns[clipped], found.plateau[clipped]
    part, parts = np.zeros(len(clipped), np.intp), np.ones(found.plateaus, np.intp)
    for k in _to_part(found.spots[: found.plateaus]):
        mine = np.flatnonzero(plateau == k)
        part[mine] = _parted(image, rows[mine], columns[mine], saturated_dn)
        parts[k] = part[mine].max() + 1
    lobe, count = part + (np.cumsum(parts) - parts)[plateau], int(parts.sum())
    host = np.zeros(count, np.intp)
    host[lobe] = plateau
    table = found.spots[host]
    size, tall, wide = np.bincount(lobe, minlength=count), _extent(lobe, rows, count), _extent(lobe, columns, count)
    table[:, X], table[:, Y] = np.bincount(lobe, columns, count) / size, np.bincount(lobe, rows, count) / size
    table[:, SATURATED_PX], table[:, NARROW_PX], table[:, LONGER_PX] = size, np.minimum(tall, wide), tall - wide
    return table


def _to_part(plateaus: FloatArray) -> list[int]:
    """Which plateaus, of these rows of the table, may be several spots'."""
    long = plateaus[:, NARROW_PX] + np.abs(plateaus[:, LONGER_PX]) > SINGLE_PX
    if np.count_nonzero(long) > MOST_PARTED:
        return []
    return np.flatnonzero(long & (plateaus[:, SATURATED_PX] <= LARGEST_PX)).tolist()


def _parted(image: Image, rows: IntArray, columns: IntArray, saturated_dn: float) -> IntArray:
    """Which lobe each pixel (n,) of one plateau belongs to."""
    lobe = _waisted(image, rows, columns, saturated_dn)
    return _parted_runs(_parted_runs(lobe, rows, columns), columns, rows)


def _waisted(image: Image, rows: IntArray, columns: IntArray, saturated_dn: float) -> IntArray:
    """Which lobe each pixel (n,) of one plateau belongs to: parted where it has a waist."""
    blurred = _blurred(image, rows, columns, saturated_dn)
    tops = _tops(rows, columns, blurred)
    at = np.column_stack([rows, columns]).astype(np.float64)
    kept: list[int] = []
    for t in tops[np.argsort(-blurred[tops], kind="stable")]:
        if all(_saddle(at, blurred, k, t) < SADDLE_SHARE * blurred[t] for k in kept):
            kept.append(int(t))
    distance = np.sum((at[:, None] - at[kept]) ** 2, axis=2)
    return np.unique(distance.argmin(axis=1), return_inverse=True)[1]


def _parted_runs(lobe: IntArray, along: IntArray, across: IntArray) -> IntArray:
    """Lobes (n,) parted where their runs' middles disagree: charge runs evenly both ways from one spot's centre.

    ``along`` and ``across`` (n,) are the pixels' coordinates along and across the runs.
    """
    result, count = lobe.copy(), int(lobe.max(initial=-1)) + 1
    for k in range(count):
        mine = np.flatnonzero(lobe == k)
        runs: dict[int, list[int]] = defaultdict(list)
        for a, c in zip(along[mine].tolist(), across[mine].tolist(), strict=True):
            runs[c].append(a)
        ends = [(min(run), max(run)) for run in runs.values()]
        middles = [(first + last) / 2 for first, last in ends]
        low, high = min(middles), max(middles)
        if high - low > PARTED_PX and max(last - first for first, last in ends) > high - low:
            result[mine[along[mine] > (low + high) / 2]] = count
            count += 1
    return result


def _blurred(image: Image, rows: IntArray, columns: IntArray, saturated_dn: float) -> FloatArray:
    """The image, clipped evenly, under a Gaussian at the given pixels (n,)."""
    span = np.arange(-LOBE_REACH_PX, LOBE_REACH_PX + 1)
    kernel = np.exp(-(span**2) / (2 * LOBE_BLUR_PX**2))
    height, width = image.shape
    r, c = rows[:, None] + span, columns[:, None] + span
    grey = image[np.clip(r, 0, height - 1)[:, :, None], np.clip(c, 0, width - 1)[:, None, :]]
    return np.asarray(np.einsum("nij,i,j->n", np.minimum(grey, saturated_dn).astype(np.float64), kernel, kernel))


EARLIER = ((-1, -1), (-1, 0), (-1, 1), (0, -1))
"""Rows and columns to the neighbours that come before a pixel in row-major order; the others lie opposite."""


def _tops(rows: IntArray, columns: IntArray, value: FloatArray) -> IntArray:
    """Indices of pixels that no neighbour of the same list exceeds; equals go to the first."""
    at = dict(zip(zip(rows.tolist(), columns.tolist(), strict=True), value.tolist(), strict=True))
    dark = -np.inf
    return np.array(
        [
            n
            for n, ((r, c), v) in enumerate(at.items())
            if all(v > at.get((r + down, c + right), dark) for down, right in EARLIER)
            and all(v >= at.get((r - down, c - right), dark) for down, right in EARLIER)
        ],
        np.intp,
    )


def _saddle(at: FloatArray, value: FloatArray, a: int, b: int) -> float:
    """Least blurred value met on the straight way from pixel a to pixel b; 0 where the way leaves the plateau."""
    steps = int(np.abs(at[a] - at[b]).max())
    way = np.rint(at[a] + (at[b] - at[a]) * np.linspace(0, 1, steps + 1)[:, None])
    met = (at[:, None] == way).all(axis=2)
    if not met.any(axis=0).all():
        return 0.0
    return float(value[met.any(axis=1)].min())


def _extent(label: IntArray, value: IntArray, count: int) -> FloatArray:
    """Largest less smallest value plus one of each label, (count,)."""
    low, high = np.full(count, np.iinfo(np.intp).max), np.full(count, -1)
    np.minimum.at(low, label, value)
    np.maximum.at(high, label, value)
    return np.asarray(high - low + 1, np.float64)


def _bloom(mean_taller_px: float, most_taller_px: float) -> tuple[int, int]:
    """Rows and columns to the next pixel along which charge runs over; (0, 0): none.

    An overflowing pixel fills the next along its column (or row) until one takes what is left.
    """
    if abs(mean_taller_px) < BLOOM_PX or most_taller_px < BLOOM_LEAST_PX:
        return 0, 0
    return (1, 0) if mean_taller_px > 0 else (0, 1)
