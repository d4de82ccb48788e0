"""Counts of defects: how unusual one is, and its limits on a u-chart. Poisson's law, widened after Laney.

Sources: D. C. Montgomery, Introduction to Statistical Quality Control, section 7.3 (u-chart); D. B. Laney, Improved
control charts for attributes, Quality Engineering 14 (2002) 531-537 (u').
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from statistics import NormalDist
from typing import Literal

LARGEST_SCORE = 6.0
"""One panel counts at most so many standard deviations in EWMA and CUSUM: a single wild one is the u-chart's matter."""
MOVING_RANGE_D2 = 1.128
"""Expected range of two normal values over their standard deviation."""
NEGLIGIBLE = 1e-17

LimitsKind = Literal["probability", "three_sigma"]
_NORMAL = NormalDist()


@dataclass(frozen=True, slots=True)
class CountLimits:
    """A count above ``upper`` or below ``lower`` is out of control."""

    lower: float
    upper: float


def _probability(count: int, mean: float) -> float:
    return math.exp(count * math.log(mean) - mean - math.lgamma(count + 1))


@lru_cache(maxsize=4096)
def upper_tail(count: int, mean: float) -> float:
    """P(X >= count) of Poisson's law with a mean above 0, exact to rounding also far out."""
    if count <= mean:
        return 1.0 - _lower_tail(count - 1, mean)
    total, term, n = 0.0, _probability(count, mean), count
    while term > NEGLIGIBLE * total:
        total, n = total + term, n + 1
        term *= mean / n
    return total


@lru_cache(maxsize=4096)
def _lower_tail(count: int, mean: float) -> float:
    """P(X <= count)."""
    if count < 0:
        return 0.0
    if count > mean:
        return 1.0 - upper_tail(count + 1, mean)
    total, term, n = 0.0, _probability(count, mean), count
    while n >= 0 and term > NEGLIGIBLE * total:
        total, term, n = total + term, term * n / mean, n - 1
    return total


@lru_cache(maxsize=4096)
def score(count: int, mean: float) -> float:
    """The count as a standard normal value: the quantile of its mid-probability under Poisson's law.

    Sums of such scores run no faster into a CUSUM's limit than normal values do, at means from 0.3 up;
    plain (count - mean) / sqrt(mean) is skewed and would.
    """
    half = 0.5 * _probability(count, mean)
    if count >= mean:
        value = -_NORMAL.inv_cdf(min(max(upper_tail(count + 1, mean) + half, 1e-300), 1 - 1e-16))
    else:
        value = _NORMAL.inv_cdf(min(max(_lower_tail(count - 1, mean) + half, 1e-300), 1 - 1e-16))
    return max(-LARGEST_SCORE, min(LARGEST_SCORE, value))


@lru_cache(maxsize=256)
def limits(mean: float, sigma_z: float = 1.0, kind: LimitsKind = "probability", tail: float = 0.00135) -> CountLimits:
    """Limits of a count about its ``mean`` (above 0).

    "probability": a Poisson count goes beyond either with at most the probability ``tail``. "three_sigma": the
    textbook's mean +/- 3 sqrt(mean), which cries wolf at small means. Both are ``sigma_z`` times as far from the mean
    where counts are overdispersed; with three_sigma these are Laney's.
    """
    if kind == "three_sigma":
        below = above = 3.0 * math.sqrt(mean)
    else:
        above, below = _upper_limit(mean, tail) - mean, mean - _lower_limit(mean, tail)
    return CountLimits(max(0.0, mean - sigma_z * below), mean + sigma_z * above)


def _upper_limit(mean: float, tail: float) -> int:
    """The smallest count that is exceeded with at most the probability ``tail``."""
    count = math.floor(mean)
    while upper_tail(count + 1, mean) > tail:
        count += 1
    return count


def _lower_limit(mean: float, tail: float) -> int:
    """The largest count below which there is at most the probability ``tail``."""
    count = math.ceil(mean)
    while count > 0 and _lower_tail(count - 1, mean) > tail:
        count -= 1
    return count


def sigma_z(counts: Sequence[int], means: Sequence[float]) -> float:
    """Laney's overdispersion: standard deviation of the standardised counts, from their moving ranges."""
    z = [(count - mean) / math.sqrt(mean) for count, mean in zip(counts, means, strict=True)]
    ranges = [abs(b - a) for a, b in pairwise(z)]
    return sum(ranges) / len(ranges) / MOVING_RANGE_D2 if ranges else 1.0


def dispersion_is_excessive(counts: Sequence[int], means: Sequence[float], significance: float) -> bool:
    """Whether counts scatter more than Poisson's law lets them, about ``means`` of one rate fitted to them: index of
    dispersion against chi squared, whose quantile is Wilson and Hilferty's."""
    freedom = len(counts) - 1
    if freedom < 1:
        return False
    index = sum((count - mean) ** 2 / mean for count, mean in zip(counts, means, strict=True))
    part = 2.0 / (9.0 * freedom)
    z: float = ((index / freedom) ** (1 / 3) - (1.0 - part)) / math.sqrt(part)
    return z > _NORMAL.inv_cdf(1.0 - significance)
