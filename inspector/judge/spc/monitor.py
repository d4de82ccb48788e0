"""The statistics of a paint line: takes panels one by one, and says after each how the line is doing.

A panel goes: baseline of its recipe (phase I) or, once there is one, u-chart, EWMA and CUSUM of standardised counts,
and run rules on mean heights; then the window of recent panels for heights, trend and spread; then alarm and advice.
"""

from __future__ import annotations

import math

from inspector.judge.spc import baseline, counts, heights, runs, spread, state
from inspector.judge.spc.baseline import CountBaseline, HeightBaseline, Learning
from inspector.judge.spc.panel import MOST_DEFECTS, Panel
from inspector.judge.spc.report import report
from inspector.judge.spc.settings import StatisticsSettings
from inspector.judge.spc.state import Charts, Seen, State
from inspector.judge.spc.window import repeated
from inspector.line_statistics import Rule, Statistics

MOST_RECIPES = 256
"""Baselines of so many recipes are kept; beyond, the one longest unused is learnt anew."""


class Monitor:
    """Settings and what is remembered. Not for several threads at once."""

    def __init__(self, settings: StatisticsSettings, remembered: State | None = None) -> None:
        self.settings = settings
        self._state = remembered or State()

    def to_json(self) -> str:
        """All that is remembered, as text."""
        return state.to_json(self._state)

    @classmethod
    def from_json(cls, settings: StatisticsSettings, text: str) -> Monitor:
        """As it was when ``to_json`` gave ``text``. Raises ValueError that says what is wrong with it."""
        return cls(settings, state.from_json(text))

    def reset(self) -> None:
        """Begin the charts and the window anew; baselines stay. For after a repair: the CUSUM has its head start, so
        that a repair that did not help is found out soon."""
        self._state.charts = Charts()
        cusum = self._state.charts.cusum
        cusum.above = cusum.below = self.settings.cusum_head_start * self.settings.cusum_limit

    def relearn(self) -> None:
        """Forget the baselines too: the line is in order as it is now."""
        self._state = State()

    def add(self, panel: Panel) -> Statistics:
        """The statistics after one more panel."""
        charts = self._state.charts
        recipe = (
            self._recipe(panel.recipe_id) if panel.is_sound else self._state.recipes.get(panel.recipe_id, Learning())
        )
        for rule in list(charts.alarms):
            self._age(charts, rule)
        length, place = self.settings.window_panels, None
        charts.inspected = [*charts.inspected, panel.is_sound][-length:]
        if panel.is_sound:
            seen = self._take_in(panel, recipe)
            charts.window = [*charts.window, seen][-length:]
            place = repeated(charts.window, seen, self.settings)
            self._hold(Rule.REPEATED_PLACE, place is not None)
        else:
            charts.not_inspected += 1
        base = self._count_baseline(panel.recipe_id, recipe)
        return report(panel, charts, recipe, base, place, self.settings)

    def _recipe(self, recipe_id: int) -> Learning:
        recipes = self._state.recipes
        recipe = recipes.pop(recipe_id, None) or Learning()
        recipes[recipe_id] = recipe
        if len(recipes) > MOST_RECIPES:
            del recipes[next(iter(recipes))]
        return recipe

    def _count_baseline(self, recipe_id: int, recipe: Learning) -> CountBaseline | None:
        target = self.settings.target_of(recipe_id)
        return baseline.of_target(target) if target else recipe.count_baseline

    def _take_in(self, panel: Panel, recipe: Learning) -> Seen:
        charts, settings = self._state.charts, self.settings
        charts.panels += 1
        known_um = heights.known_heights(panel, settings.max_height_sigma)
        base = self._count_baseline(panel.recipe_id, recipe)
        expected = base.per_m2 * panel.area_m2 if base else None
        self._learn_or_chart_count(panel, recipe, base)
        if known_um:
            self._learn_or_chart_heights([math.log(h) for h in known_um], recipe)
        places = [p for p in panel.places_mm[:MOST_DEFECTS] if math.isfinite(p[0] + p[1])]
        x_min, y_min, x_max, y_max = panel.bounds_mm
        rim_mm = panel.rim_mm or 2.0 * (x_max - x_min + y_max - y_min)
        return Seen(
            panel.recipe_id,
            count=panel.count,
            area_m2=panel.area_m2,
            expected=expected,
            heights_um=known_um,
            neighbours=spread.neighbours(places, panel.area_m2 * 1e6, rim_mm),
            cell_chance=spread.cell_chance(len(places), panel.bounds_mm, panel.area_m2 * 1e6),
            cells=spread.cells_hit(places, panel.bounds_mm),
            bounds_mm=panel.bounds_mm,
        )

    def _learn_or_chart_count(self, panel: Panel, recipe: Learning, base: CountBaseline | None) -> None:
        if base is None:
            recipe.learn_count(panel.count, panel.area_m2, self.settings)
            return
        self._chart_count(panel, base)
        learns = base is recipe.count_baseline and base.panels < self.settings.baseline_settled_panels
        if learns and not self._state.charts.alarms:
            base.refine(panel.count, panel.area_m2)

    def _chart_count(self, panel: Panel, base: CountBaseline) -> None:
        charts, settings = self._state.charts, self.settings
        mean = base.per_m2 * panel.area_m2
        limits = counts.limits(mean, base.sigma_z, settings.limits, settings.tail)
        z = base.score(panel.count, panel.area_m2)
        charts.charted += 1
        charts.ewma.step(z, settings.ewma_weight)
        charts.cusum.step(z, settings.cusum_reference, settings.cusum_limit)
        width = charts.ewma.limit(settings.ewma_weight, settings.ewma_width)
        self._raise(Rule.COUNT_ABOVE, panel.count > limits.upper)
        self._raise(Rule.COUNT_BELOW, panel.count < limits.lower)
        self._hold(Rule.EWMA_ABOVE, charts.ewma.value > width)
        self._hold(Rule.EWMA_BELOW, charts.ewma.value < -width)
        self._hold(Rule.CUSUM_ABOVE, charts.cusum.above > settings.cusum_limit)
        self._hold(Rule.CUSUM_BELOW, charts.cusum.below > settings.cusum_limit)

    def _learn_or_chart_heights(self, logs: list[float], recipe: Learning) -> None:
        base = recipe.height_baseline
        if base is None:
            recipe.learn_heights(logs, self.settings)
            return
        self._chart_heights(base.score(logs), base)
        if base.panels < self.settings.baseline_settled_panels and not self._state.charts.alarms:
            base.refine(logs)

    def _chart_heights(self, z: float, base: HeightBaseline) -> None:
        charts, settings = self._state.charts, self.settings
        charts.height_group.append(z)
        size = len(charts.height_group)
        if size < settings.height_group_panels:
            return
        mean = sum(charts.height_group) / math.sqrt(size * (1.0 + size / base.panels))
        charts.height_group = []
        charts.height_means = [*charts.height_means, mean][-runs.LONGEST :]
        charts.run_rule = runs.broken(charts.height_means, settings.run_rules)
        side = runs.side(charts.height_means, charts.run_rule) if charts.run_rule else None
        self._hold(Rule.HEIGHT_ABOVE, side == 1)
        self._hold(Rule.HEIGHT_BELOW, side == -1)
        self._hold(Rule.HEIGHT_PATTERN, side == 0)

    def _raise(self, rule: Rule, broken: bool) -> None:
        """A rule that one panel breaks stands for a while, so that a slow reader sees it."""
        if broken:
            self._state.charts.alarms[rule] = self.settings.alarm_panels

    def _hold(self, rule: Rule, broken: bool) -> None:
        """A rule that a chart breaks stands while it does, one of groups until the next group."""
        if broken:
            self._state.charts.alarms[rule] = 0
        else:
            self._state.charts.alarms.pop(rule, None)

    def _age(self, charts: Charts, rule: Rule) -> None:
        left = charts.alarms[rule]
        if left == 1:
            del charts.alarms[rule]
        elif left > 1:
            charts.alarms[rule] = left - 1
