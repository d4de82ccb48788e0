"""The statistics area of the register map, at address 2000: how the paint line is doing, and what is advised.

One read of 125 registers, whole, as the result block. What rests on too little has no value (65535, -32768, NaN) and no
bit in `statistics_status`; a PLC acts on `action` only while VALID is set.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass

from inspector.line_statistics import Statistics, TooLittle
from inspector.publish.wire_fields import Field, Layout, Number, WordOrder

STATISTICS_ADDRESS, STATISTICS_WORDS = 2000, 125


class StatisticsStatus(enum.IntFlag):
    """The bits of the `statistics_status` register."""

    VALID = 1 << 0
    ALARM = 1 << 1
    BASELINE = 1 << 2
    RECENT = 1 << 3
    HEIGHTS = 1 << 4
    HEIGHT_BASELINE = 1 << 5
    TREND = 1 << 6
    SPREAD = 1 << 7
    REPEATED_PLACE = 1 << 8
    BASELINE_DOUBTFUL = 1 << 9
    OVERDISPERSED = 1 << 10
    SATURATED_VALUE = 1 << 11


STATISTICS_STATUS_MEANINGS = {
    StatisticsStatus.VALID: "The last panel was inspected and counted; without this bit act on nothing here",
    StatisticsStatus.ALARM: "alarm_rule is not 0",
    StatisticsStatus.BASELINE: "This recipe's rate of defects is known or set; without it there are no limits yet",
    StatisticsStatus.RECENT: "The window of recent panels is at least half full",
    StatisticsStatus.HEIGHTS: "There are heights enough for their percentiles",
    StatisticsStatus.HEIGHT_BASELINE: "This recipe's heights are known; without it no run rules",
    StatisticsStatus.TREND: "There are panels and defects enough for a trend",
    StatisticsStatus.SPREAD: "There are panels with defects enough to tell how these lie",
    StatisticsStatus.REPEATED_PLACE: "Defects come back at the place of repeated_x_mm and repeated_y_mm",
    StatisticsStatus.BASELINE_DOUBTFUL: "The line was not in order while its baseline was learnt: learn it anew",
    StatisticsStatus.OVERDISPERSED: "Counts scatter more than chance does; limits are wider by `overdispersion`",
    StatisticsStatus.SATURATED_VALUE: "Some value here does not fit its register and stands at the range's end",
}

_KNOWN = {
    TooLittle.BASELINE: StatisticsStatus.BASELINE,
    TooLittle.RECENT: StatisticsStatus.RECENT,
    TooLittle.HEIGHTS: StatisticsStatus.HEIGHTS,
    TooLittle.HEIGHT_BASELINE: StatisticsStatus.HEIGHT_BASELINE,
    TooLittle.TREND: StatisticsStatus.TREND,
    TooLittle.SPREAD: StatisticsStatus.SPREAD,
}


@dataclass(frozen=True, slots=True)
class Shown:
    """What the area is packed from: the statistics, None while there are none, and the sequence of their result."""

    statistics: Statistics | None
    sequence: int
    now_s: float
    """Of the same clock as the statistics' ``at_s``."""
    saturated: bool = False


def _status(shown: Shown) -> Number:
    s = shown.statistics
    if s is None:
        return 0
    bits = {
        StatisticsStatus.VALID: s.inspected,
        StatisticsStatus.ALARM: s.alarm,
        StatisticsStatus.REPEATED_PLACE: s.repeated is not None,
        StatisticsStatus.BASELINE_DOUBTFUL: s.baseline_is_doubtful,
        StatisticsStatus.OVERDISPERSED: s.overdispersion > 1.0,
        StatisticsStatus.SATURATED_VALUE: shown.saturated,
    }
    known = {bit: lacking not in s.too_little for lacking, bit in _KNOWN.items()}
    return sum(bit for bit, is_set in (bits | known).items() if is_set)


def _age_ms(shown: Shown) -> Number:
    return None if shown.statistics is None else max(0.0, shown.now_s - shown.statistics.at_s) * 1000


class _Of:
    """Reads an attribute of the statistics; no value while there are none. ``exact``: 0 instead."""

    def __init__(self, name: str, nothing: Number = None) -> None:
        self._name, self._nothing = name, nothing

    def __call__(self, shown: Shown) -> Number:
        value: Number = getattr(shown.statistics, self._name) if shown.statistics else self._nothing
        return value


