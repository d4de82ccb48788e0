"""Heights of the recent seeds: median, high percentile, largest, and the share of large ones."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass

from inspector.judge.spc.panel import MOST_DEFECTS, Panel

FEWEST_HEIGHTS = 10


@dataclass(frozen=True, slots=True)
class HeightSummary:
    """Percentiles as Hyndman and Fan's definition 7 has them (the usual one), um."""

    median_um: float
    p95_um: float
    largest_um: float
    large_share: float


def known_heights(panel: Panel, max_sigma: float) -> list[float]:
    """The panel's heights that are numbers above 0, and known to within ``max_sigma`` of themselves."""
    pairs = zip(panel.heights_um[:MOST_DEFECTS], panel.sigmas_um[:MOST_DEFECTS], strict=True)
    return [h for h, sigma in pairs if math.isfinite(h) and h > 0 and 0 <= (sigma or 0.0) <= max_sigma * h]


def summary(heights_um: Sequence[float], large_um: float) -> HeightSummary | None:
    """What the heights are like; None: too few."""
    if len(heights_um) < FEWEST_HEIGHTS:
        return None
    ordered = sorted(heights_um)
    large = len(ordered) - bisect_right(ordered, large_um)
    return HeightSummary(percentile(ordered, 0.5), percentile(ordered, 0.95), ordered[-1], large / len(ordered))


def percentile(ordered: Sequence[float], share: float) -> float:
    """Linear between the order statistics of a sorted, non-empty sequence."""
    at = share * (len(ordered) - 1)
    low = math.floor(at)
    high = min(low + 1, len(ordered) - 1)
    return ordered[low] + (at - low) * (ordered[high] - ordered[low])
