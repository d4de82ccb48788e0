"""What a recipe's panels are like while the line is in order (phase I): learnt from its first panels, robustly, and
refined by those after it for as long as no alarm stands.

A CUSUM shows errors of its baseline as it shows faults: from 50 panels alone, every other line would have a false alarm
within its next 600 panels. So learning goes on, and until it ends scores are shrunk by what is not known yet (after
D. M. Hawkins, Self-starting CUSUM charts for location and scale, The Statistician 36 (1987) 299-315).

A recipe has a baseline of its own: colours and parts differ in how many seeds they show. Panels are then charted by how
far they are from their own recipe's baseline, on charts that all recipes share, since booth and filters are shared.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from statistics import fmean, median, stdev

from inspector.judge.spc import counts
from inspector.judge.spc.settings import StatisticsSettings, Target

LONGEST_WAIT = 4
"""Clean panels prolong phase I up to so many times: a baseline from three seeds would say nothing."""
EXCLUDED_TAIL = 0.00135
"""A panel of phase I beyond these limits, those of 3 sigma, is left out of the baseline, and the limits drawn anew."""
MOST_EXCLUDED = 0.2
"""If more than this share is left out, the line was not in order: the baseline is called doubtful."""
DISPERSION_SIGNIFICANCE = 0.05
PASSES = 10
NO_DEFECTS = 0.5
"""What a phase I without any defect counts as: the mean of Jeffreys' posterior for a Poisson rate."""
HEIGHTS_A_PANEL = 32
FEWEST_HEIGHTS = 30
OUTLIER_SIGMAS = 4.0
MAD_TO_SIGMA = 1.4826


@dataclass(slots=True)
class CountBaseline:
    """The rate of defects, and by how much it scatters more than Poisson's law lets it (1: no more)."""

    per_m2: float
    sigma_z: float = 1.0
    doubtful: bool = False
    panels: int = 0
    """Panels that it rests on."""
    defects: float = math.inf
    """Defects that it rests on; infinite where the plant has set it."""

    def score(self, count: int, area_m2: float) -> float:
        """A panel's count as a standard normal value, the baseline's own uncertainty allowed for."""
        mean = self.per_m2 * area_m2
        return counts.score(count, mean) / (self.sigma_z * math.sqrt(1.0 + mean / self.defects))

    def refine(self, count: int, area_m2: float) -> None:
        """One more panel that was in order."""
        known_m2 = self.defects / self.per_m2
        self.defects += count
        self.per_m2 = self.defects / (known_m2 + area_m2)
        self.panels += 1


@dataclass(slots=True)
class HeightBaseline:
    """Mean and standard deviation of the heights' logarithms (um), and the same factor for means of panels."""

    mean_log: float
    sd_log: float
    sigma_z: float = 1.0
    panels: int = 0
    heights: int = 0

    def score(self, logs: Sequence[float]) -> float:
        """A panel's mean log height in standard deviations of such a mean."""
        return (fmean(logs) - self.mean_log) / (self.sd_log * self.sigma_z) * math.sqrt(len(logs))

    def refine(self, logs: Sequence[float]) -> None:
        """One more panel that was in order."""
        self.heights += len(logs)
        self.mean_log += sum(value - self.mean_log for value in logs) / self.heights
        self.panels += 1


@dataclass(slots=True)
class Learning:
    """A recipe: what was seen in phase I so far, and the baselines once they are known."""

    counts: list[int] = field(default_factory=list)
    areas_m2: list[float] = field(default_factory=list)
    logs: list[list[float]] = field(default_factory=list)
    count_baseline: CountBaseline | None = None
    height_baseline: HeightBaseline | None = None

    def learn_count(self, count: int, area_m2: float, settings: StatisticsSettings) -> None:
        """One more panel of phase I; the last one brings the baseline."""
        self.counts.append(count)
        self.areas_m2.append(area_m2)
        seen, enough = len(self.counts), sum(self.counts) >= settings.baseline_defects
        if seen >= settings.baseline_panels and (enough or seen >= LONGEST_WAIT * settings.baseline_panels):
            self.count_baseline = count_baseline(self.counts, self.areas_m2)
            self.counts, self.areas_m2 = [], []

    def learn_heights(self, logs: Sequence[float], settings: StatisticsSettings) -> None:
        """One more panel's logarithms of heights."""
        self.logs.append(list(logs[:HEIGHTS_A_PANEL]))
        if len(self.logs) >= settings.baseline_panels and sum(map(len, self.logs)) >= FEWEST_HEIGHTS:
            self.height_baseline = height_baseline(self.logs)
            self.logs = []


def of_target(target: Target) -> CountBaseline:
    """The baseline that the plant has set."""
    return CountBaseline(target.per_m2, target.sigma_z)


def count_baseline(seen: Sequence[int], areas_m2: Sequence[float]) -> CountBaseline:
    """Rate and overdispersion of phase I's panels, those out of control left out."""
    panels = list(zip(seen, areas_m2, strict=True))
    kept, baseline = panels, _fitted(panels)
    for _ in range(PASSES):
        still = [panel for panel in panels if _is_within(*panel, baseline)]
        if len(still) == len(kept) or len(still) < len(panels) / 2:
            break
        kept, baseline = still, _fitted(still)
    baseline.doubtful = sum(not _is_within(*panel, baseline) for panel in panels) > MOST_EXCLUDED * len(panels)
    return baseline


def _fitted(panels: Sequence[tuple[int, float]]) -> CountBaseline:
    seen = [count for count, _ in panels]
    rate = max(sum(seen), NO_DEFECTS) / sum(area for _, area in panels)
    means = [rate * area for _, area in panels]
    excessive = counts.dispersion_is_excessive(seen, means, DISPERSION_SIGNIFICANCE)
    sigma_z = max(1.0, counts.sigma_z(seen, means)) if excessive else 1.0
    return CountBaseline(rate, sigma_z, panels=len(panels), defects=max(sum(seen), NO_DEFECTS))


def _is_within(count: int, area_m2: float, baseline: CountBaseline) -> bool:
    limits = counts.limits(baseline.per_m2 * area_m2, baseline.sigma_z, tail=EXCLUDED_TAIL)
    return limits.lower <= count <= limits.upper


def height_baseline(panels: Sequence[Sequence[float]]) -> HeightBaseline:
    """Of the logarithms of each panel's heights, outliers left out."""
    every = [value for logs in panels for value in logs]
    centre = median(every)
    reach = OUTLIER_SIGMAS * MAD_TO_SIGMA * median(abs(value - centre) for value in every)
    kept = [value for value in every if abs(value - centre) <= reach] if reach > 0 else every
    mean, sd = fmean(kept), max(stdev(kept), 1e-3)
    baseline = HeightBaseline(mean, sd, panels=len(panels), heights=len(kept))
    z = [baseline.score(logs) for logs in panels if logs]
    ranges = [abs(b - a) for a, b in pairwise(z)]
    baseline.sigma_z = max(1.0, fmean(ranges) / counts.MOVING_RANGE_D2) if ranges else 1.0
    return baseline
