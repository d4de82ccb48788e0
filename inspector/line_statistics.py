"""What the statistics of the paint line say after a panel: nouns, and what their codes mean."""

from __future__ import annotations

import enum
from dataclasses import dataclass


class Action(enum.IntEnum):
    """Advisory actions by name; the plant's own have numbers from 100."""

    NONE = 0
    HOLD = 1
    CHECK_FILTER = 2
    CLEAN_BOOTH = 3
    CHECK_FIXTURE = 4
    CHECK_PAINT = 5
    CHECK_LAMP = 6
    CHECK_STATION = 7
    WATCH = 8


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


RULE_MEANINGS = {
    Rule.NONE: "No alarm",
    Rule.CUSUM_ABOVE: "More defects than the baseline for some time, by the CUSUM",
    Rule.EWMA_ABOVE: "The same, by the EWMA",
    Rule.COUNT_ABOVE: "One panel with more defects than its upper control limit",
    Rule.REPEATED_PLACE: "Defects at one place on panel after panel: see repeated_x_mm and repeated_y_mm",
    Rule.HEIGHT_ABOVE: "Seeds higher than the baseline: see run_rule",
    Rule.HEIGHT_BELOW: "Seeds lower than the baseline: see run_rule",
    Rule.HEIGHT_PATTERN: "Mean heights in a pattern that chance seldom makes: see run_rule",
    Rule.COUNT_BELOW: "One panel with fewer defects than its lower control limit",
    Rule.CUSUM_BELOW: "Fewer defects than the baseline for some time, by the CUSUM",
    Rule.EWMA_BELOW: "The same, by the EWMA",
}
ACTION_MEANINGS = {
    Action.NONE: "Nothing to advise",
    Action.HOLD: "Hold the line until the cause is found",
    Action.CHECK_FILTER: "Check supply-air filters and the booth's pressure",
    Action.CLEAN_BOOTH: "Clean the booth: walls, conveyor, clothes",
    Action.CHECK_FIXTURE: "Look at hanger, gun and what is above the place",
    Action.CHECK_PAINT: "Check the paint's strainer and circulation",
    Action.CHECK_LAMP: "Make sure that lamp and lens still show seeds",
    Action.CHECK_STATION: "See the fault code: panels are not inspected",
    Action.WATCH: "Look at the panel; the line may be in order",
}
