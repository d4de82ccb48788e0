"""How long a lamp has burnt. Pure: levels and times come from outside."""

from __future__ import annotations

from dataclasses import dataclass

LIT_V = 0.05
"""Below one percent of the 5 V input, which is also what a zero may be off by, the lamp counts as dark."""


@dataclass(frozen=True, slots=True)
class Burn:
    """Hours burnt until ``at_s`` (monotonic seconds), and whether the lamp has been lit since."""

    hours: float
    at_s: float
    lit: bool = False


def burnt(last: Burn, now_s: float) -> float:
    """Hours burnt until now: a lamp that was lit is taken to have stayed so."""
    return last.hours + (max(0.0, now_s - last.at_s) / 3600 if last.lit else 0.0)


def at_level(last: Burn, now_s: float, level_v: float) -> Burn:
    """The account once the level is known to be ``level_v``, volts."""
    return Burn(burnt(last, now_s), now_s, level_v > LIT_V)
