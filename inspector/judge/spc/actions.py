"""Statistics -> advice, by the plant's table."""

from __future__ import annotations

from dataclasses import replace

from inspector.judge.spc.settings import ActionRow, StatisticsSettings, When
from inspector.line_statistics import Action, Statistics

DOUBTFUL = 0.5
"""Confidence is multiplied by this while the baseline is doubtful."""


def advised(statistics: Statistics, settings: StatisticsSettings) -> Statistics:
    """The statistics with the advice of the first row that holds; without one, action 0."""
    row = next((row for row in settings.actions if holds(row.when, statistics)), None)
    if row is None:
        return statistics
    doubt = DOUBTFUL if statistics.baseline_is_doubtful else 1.0
    return replace(
        statistics,
        action=code_of(row),
        action_name=row.action if isinstance(row.action, str) else str(row.action),
        confidence=row.confidence * doubt,
        action_text=row.text,
    )


def code_of(row: ActionRow) -> int:
    """The number that the PLC sees."""
    return row.action if isinstance(row.action, int) else Action[row.action]


def holds(when: When, s: Statistics) -> bool:
    """Whether all conditions are given and met. After a panel that was not inspected only conditions on that hold."""
    if not s.inspected and when.min_not_inspected_share is None:
        return False
    return (
        (not when.rules or s.rule.name in when.rules)
        and (not when.spread or s.spread.name in when.spread)
        and (not when.trend or s.trend.name in when.trend)
        and _at_least(s.ratio, when.min_ratio)
        and _at_most(s.ratio, when.max_ratio)
        and _at_least(s.large_share, when.min_large_share)
        and _at_most(s.large_share, when.max_large_share)
        and _at_least(s.not_inspected_share, when.min_not_inspected_share)
    )


def _at_least(value: float | None, least: float | None) -> bool:
    return least is None or (value is not None and value >= least)


def _at_most(value: float | None, most: float | None) -> bool:
    return most is None or (value is not None and value <= most)
