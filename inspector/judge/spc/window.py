"""What the recent panels say together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist

from inspector.judge.spc import spread, trend
from inspector.judge.spc.settings import StatisticsSettings
from inspector.judge.spc.state import Seen
from inspector.line_statistics import Place, Spread, Trend

PER_PANELS = 100
"""Trends are given over so many panels."""


@dataclass(frozen=True, slots=True)
class Rate:
    """Of inspected panels: how many, defects of one, and of a square metre."""

    panels: int
    per_panel: float
    per_m2: float


def rate(window: Sequence[Seen]) -> Rate | None:
    """None without an inspected panel."""
    if not window:
        return None
    count = sum(s.count for s in window)
    return Rate(len(window), count / len(window), count / sum(s.area_m2 for s in window))


def ratio(window: Sequence[Seen], latest: int) -> float | None:
    """Defects over those expected, of the ``latest`` panels that had an expectation; None without any."""
    known = [(s.count, s.expected) for s in window if s.expected is not None][-latest:]
    return sum(c for c, _ in known) / sum(e for _, e in known) if known else None


def trend_of(window: Sequence[Seen], sigma_z: float, settings: StatisticsSettings) -> tuple[Trend, float | None]:
    """Where the rate goes, and its change in percent over PER_PANELS panels; by baselines if all panels have one."""
    expected = [s.expected for s in window if s.expected is not None]
    if len(expected) < len(window):
        expected = [s.area_m2 for s in window]
    found = trend.slope([s.count for s in window], expected, sigma_z)
    if found is None:
        return Trend.UNKNOWN, None
    percent = found.per_panel * PER_PANELS * 100.0
    if abs(found.z) < critical_z(settings):
        return Trend.STEADY, percent
    return (Trend.RISING if found.z > 0 else Trend.FALLING), percent


def spread_of(window: Sequence[Seen], settings: StatisticsSettings) -> tuple[Spread, float | None]:
    """How defects lie on their panels, and the index."""
    found = spread.pattern(s.neighbours for s in window if s.neighbours is not None)
    if found is None:
        return Spread.UNKNOWN, None
    if abs(found.z) < critical_z(settings):
        return Spread.RANDOM, found.index
    return (Spread.CLUSTERED if found.z < 0 else Spread.EVEN), found.index


def repeated(window: Sequence[Seen], latest: Seen, settings: StatisticsSettings) -> Place | None:
    """The place hit again and again on panels of the latest one's recipe and extent."""
    alike = [
        (s.cell_chance, s.cells)
        for s in window
        if s.cells and s.recipe_id == latest.recipe_id and spread.is_alike(s.bounds_mm, latest.bounds_mm)
    ]
    found = spread.repeated_cell(alike, settings.significance)
    if found is None:
        return None
    cell, panels = found
    return Place(*spread.centre_mm(cell, latest.bounds_mm), panels)


def critical_z(settings: StatisticsSettings) -> float:
    """The two-sided limit of a standard normal value at the settings' significance."""
    return NormalDist().inv_cdf(1.0 - settings.significance / 2.0)
