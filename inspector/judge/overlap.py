"""Sightings of several frames -> what is there once. Pure; the order of frames and sightings does not matter.

Two sightings may be of one thing if they are from different frames and differ by no more than their uncertainties
allow. Likeliest pairs are joined first; a group never holds two sightings of one frame, nor two that may not be the
same. So nothing that one frame tells apart is ever counted as one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from inspector.model import FloatArray


@dataclass(frozen=True)
class Sightings:
    """``frame`` (n,) of each; ``xy_mm`` (n, 2) on the panel, and ``reach_mm`` (n,) by how much a place may be off.

    A sighting whose place is not finite stays alone.
    """

    frame: Sequence[int]
    xy_mm: FloatArray
    reach_mm: FloatArray


Difference = Callable[[int, int], float]
"""Of sightings i and j: 0 alike, 1 as different as one thing can look, more: they are two."""


def groups(seen: Sightings, difference: Difference) -> list[list[int]]:
    """Indices of sightings, those of one thing together; each group and the list of them in ascending order.

    ``difference`` is asked only of sightings of different frames that are within the sum of their reach.
    """
    likely = {(i, j): d for i, j in _near(seen) if (d := difference(i, j)) <= 1.0}
    group_of = [[n] for n in range(len(seen.frame))]
    for i, j in sorted(likely, key=lambda pair: (likely[pair], pair)):
        one, other = group_of[i], group_of[j]
        if one is not other and all((min(a, b), max(a, b)) in likely for a in one for b in other):
            one += other
            for member in other:
                group_of[member] = one
    return sorted({id(group): sorted(group) for group in group_of}.values())


def _near(seen: Sightings) -> list[tuple[int, int]]:
    """Pairs i < j of different frames that are within the sum of their reach."""
    placed = np.flatnonzero(np.isfinite(seen.xy_mm).all(axis=1) & np.isfinite(seen.reach_mm))
    if len(placed) < 2 or len(set(seen.frame)) < 2:
        return []
    furthest_mm = 2 * float(seen.reach_mm[placed].max())
    pairs = placed[cKDTree(seen.xy_mm[placed]).query_pairs(furthest_mm, output_type="ndarray")]
    i, j = pairs.min(axis=1), pairs.max(axis=1)
    frame = np.asarray(seen.frame)
    apart_mm = np.hypot(*(seen.xy_mm[i] - seen.xy_mm[j]).T)
    wanted = (frame[i] != frame[j]) & (apart_mm <= seen.reach_mm[i] + seen.reach_mm[j])
    return list(zip(i[wanted].tolist(), j[wanted].tolist(), strict=True))
