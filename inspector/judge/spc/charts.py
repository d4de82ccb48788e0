"""EWMA and tabular CUSUM of standardised values: target 0, standard deviation 1.

Sources: D. C. Montgomery, Introduction to Statistical Quality Control, sections 9.1 and 9.2; J. M. Lucas and
R. B. Crosier, Fast initial response for CUSUM quality-control schemes, Technometrics 24 (1982) 199-205.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

CUSUM_HIGHEST = 2.0
"""Sums stop at so many limits: after a long fault the alarm goes in as many panels as it took, not in a hundred."""


@dataclass(slots=True)
class Ewma:
    """Exponentially weighted moving average of all values so far."""

    value: float = 0.0
    steps: int = 0

    def step(self, z: float, weight: float) -> None:
        """Take one value in."""
        self.value += weight * (z - self.value)
        self.steps += 1

    def limit(self, weight: float, width: float) -> float:
        """Half distance of the limits: they open with the number of values, as the average's variance does."""
        return width * math.sqrt(weight / (2.0 - weight) * (1.0 - (1.0 - weight) ** (2 * self.steps)))


@dataclass(slots=True)
class Cusum:
    """Upper and lower sums, and for each how many values there were since it last was 0."""

    above: float = 0.0
    below: float = 0.0
    since_above: int = 0
    since_below: int = 0

    def step(self, z: float, reference: float, limit: float) -> None:
        """Take one value in; ``reference`` is half the shift to be found, ``limit`` the decision interval."""
        highest = CUSUM_HIGHEST * limit
        self.above = min(max(0.0, self.above + z - reference), highest)
        self.below = min(max(0.0, self.below - z - reference), highest)
        self.since_above = self.since_above + 1 if self.above > 0 else 0
        self.since_below = self.since_below + 1 if self.below > 0 else 0
