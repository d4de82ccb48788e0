"""Defects and limits -> verdict with its reasons. Pure, and fail-safe: what is not known to be good is not a PASS.

Every rule is monotone: one more defect, a higher defect or a lower limit never turns a FAIL into a PASS.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from inspector.model import Defect, Flag, Reason, Unpaired, Verdict
from inspector.recipe import Limits, Zone

SURELY_A_SEED = Flag.MERGED | Flag.PARTNER_HIDDEN | Flag.PARTNER_OUTSIDE_FRAME
"""An unpaired highlight with one of these is a seed whose height cannot be told."""
NO_SEED = Flag.PAINT_POOL | Flag.HOT_PIXEL
"""An unpaired highlight with one of these is no seed, whatever else it is: it touches one, or is the sensor's."""
UNTOLD = Flag.CROWDED | Flag.TOO_LARGE
"""Whatever has one of these, paired or not, may hide seeds that could not be told apart."""
EXPLAINED = SURELY_A_SEED | UNTOLD | NO_SEED | Flag.DUST
"""Any other unpaired highlight is unexplained."""


class Standing(enum.Enum):
    """Where a height lies by a limit: surely over it, within its own uncertainty of it, surely not over it."""

    OVER = "over"
    WITHIN_GUARD_BAND = "within guard band"
    UNDER = "under"


@dataclass(frozen=True, slots=True)
class Finding:
    """One sentence about a frame, its bit, and whether it fails the panel."""

    reason: Reason
    fails: bool
    text: str


@dataclass(frozen=True, slots=True)
class Scope:
    """The defects that one set of limits holds for: the panel's, or a zone's."""

    where: str
    defects: Sequence[Defect]
    max_height_um: float | None
    max_count: int | None
    height_reason: Reason
    count_reason: Reason


def judge(
    defects: Sequence[Defect], unpaired: Sequence[Unpaired], limits: Limits, area_m2: float
) -> tuple[Verdict, Reason, tuple[str, ...]]:
    """PASS or FAIL, the reasons as bits and as one sentence each.

    ``area_m2`` is the inspected area; 0 or NaN where it is unknown, and any defect is then too dense. A PASS may have
    reasons too: what the limits say to report only. A defect whose height, sigma or place is not finite FAILs.
    """
    found = findings(defects, unpaired, limits, area_m2)
    verdict = Verdict.FAIL if any(f.fails for f in found) else Verdict.PASS
    reasons = 0
    for finding in found:
        reasons |= int(finding.reason)
    return verdict, Reason(reasons), tuple(f.text for f in found)


def findings(defects: Sequence[Defect], unpaired: Sequence[Unpaired], limits: Limits, area_m2: float) -> list[Finding]:
    """What there is to say of these defects and lone highlights, and whether it fails the panel."""
    judged = [d for d in defects if is_judged(d, limits)]
    measured = [d for d in judged if _is_known(d)]
    found = [*_unknown(len(judged) - len(measured)), *_density(len(judged), limits, area_m2)]
    for scope in scopes(judged, limits):
        found += [*_heights(scope, limits), *_count(scope)]
    return [*found, *_unmeasured(judged, unpaired, limits), *_unexplained(unpaired, limits)]


def is_judged(defect: Defect, limits: Limits) -> bool:
    """False in an ignored zone, and where the height is surely below the least that counts."""
    if any(zone.ignore and _is_in(defect, zone) for zone in limits.zones):
        return False
    return not (_is_known(defect) and defect.height_um + guard_um(defect, limits) < limits.min_height_um)


def _is_in(defect: Defect, zone: Zone) -> bool:
    return zone.x_min_mm <= defect.x_mm <= zone.x_max_mm and zone.y_min_mm <= defect.y_mm <= zone.y_max_mm


def _is_known(defect: Defect) -> bool:
    """Whether height, uncertainty and place are numbers at all."""
    sigma_um = defect.height_sigma_um or 0.0
    return sigma_um >= 0 and math.isfinite(defect.height_um + sigma_um + defect.x_mm + defect.y_mm)


def guard_um(defect: Defect, limits: Limits) -> float:
    """Half width of the guard band about a limit, um; 0 where the method knows no uncertainty."""
    return limits.guard_band_sigma * (defect.height_sigma_um or 0.0)


