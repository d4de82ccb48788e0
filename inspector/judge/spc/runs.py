"""Run rules: patterns in a row of standardised means that chance seldom makes.

L. S. Nelson, The Shewhart control chart: tests for special causes, Journal of Quality Technology 16 (1984) 237-239.
Rules 1, 5 and 6 with a run of eight instead of rule 2's nine are the Western Electric rules.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise

LONGEST = 15
"""So many latest values decide every rule."""

WORDS: Mapping[int, str] = {
    1: "one mean beyond 3 standard deviations",
    2: "nine means in a row on one side of the baseline",
    3: "six means in a row rising or falling",
    4: "fourteen means in a row alternating up and down",
    5: "two of three means beyond 2 standard deviations on one side",
    6: "four of five means beyond 1 standard deviation on one side",
    7: "fifteen means in a row within 1 standard deviation",
    8: "eight means in a row beyond 1 standard deviation, on either side",
}


def _beyond(z: Sequence[float], of: int, at_least: int, sigmas: float) -> bool:
    """Of the last ``of`` values ``at_least`` lie beyond ``sigmas`` on the side where the last one does."""
    side = 1.0 if z[-1] > 0 else -1.0
    return z[-1] * side > sigmas and sum(value * side > sigmas for value in z[-of:]) >= at_least


def _steps(z: Sequence[float], values: int) -> list[float]:
    last = z[-values:]
    return [b - a for a, b in pairwise(last)]


def _is_long_run(z: Sequence[float]) -> bool:
    return len(z) >= 9 and (all(v > 0 for v in z[-9:]) or all(v < 0 for v in z[-9:]))


def _is_climb(z: Sequence[float]) -> bool:
    steps = _steps(z, 6)
    return len(z) >= 6 and (all(s > 0 for s in steps) or all(s < 0 for s in steps))


def _alternates(z: Sequence[float]) -> bool:
    steps = _steps(z, 14)
    return len(z) >= 14 and all(a * b < 0 for a, b in pairwise(steps))


_TESTS: Mapping[int, Callable[[Sequence[float]], bool]] = {
    1: lambda z: abs(z[-1]) > 3,
    2: _is_long_run,
    3: _is_climb,
    4: _alternates,
    5: lambda z: _beyond(z, 3, 2, 2.0),
    6: lambda z: _beyond(z, 5, 4, 1.0),
    7: lambda z: len(z) >= 15 and all(abs(v) < 1 for v in z[-15:]),
    8: lambda z: len(z) >= 8 and all(abs(v) > 1 for v in z[-8:]),
}


def broken(z: Sequence[float], rules: Sequence[int]) -> int:
    """The first of ``rules`` that the values' end breaks, oldest value first; 0: none."""
    return next((rule for rule in rules if z and _TESTS[rule](z)), 0)


def side(z: Sequence[float], rule: int) -> int:
    """1 where the pattern lies above the baseline, -1 below, 0 where it is about neither (rules 4, 7 and 8)."""
    if rule in (4, 7, 8):
        return 0
    toward = z[-1] - z[-2] if rule == 3 else z[-1]
    return 1 if toward > 0 else -1
