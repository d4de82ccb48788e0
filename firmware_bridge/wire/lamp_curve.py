"""Lamp intensity in percent against level in volts: a line through measured points, or the maker's straight one."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from itertools import pairwise

CLAMP_V = 5.0
"""The lamp's level input takes 0-5 V (Fostec DCR II); nothing above is ever written, whatever a module can put out."""

LINEAR: tuple[tuple[float, float], ...] = ((0.0, 0.0), (100.0, CLAMP_V))
"""The maker's statement: 0-5 V for 0-100 % intensity."""


def volts(curve: Sequence[tuple[float, float]], percent: float) -> float:
    """Level in volts for an intensity in percent; ends of the curve are held beyond it, and never above the clamp."""
    return min(_interpolate(curve, percent), CLAMP_V)


def percent(curve: Sequence[tuple[float, float]], level_v: float) -> float:
    """Intensity in percent at a level in volts; ends of the curve are held beyond it."""
    return _interpolate([(level, share) for share, level in curve], level_v)


def from_samples(samples: Sequence[tuple[float, float]]) -> tuple[tuple[float, float], ...]:
    """The curve of measured (level in volts, light): percent of the light at the highest level, against volts.

    ``light`` is in any unit that is proportional to light, with its value at 0 V taken off. It begins at
    (0 %, 0 V) and rises from pair to pair, also where a halogen lamp gives no light yet. Raises ValueError that says
    why samples make no curve.
    """
    ordered = sorted(samples)
    if len(ordered) < 2 or ordered[0][0] != 0.0:
        raise ValueError("at least two samples, of which one at 0 V")
    if any(higher == lower for (lower, _), (higher, _) in pairwise(ordered)):
        raise ValueError("each level only once")
    dark, brightest = ordered[0][1], ordered[-1][1]
    if not brightest > dark:
        raise ValueError("the highest level gives no more light than 0 V: check lamp and exposure")
    return _rising([(100.0 * (light - dark) / (brightest - dark), level_v) for level_v, light in ordered])


LEAST_RISE_PERCENT = 0.01
"""Percent must rise from pair to pair. Where light does not, as near 0 V, it is taken to rise by so little."""

MOST_FALL_PERCENT = 1.0
"""A lamp that falls by more than this with a rising level was not steady: the DCR II holds its light within 1 %."""


def _rising(points: Sequence[tuple[float, float]]) -> tuple[tuple[float, float], ...]:
    """The points with percent made to rise, from 0 to 100. Raises ValueError if light falls by more than noise."""
    kept = [(0.0, points[0][1])]
    for place, (share, level_v) in enumerate(points[1:], 1):
        if share < kept[-1][0] - MOST_FALL_PERCENT or share > 100.0 + MOST_FALL_PERCENT:
            raise ValueError(f"light is not steady or is clipped around {level_v:g} V: warm the lamp up, expose less")
        most = 100.0 - (len(points) - 1 - place) * LEAST_RISE_PERCENT
        kept.append((min(max(share, kept[-1][0] + LEAST_RISE_PERCENT), most), level_v))
    return tuple(kept)


def _interpolate(points: Sequence[tuple[float, float]], x: float) -> float:
    """Piecewise linear through points of rising x; at least two of them."""
    right = min(max(bisect_right([point[0] for point in points], x), 1), len(points) - 1)
    (x0, y0), (x1, y1) = points[right - 1], points[right]
    share = min(max(0.0, (x - x0) / (x1 - x0)), 1.0)  # in this order NaN becomes 0: no light for no number
    return y0 * (1 - share) + y1 * share