class _OfPlace:
    """Reads an attribute of the repeated place."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __call__(self, shown: Shown) -> Number:
        place = shown.statistics.repeated if shown.statistics else None
        value: Number = getattr(place, self._name) if place else None
        return value


_F = Field[Shown]
_SEQUENCE = "Sequence of the result after which these hold"


def _pair(address: int, at_f32: int, name: str, kind: str, unit: str, meaning: str, scale: float) -> list[_F]:
    """A measured number twice: scaled in one register, and as float32."""
    value = _Of(name)
    return [
        _F(address, name, kind, unit, meaning, value, scale),
        _F(at_f32, f"{name}_f32", "f32", unit, "The same, not rounded", value),
    ]


def _sorted(fields: list[_F]) -> tuple[_F, ...]:
    return tuple(sorted(fields, key=lambda field: field.address))


STATISTICS_FIELDS = _sorted([
    _F(0, "statistics_sequence", "u16", "id", _SEQUENCE, lambda s: s.sequence),
    _F(1, "statistics_status", "u16", "bits", "See Statistics bits", _status),
    _F(2, "alarm_rule", "u16", "code", "What raised the alarm, 0 no alarm; see Alarm rules", _Of("rule", 0)),
    _F(3, "run_rule", "u16", "code", "Nelson's number of the broken run rule on mean height, or 0", _Of("run_rule", 0)),
    _F(4, "action", "u16", "code", "Advice, 0 none; see Actions. The plant's own from 100", _Of("action", 0)),
    _F(5, "confidence", "u16", "1", "How sure the advice is, 0 to 1", _Of("confidence"), 0.001),
    _F(6, "panels_since_change", "u32", "count", "Since the change began, or without an alarm since the reset",
       _Of("panels_since_change")),
    _F(8, "statistics_age_ms", "u32", "ms", "Time since the statistics were taken", _age_ms),
    _F(10, "statistics_recipe_id", "u16", "id", "Recipe of the last panel", _Of("recipe_id", 0)),
    _F(11, "trend", "u16", "code", "Where the rate goes, see Trends", _Of("trend", 0)),
    _F(12, "spread", "u16", "code", "How defects lie on their panels, see Spreads", _Of("spread", 0)),
    _F(13, "not_inspected_share", "u16", "1", "Share of recent panels not inspected",
       _Of("not_inspected_share"), 0.001),
    _F(14, "statistics_panels", "u32", "count", "Inspected panels since the reset", _Of("panels")),
    _F(16, "statistics_not_inspected", "u32", "count", "Panels not inspected since the reset; in no chart",
       _Of("panels_not_inspected")),
    _F(18, "panel_defects", "u16", "count", "Defects of the last panel", _Of("count")),
    _F(19, "recent_panels", "u16", "count", "Inspected panels in the window called recent", _Of("recent_panels")),
    *_pair(20, 60, "recent_per_panel", "u16", "count", "Recent defects per panel", 0.01),
    *_pair(21, 62, "recent_per_m2", "u16", "1/m2", "Recent defects per square metre", 0.1),
    *_pair(22, 64, "per_m2", "u16", "1/m2", "Defects per square metre of the last panel", 0.1),
    *_pair(23, 66, "baseline_per_m2", "u16", "1/m2", "The recipe's usual defects per square metre", 0.1),
    *_pair(24, 68, "upper_per_m2", "u16", "1/m2", "Upper control limit at the last panel's area", 0.1),
    *_pair(25, 70, "lower_per_m2", "u16", "1/m2", "Lower control limit", 0.1),
    *_pair(26, 72, "ratio", "u16", "1", "Recent defects over those expected; in an alarm, since the change", 0.01),
    *_pair(27, 74, "ewma", "i16", "sigma", "EWMA of the panels' counts, standard deviations of one panel's", 0.001),
    *_pair(28, 76, "ewma_limit", "i16", "sigma", "Its limit, up and down", 0.001),
    *_pair(29, 78, "cusum_above", "u16", "sigma", "CUSUM for more defects, in the same unit", 0.001),
    *_pair(30, 80, "cusum_below", "u16", "sigma", "CUSUM for fewer defects", 0.001),
    *_pair(31, 82, "cusum_limit", "u16", "sigma", "Their limit", 0.001),
    *_pair(32, 84, "overdispersion", "u16", "1", "Laney's sigma z; 1: counts scatter as chance does", 0.01),
    *_pair(33, 86, "trend_percent", "i16", "%", "Change of the rate over 100 panels", 1),
    *_pair(34, 88, "spread_index", "u16", "1", "Below 1 clustered, above 1 even (Clark and Evans)", 0.001),
    *_pair(35, 90, "mean_height", "i16", "sigma", "Latest group's mean height, from the baseline", 0.01),
    _F(36, "median_height_um", "u16", "um", "Median of recent heights", _Of("median_um")),
    _F(37, "p95_height_um", "u16", "um", "95 % of recent heights are lower", _Of("p95_um")),
    _F(38, "recent_largest_um", "u16", "um", "Largest of recent heights", _Of("largest_um")),
    _F(39, "large_share", "u16", "1", "Share of recent heights above the setting large_um", _Of("large_share"), 0.001),
    _F(40, "repeated_x_mm", "i16", "mm", "x of the place where defects come back", _OfPlace("x_mm"), 0.1),
    _F(41, "repeated_y_mm", "i16", "mm", "y of it", _OfPlace("y_mm"), 0.1),
    _F(42, "repeated_panels", "u16", "count", "Recent panels with a defect there", _OfPlace("panels")),
    _F(124, "statistics_sequence_end", "u16", "id", "Equals statistics_sequence", lambda s: s.sequence),
])  # fmt: skip

_LAYOUT = Layout(STATISTICS_FIELDS, STATISTICS_WORDS)


def encode_statistics(shown: Shown, word_order: WordOrder) -> bytes:
    """The area's bytes; never raises on values."""
    overflow: list[str] = []
    area = _LAYOUT.pack(shown, word_order, overflow)
    if overflow:
        saturated = Shown(shown.statistics, shown.sequence, shown.now_s, saturated=True)
        area = _LAYOUT.pack(saturated, word_order, overflow)
    return area
