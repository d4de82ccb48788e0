"""Lamp intensity in percent against level in volts: a line through measured points, or the maker's straight one."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence

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


def _interpolate(points: Sequence[tuple[float, float]], x: float) -> float:
    """Piecewise linear through points of rising x; at least two of them."""
    right = min(max(bisect_right([point[0] for point in points], x), 1), len(points) - 1)
    (x0, y0), (x1, y1) = points[right - 1], points[right]
    share = min(max(0.0, (x - x0) / (x1 - x0)), 1.0)  # in this order NaN becomes 0: no light for no number
    return y0 * (1 - share) + y1 * share
