"""Whether the rate of defects rises or falls over the recent panels.

The score test of a log-linear Poisson rate, given the total: under a constant rate the defects fall on the panels in
proportion to what each is expected to have (D. R. Cox and P. A. W. Lewis, The Statistical Analysis of Series of Events,
1966, section 3.3, for panels instead of moments).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

FEWEST_PANELS, FEWEST_DEFECTS = 10, 10


@dataclass(frozen=True, slots=True)
class Slope:
    """``per_panel``: change of the rate's logarithm from panel to panel; ``z``: of the test against a constant rate."""

    per_panel: float
    z: float


def slope(counts: Sequence[int], expected: Sequence[float], sigma_z: float) -> Slope | None:
    """The trend of ``counts`` against what was ``expected`` (in any unit, above 0), oldest first; None: too few."""
    total = sum(counts)
    if len(counts) < FEWEST_PANELS or total < FEWEST_DEFECTS:
        return None
    share = np.asarray(expected) / sum(expected)
    place = np.arange(len(counts), dtype=float)
    place -= float(place @ share)
    variance, excess = float(place**2 @ share), float(place @ np.asarray(counts))
    return Slope(excess / (total * variance), excess / math.sqrt(total * variance) / sigma_z)