def scopes(judged: Sequence[Defect], limits: Limits) -> Iterator[Scope]:
    """The panel's limits with all defects that are judged, then each zone's with those inside."""
    yield Scope("on the panel", judged, limits.max_height_um, limits.max_count, Reason.HEIGHT_LIMIT, Reason.COUNT_LIMIT)
    for zone in limits.zones:
        if not zone.ignore:
            inside = [d for d in judged if _is_in(d, zone)]
            where = f"in zone {zone.name}"
            yield Scope(where, inside, zone.max_height_um, zone.max_count, Reason.ZONE_LIMIT, Reason.ZONE_LIMIT)


def standing(defect: Defect, limit_um: float, limits: Limits) -> Standing:
    """Where a height lies by a limit, um."""
    guard_band_um = guard_um(defect, limits)
    if defect.height_um - guard_band_um > limit_um:
        return Standing.OVER
    return Standing.WITHIN_GUARD_BAND if limit_um < defect.height_um + guard_band_um else Standing.UNDER


def _unknown(count: int) -> Iterator[Finding]:
    if count:
        yield Finding(Reason.UNMEASURED_SEED, True, f"{_seeds(count)} without a finite height or place")


def _heights(scope: Scope, limits: Limits) -> Iterator[Finding]:
    """What is surely over the limit, and what lies within its own uncertainty of it."""
    limit_um = scope.max_height_um
    if limit_um is None:
        return
    known = [d for d in scope.defects if _is_known(d)]
    stands = [(d, standing(d, limit_um, limits)) for d in known]
    over = [d for d, where in stands if where is Standing.OVER]
    near = [d for d, where in stands if where is Standing.WITHIN_GUARD_BAND]
    if over:
        yield Finding(
            scope.height_reason,
            True,
            f"{_seeds(len(over))} higher than {limit_um:g} um {scope.where}, {_highest(over)}",
        )
    if near:
        fails = limits.guard_band == "fail"
        yield Finding(
            Reason.HEIGHT_WITHIN_GUARD_BAND,
            fails,
            f"{_seeds(len(near))} within {limits.guard_band_sigma:g} sigma of {limit_um:g} um {scope.where}, "
            f"{_highest(near)}: the guard band decides {'FAIL' if fails else 'PASS'}",
        )


def _count(scope: Scope) -> Iterator[Finding]:
    count = len(scope.defects)
    if scope.max_count is not None and count > scope.max_count:
        yield Finding(scope.count_reason, True, f"{_seeds(count)} {scope.where}, more than {scope.max_count}")


def _density(count: int, limits: Limits, area_m2: float) -> Iterator[Finding]:
    if limits.max_per_m2 is None or count == 0:
        return
    if not area_m2 > 0:
        yield Finding(Reason.DENSITY_LIMIT, True, f"{_seeds(count)} on a panel whose area in view is unknown")
    elif count / area_m2 > limits.max_per_m2:
        text = f"{count / area_m2:.1f} seeds per square metre, more than {limits.max_per_m2:g}"
        yield Finding(Reason.DENSITY_LIMIT, True, text)


def _unmeasured(judged: Iterable[Defect], unpaired: Iterable[Unpaired], limits: Limits) -> Iterator[Finding]:
    untold, seed, no_seed = int(UNTOLD), int(SURELY_A_SEED), int(NO_SEED)  # plain numbers: flags take ten times as long
    seeds = [f for f in (int(d.flags) for d in judged) if f & untold]
    seeds += [f for f in (int(u.flags) for u in unpaired) if f & untold or (f & seed and not f & no_seed)]
    if seeds:
        why = Flag(0)
        for flags in seeds:
            why |= Flag(flags & (seed | untold))
        text = f"{_seeds(len(seeds))} without a measurable height ({', '.join(why.names())})"
        yield Finding(Reason.UNMEASURED_SEED, limits.unmeasured_seed == "fail", text)


def _unexplained(unpaired: Iterable[Unpaired], limits: Limits) -> Iterator[Finding]:
    explained = int(EXPLAINED)
    count = sum(1 for u in unpaired if not int(u.flags) & explained)
    if limits.max_unpaired is not None and count > limits.max_unpaired:
        text = f"{count} unexplained highlights without a partner, more than {limits.max_unpaired}"
        yield Finding(Reason.UNPAIRED_LIMIT, True, text)


def _seeds(count: int) -> str:
    return f"{count} seed{'' if count == 1 else 's'}"


def _highest(defects: Sequence[Defect]) -> str:
    top = max(defects, key=lambda d: d.height_um)
    sigma = "" if top.height_sigma_um is None else f" +/- {top.height_sigma_um:.0f}"
    return f"the highest {top.height_um:.0f}{sigma} um at x {top.x_mm:.1f}, y {top.y_mm:.1f} mm"
