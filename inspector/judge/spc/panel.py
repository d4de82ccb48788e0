"""What a panel brings to the statistics, and what the statistics say after it."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass

MOST_DEFECTS = 256
"""Heights and places of so many defects of a panel are looked at; all are counted."""

Bounds = tuple[float, float, float, float]
"""x_min, y_min, x_max, y_max of what was inspected, mm on the panel."""


@dataclass(frozen=True, slots=True)
class Panel:
    """One panel as judged. ``heights_um``, ``sigmas_um`` and ``places_mm`` have an entry for each measured defect;
    ``count`` may be larger: a seed without a height counts too."""

    at_s: float
    """Unix time of the result, seconds, as the caller has it."""
    recipe_id: int
    inspected: bool
    """False: NOT_INSPECTED. Such a panel is counted apart, and enters no chart."""
    count: int = 0
    area_m2: float = 0.0
    heights_um: tuple[float, ...] = ()
    sigmas_um: tuple[float | None, ...] = ()
    places_mm: tuple[tuple[float, float], ...] = ()
    bounds_mm: Bounds = (0.0, 0.0, 0.0, 0.0)

    @property
    def is_sound(self) -> bool:
        """Whether it may enter a chart: it was inspected, and how much of it is known."""
        return self.inspected and self.count >= 0 and math.isfinite(self.area_m2) and self.area_m2 > 0


class TooLittle(enum.IntFlag):
    """Which statistics rest on too few panels or defects; what they would say is None, and nothing acts on them."""

    BASELINE = 1 << 0
    """No baseline yet for this recipe: no limits, no chart goes on, no alarm from counts."""
    RECENT = 1 << 1
    """The window of recent panels is not half full."""
    HEIGHTS = 1 << 2
    """Too few heights in the window for their percentiles."""
    HEIGHT_BASELINE = 1 << 3
    """No baseline of heights yet for this recipe: no run rules."""
    TREND = 1 << 4
    """Too few panels or defects for a trend."""
    SPREAD = 1 << 5
    """Too few panels with defects enough to tell how these lie."""


class Trend(enum.IntEnum):
    """Where the rate of defects goes within the window, if that is significant."""

    UNKNOWN = 0
    STEADY = 1
    RISING = 2
    FALLING = 3


class Spread(enum.IntEnum):
    """How defects lie on their panel, if that is significant."""

    UNKNOWN = 0
    RANDOM = 1
    CLUSTERED = 2
    EVEN = 3


class Rule(enum.IntEnum):
    """What raised the alarm; the lowest number is shown where several did: what lasts before what one panel said."""

    NONE = 0
    CUSUM_ABOVE = 1
    EWMA_ABOVE = 2
    COUNT_ABOVE = 3
    REPEATED_PLACE = 4
    HEIGHT_ABOVE = 5
    HEIGHT_BELOW = 6
    HEIGHT_PATTERN = 7
    COUNT_BELOW = 8
    CUSUM_BELOW = 9
    EWMA_BELOW = 10


@dataclass(frozen=True, slots=True)
class Place:
    """A place of the panel that has defects on more panels than chance explains."""

    x_mm: float
    y_mm: float
    panels: int
    """Panels of the window with a defect there."""


@dataclass(frozen=True, slots=True)
class Statistics:
    """All that is known after a panel. None: not known, and ``too_little`` says why.

    "Recent" is the window of the last panels; EWMA and CUSUM are in standard deviations of one panel's count.
    """

    at_s: float
    recipe_id: int
    inspected: bool
    too_little: TooLittle
    panels: int
    """Inspected panels since the reset."""
    panels_not_inspected: int
    """Panels since the reset that were not inspected, or whose area is not known."""
    not_inspected_share: float
    """Share of such panels in the window."""
    count: int | None
    per_m2: float | None
    """Of this panel, defects per square metre."""
    recent_panels: int
    recent_per_panel: float | None
    recent_per_m2: float | None
    baseline_per_m2: float | None
    baseline_is_doubtful: bool
    """The panels that it was learnt from did not agree with each other: learn it again once the line is steady."""
    ratio: float | None
    """Recent defects over those expected by the baselines; in an alarm of rise, of the panels since the change."""
    upper_per_m2: float | None
    lower_per_m2: float | None
    """Limits of the u-chart at this panel's area."""
    overdispersion: float
    """Laney's sigma_z of the recipe: by how much limits are wider than Poisson's; 1 where counts are Poisson's."""
    ewma: float
    ewma_limit: float
    cusum_above: float
    cusum_below: float
    cusum_limit: float
    median_um: float | None
    p95_um: float | None
    largest_um: float | None
    large_share: float | None
    """Share of recent heights above the setting large_um."""
    mean_height: float | None
    """Latest group's mean of log heights, in standard deviations of such a mean."""
    trend: Trend
    trend_percent: float | None
    """Change of the rate of defects over 100 panels at the window's pace, percent of the rate."""
    spread: Spread
    spread_index: float | None
    """Mean distance of nearest neighbours over that of random places: below 1 clustered, above 1 even."""
    repeated: Place | None
    alarm: bool
    rule: Rule
    run_rule: int
    """Nelson's number of the run rule, where the rule is one of the HEIGHT rules; else 0."""
    alarm_text: str
    panels_since_change: int
    """Panels since the charts began or, in an alarm, since the change began as far as the CUSUM tells."""
    action: int = 0
    """Advisory action code of the plant's table; 0: none."""
    action_name: str = ""
    confidence: float = 0.0
    """0 to 1, as the table has it; halved while the baseline is doubtful."""
    action_text: str = ""
