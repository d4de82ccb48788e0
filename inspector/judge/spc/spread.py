"""How defects lie: in clusters, at random or evenly on their panel; and at one place on panel after panel.

Sources: P. J. Clark and F. C. Evans, Distance to nearest neighbor as a measure of spatial relationships in
populations, Ecology 35 (1954) 445-453; K. P. Donnelly, Simulations to determine the variance and edge effect of total
nearest neighbour distance, 1978 (the correction for the edge).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from inspector.judge.spc.counts import upper_tail
from inspector.judge.spc.panel import Bounds

FEWEST_ON_A_PANEL, FEWEST_ON_A_LONG_PANEL = 5, 10
"""From these on Donnelly's mean is right to 1 %: on panels up to twice as long as wide, and up to four times."""
LONG = 18.0
"""Rim squared over area of a rectangle twice as long as wide."""
COLUMNS, ROWS = 8, 6
"""Cells that the panel is parted into; and once more, shifted by half a cell, for places on their borders."""
CELLS = COLUMNS * ROWS + (COLUMNS + 1) * (ROWS + 1)
FEWEST_HITS = 3


@dataclass(frozen=True, slots=True)
class Neighbours:
    """Nearest neighbours on a panel: ``count`` of defects, sum of distances over its expectation, with variance."""

    count: int
    total_mm: float
    expected_mm: float
    variance_mm2: float


@dataclass(frozen=True, slots=True)
class Pattern:
    """``index`` below 1: clustered, above 1: even; ``z`` of its distance from random places."""

    index: float
    z: float


def expected_distance(count: int, area: float, rim: float) -> tuple[float, float]:
    """Mean distance to the nearest of ``count`` random places in an area of this rim, and that mean's variance."""
    mean = 0.5 * math.sqrt(area / count) + (0.0514 + 0.041 / math.sqrt(count)) * rim / count
    return mean, 0.0703 * area / count**2 + 0.037 * rim * math.sqrt(area / count**5)


def neighbours(places_mm: Sequence[tuple[float, float]], area_mm2: float, rim_mm: float) -> Neighbours | None:
    """The nearest neighbours on one panel; None: too few defects, or a panel without an extent."""
    count = len(places_mm)
    if not (area_mm2 > 0 and rim_mm > 0):
        return None
    if count < (FEWEST_ON_A_LONG_PANEL if rim_mm**2 > LONG * area_mm2 else FEWEST_ON_A_PANEL):
        return None
    xy = np.asarray(places_mm, dtype=float)
    squared = ((xy[:, None, :] - xy[None, :, :]) ** 2).sum(axis=2)
    np.fill_diagonal(squared, np.inf)
    mean, variance = expected_distance(count, area_mm2, rim_mm)
    total = float(np.sqrt(squared.min(axis=1)).sum())
    return Neighbours(count, total, count * mean, count**2 * variance)


def pattern(panels: Iterable[Neighbours]) -> Pattern | None:
    """The panels' neighbours taken together, none across panels; None without any."""
    found = list(panels)
    if not found:
        return None
    total, expected = sum(n.total_mm for n in found), sum(n.expected_mm for n in found)
    return Pattern(total / expected, (total - expected) / math.sqrt(sum(n.variance_mm2 for n in found)))


def cells_hit(places_mm: Sequence[tuple[float, float]], bounds_mm: Bounds) -> tuple[int, ...]:
    """Numbers of the cells of either grid in which a panel has defects, each once, lowest first."""
    x_min, y_min, x_max, y_max = bounds_mm
    if not (x_max > x_min and y_max > y_min):
        return ()
    hit = set()
    for x_mm, y_mm in places_mm:
        column, row = (x_mm - x_min) / (x_max - x_min) * COLUMNS, (y_mm - y_min) / (y_max - y_min) * ROWS
        if 0 <= column <= COLUMNS and 0 <= row <= ROWS:
            hit.add(min(int(row), ROWS - 1) * COLUMNS + min(int(column), COLUMNS - 1))
            hit.add(COLUMNS * ROWS + int(row + 0.5) * (COLUMNS + 1) + int(column + 0.5))
    return tuple(sorted(hit))


def centre_mm(cell: int, bounds_mm: Bounds) -> tuple[float, float]:
    """Where a cell's centre is on the panel."""
    x_min, y_min, x_max, y_max = bounds_mm
    first = COLUMNS * ROWS
    if cell < first:
        column, row = cell % COLUMNS + 0.5, cell // COLUMNS + 0.5
    else:
        column, row = (cell - first) % (COLUMNS + 1) * 1.0, (cell - first) // (COLUMNS + 1) * 1.0
    return x_min + column / COLUMNS * (x_max - x_min), y_min + row / ROWS * (y_max - y_min)


def is_alike(one: Bounds, other: Bounds) -> bool:
    """Whether the cells of two panels lie on each other to within half a cell; an encoder's panels are never equal."""
    if one == other:
        return True
    across, along = (other[2] - other[0]) / COLUMNS / 2, (other[3] - other[1]) / ROWS / 2
    is_as_wide = abs(one[0] - other[0]) <= across and abs(one[2] - other[2]) <= across
    return is_as_wide and abs(one[1] - other[1]) <= along and abs(one[3] - other[3]) <= along


def cell_chance(count: int, bounds_mm: Bounds, area_mm2: float) -> float:
    """How probable it is that one of ``count`` random defects hits a given cell within the inspected area."""
    bounds_mm2 = (bounds_mm[2] - bounds_mm[0]) * (bounds_mm[3] - bounds_mm[1])
    if not bounds_mm2 > 0:
        return 0.0
    cells = max(1.0, COLUMNS * ROWS * min(1.0, area_mm2 / bounds_mm2))
    return 1.0 - (1.0 - 1.0 / cells) ** count


def repeated_cell(panels: Sequence[tuple[float, Sequence[int]]], significance: float) -> tuple[int, int] | None:
    """The cell that more panels have hit than chance explains, and how many; None: there is none.

    ``panels``: of each the chance to hit a given cell, and the cells hit. Hits of all panels are taken for Poisson's,
    which scatters more than their sum does, and the significance is shared by all cells. A cluster on one panel is one
    hit.
    """
    hits = np.bincount([cell for _, cells in panels for cell in cells], minlength=CELLS)
    cell = int(hits.argmax())
    expected = sum(chance for chance, _ in panels)
    if hits[cell] < FEWEST_HITS or not expected > 0:
        return None
    return (cell, int(hits[cell])) if upper_tail(int(hits[cell]), expected) * CELLS < significance else None
