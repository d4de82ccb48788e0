"""Charts and window -> the statistics shown after a panel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from inspector.judge.spc import actions, counts, heights, runs, window
from inspector.judge.spc.baseline import CountBaseline, Learning
from inspector.judge.spc.panel import Panel
from inspector.judge.spc.settings import FALLS, RISES, StatisticsSettings
from inspector.judge.spc.state import Charts
from inspector.line_statistics import Place, Rule, Spread, Statistics, TooLittle, Trend

HEIGHT_RULES = (Rule.HEIGHT_ABOVE, Rule.HEIGHT_BELOW, Rule.HEIGHT_PATTERN)


def report(
    panel: Panel,
    charts: Charts,
    recipe: Learning,
    base: CountBaseline | None,
    place: Place | None,
    settings: StatisticsSettings,
) -> Statistics:
    """The statistics after ``panel``; ``base``: its recipe's baseline of counts, ``place``: where defects come back."""
    seen = charts.window
    rule = min(charts.alarms, default=Rule.NONE)
    since = _since_change(rule, charts)
    rate, sigma_z = window.rate(seen), base.sigma_z if base else 1.0
    trend, trend_percent = window.trend_of(seen, sigma_z, settings)
    spread, spread_index = window.spread_of(seen, settings)
    height = heights.summary([height for s in seen for height in s.heights_um], settings.large_um)
    mean = base.per_m2 * panel.area_m2 if base and panel.is_sound else None
    limits = counts.limits(mean, sigma_z, settings.limits, settings.tail) if mean else None
    statistics = Statistics(
        at_s=panel.at_s,
        recipe_id=panel.recipe_id,
        inspected=panel.is_sound,
        too_little=TooLittle(0),
        panels=charts.panels,
        panels_not_inspected=charts.not_inspected,
        not_inspected_share=1.0 - sum(charts.inspected) / len(charts.inspected),
        count=panel.count if panel.is_sound else None,
        per_m2=panel.count / panel.area_m2 if panel.is_sound else None,
        recent_panels=rate.panels if rate else 0,
        recent_per_panel=rate.per_panel if rate else None,
        recent_per_m2=rate.per_m2 if rate else None,
        baseline_per_m2=base.per_m2 if base else None,
        baseline_is_doubtful=base.doubtful if base else False,
        ratio=window.ratio(seen, since if rule.name in RISES else len(seen)),
        upper_per_m2=limits.upper / panel.area_m2 if limits else None,
        lower_per_m2=limits.lower / panel.area_m2 if limits else None,
        overdispersion=sigma_z,
        ewma=charts.ewma.value,
        ewma_limit=charts.ewma.limit(settings.ewma_weight, settings.ewma_width),
        cusum_above=charts.cusum.above,
        cusum_below=charts.cusum.below,
        cusum_limit=settings.cusum_limit,
        median_um=height.median_um if height else None,
        p95_um=height.p95_um if height else None,
        largest_um=height.largest_um if height else None,
        large_share=height.large_share if height else None,
        mean_height=charts.height_means[-1] if charts.height_means else None,
        trend=trend,
        trend_percent=trend_percent,
        spread=spread,
        spread_index=spread_index,
        repeated=place,
        alarm=rule is not Rule.NONE,
        rule=rule,
        run_rule=charts.run_rule if rule in HEIGHT_RULES else 0,
        alarm_text=_words(rule, charts, place, since),
        panels_since_change=since,
    )
    statistics = replace(statistics, too_little=_too_little(statistics, recipe, settings))
    return actions.advised(statistics, settings)


def _too_little(s: Statistics, recipe: Learning, settings: StatisticsSettings) -> TooLittle:
    lacking = {
        TooLittle.BASELINE: s.baseline_per_m2 is None,
        TooLittle.RECENT: s.recent_panels < settings.window_panels / 2,
        TooLittle.HEIGHTS: s.median_um is None,
        TooLittle.HEIGHT_BASELINE: recipe.height_baseline is None,
        TooLittle.TREND: s.trend is Trend.UNKNOWN,
        TooLittle.SPREAD: s.spread is Spread.UNKNOWN,
    }
    bits = TooLittle(0)
    for bit, is_lacking in lacking.items():
        bits |= bit if is_lacking else TooLittle(0)
    return bits


def _since_change(rule: Rule, charts: Charts) -> int:
    """As far as the CUSUM of the alarm's side tells: panels since it last was 0 (Montgomery's N+ and N-)."""
    if rule.name in RISES:
        return max(1, charts.cusum.since_above)
    if rule.name in FALLS:
        return max(1, charts.cusum.since_below)
    return charts.panels


def _words(rule: Rule, charts: Charts, place: Place | None, since: int) -> str:
    """The alarm in a sentence; empty without one."""
    last = f"for {since} panel{'' if since == 1 else 's'}"
    words = {
        Rule.NONE: "",
        Rule.COUNT_ABOVE: "a panel with more defects than its upper control limit",
        Rule.COUNT_BELOW: "a panel with fewer defects than its lower control limit",
        Rule.EWMA_ABOVE: f"more defects than the baseline {last} (EWMA)",
        Rule.EWMA_BELOW: f"fewer defects than the baseline {last} (EWMA)",
        Rule.CUSUM_ABOVE: f"more defects than the baseline {last} (CUSUM)",
        Rule.CUSUM_BELOW: f"fewer defects than the baseline {last} (CUSUM)",
        Rule.REPEATED_PLACE: "defects at one place on panel after panel" + _where(place),
        Rule.HEIGHT_ABOVE: f"seeds higher than the baseline: {_run(charts.run_rule)}",
        Rule.HEIGHT_BELOW: f"seeds lower than the baseline: {_run(charts.run_rule)}",
        Rule.HEIGHT_PATTERN: f"heights out of the usual pattern: {_run(charts.run_rule)}",
    }
    return words[rule]


def _where(place: Place | None) -> str:
    return f", near x {place.x_mm:.0f}, y {place.y_mm:.0f} mm on {place.panels} of them" if place else ""


def _run(rule: int) -> str:
    return f"{runs.WORDS.get(rule, '')} (Nelson's rule {rule})"


def codes(settings: StatisticsSettings) -> Sequence[tuple[int, str]]:
    """Every action code that the table may give, with its words, each once, lowest first."""
    found: dict[int, str] = {}
    for row in settings.actions:
        found.setdefault(actions.code_of(row), row.action if isinstance(row.action, str) else row.text)
    return sorted(found.items())
