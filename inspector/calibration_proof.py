"""What must hold of a calibration's numbers, told without arrays: a start does so before it serves registers. Pure."""

from __future__ import annotations

import math
from collections.abc import Sequence

Rows = Sequence[Sequence[float]]

CORRELATION_ROUNDING = 1e-6
"""How far a correlation may be from its mirrored one, and an eigenvalue of all of them below zero."""
STRAIGHT_DOWN = 1e-6
"""A camera whose axis goes along the panel by less than this looks at no side."""


def off_orthonormal(r: Rows) -> float:
    """By how much R R^T is off the unit matrix, at most; NaN where it cannot be told."""
    products = [_dot(a, b) - (n == m) for n, a in enumerate(r) for m, b in enumerate(r)]
    return math.nan if any(map(math.isnan, products)) else max(map(abs, products))


def determinant(r: Rows) -> float:
    """Of three rows of three."""
    (a, b, c), (d, e, f), (g, h, i) = r
    return a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)


def height_mm(r: Rows, translation_mm: Sequence[float]) -> float:
    """How high the camera stands over the panel: the third of C = -R^-1 T, by Cramer's rule."""
    return -determinant([(*row[:2], t) for row, t in zip(r, translation_mm, strict=True)]) / determinant(r)


def opposite_is_known(r: Rows) -> bool:
    """Whether the optical axis goes along the panel, so that a lamp may be opposite the camera."""
    return math.hypot(*r[2][:2]) >= STRAIGHT_DOWN


def is_covariance(c: Rows) -> bool:
    """Whether square rows are symmetric and without negative eigenvalues, in units in which each variance is one."""
    sigmas = [math.sqrt(max(row[n], 0.0)) or 1.0 for n, row in enumerate(c)]
    correlation = [
        [value / s / t for value, t in zip(row, sigmas, strict=True)] for row, s in zip(c, sigmas, strict=True)
    ]
    mirrored = zip(*correlation, strict=True)
    off = (
        abs(a - b) for row, column in zip(correlation, mirrored, strict=True) for a, b in zip(row, column, strict=True)
    )
    return all(by <= CORRELATION_ROUNDING for by in off) and _is_definite(correlation, CORRELATION_ROUNDING)


def _is_definite(symmetric: Rows, more: float) -> bool:
    """Whether all eigenvalues would be positive with ``more`` added to each: Cholesky's roots are then all real."""
    lower: list[list[float]] = []
    for n, row in enumerate(symmetric):
        solved: list[float] = []
        for above, value in zip(lower, row, strict=False):
            solved.append((value - _dot(solved, above)) / above[-1])
        left = row[n] + more - _dot(solved, solved)
        if not left > 0:
            return False
        lower.append([*solved, math.sqrt(left)])
    return True


def _dot(a: Sequence[float], b: Sequence[float]) -> float:
    return sum(x * y for x, y in zip(a, b, strict=False))
