"""The statistics of a line: what a panel changes, what raises an alarm, what is advised, what survives a restart."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from inspector.judge.spc import report
from inspector.judge.spc.monitor import MOST_RECIPES, Monitor
from inspector.judge.spc.panel import Panel
from inspector.judge.spc.settings import ActionRow, StatisticsSettings, Target, When
from inspector.judge.spc.spread import CELLS, cells_hit, centre_mm
from inspector.line_statistics import Action, Rule, Spread, Statistics, TooLittle, Trend

BOUNDS = (0.0, 0.0, 400.0, 300.0)
AREA_M2 = 0.12
LEARNT = StatisticsSettings(targets=(Target(per_m2=4 / AREA_M2),))


class Line:
    """A paint line: random panels by seed."""

    def __init__(self, seed: int = 1) -> None:
        self._draw = np.random.default_rng(seed)

    def panel(self, mean: float = 4.0, *, height_um: float = 250.0, recipe_id: int = 1, spot_mm: float = 0.0) -> Panel:
        """Poisson's number of seeds, log-normal heights, random places; ``spot_mm``: all within a spot of that size."""
        count = int(self._draw.poisson(mean))
        heights = height_um * np.exp(self._draw.normal(0, 0.4, count))
        places = self._draw.random((count, 2)) * BOUNDS[2:]
        if spot_mm:
            places = self._draw.uniform(50, 250, 2) + self._draw.random((count, 2)) * spot_mm
        return panel_of(count, heights.tolist(), [tuple(p) for p in places.tolist()], recipe_id)


def panel_of(
    count: int, heights_um: list[float] | None = None, places: list[tuple[float, float]] | None = None, recipe: int = 1
) -> Panel:
    heights = tuple(heights_um or ())
    sigmas = tuple(0.05 * h for h in heights)
    return Panel(0.0, recipe, True, count, AREA_M2, heights, sigmas, tuple(places or ()), BOUNDS)


NOT_INSPECTED = Panel(0.0, 1, inspected=False)


def run(monitor: Monitor, line: Line, panels: int, mean: float = 4.0, **how: float) -> Statistics:
    for _ in range(panels):
        statistics = monitor.add(line.panel(mean, **how))
    return statistics


def test_the_first_panels_are_the_baseline_and_raise_nothing() -> None:
    monitor, line = Monitor(StatisticsSettings()), Line()
    for n in range(50):
        statistics = monitor.add(line.panel(40.0 if n == 20 else 4.0))
        assert not statistics.alarm
        assert bool(statistics.too_little & TooLittle.BASELINE) == (n < 49)
    assert statistics.baseline_per_m2 == pytest.approx(4 / AREA_M2, rel=0.2), "the wild panel is left out"
    assert not statistics.baseline_is_doubtful
    assert statistics.action == 0


def test_clean_panels_prolong_the_baseline_but_not_for_ever() -> None:
    monitor = Monitor(StatisticsSettings(baseline_panels=10))
    for _ in range(39):
        assert monitor.add(panel_of(0)).too_little & TooLittle.BASELINE
    statistics = monitor.add(panel_of(0))
    assert statistics.baseline_per_m2 == pytest.approx(0.5 / (40 * AREA_M2)), "no defect at all counts as half of one"
    assert not statistics.alarm


def test_a_baseline_from_a_line_out_of_order_is_doubtful() -> None:
    monitor = Monitor(StatisticsSettings())
    for n in range(50):
        statistics = monitor.add(panel_of(2 if n < 30 else 30))
    assert statistics.baseline_is_doubtful


def test_panels_that_were_not_inspected_are_no_clean_panels() -> None:
    monitor, line = Monitor(LEARNT), Line()
    before = run(monitor, line, 30)
    for _ in range(20):
        after = monitor.add(NOT_INSPECTED)
    assert (after.ewma, after.cusum_below, after.recent_per_m2) == (
        before.ewma,
        before.cusum_below,
        before.recent_per_m2,
    )
    assert (after.panels, after.panels_not_inspected, after.count, after.per_m2) == (30, 20, None, None)
    assert after.action == Action.CHECK_STATION
    assert not after.alarm


@pytest.mark.parametrize(
    "panel", [replace(panel_of(3), area_m2=a) for a in (0.0, -1.0, math.nan, math.inf)] + [panel_of(-1)]
)
def test_a_panel_of_unknown_area_or_count_is_none(panel: Panel) -> None:
    statistics = Monitor(LEARNT).add(panel)
    assert (statistics.panels, statistics.panels_not_inspected) == (0, 1)


def test_heights_that_are_no_numbers_or_not_known_well_are_left_out() -> None:
    monitor = Monitor(LEARNT)
    wrong = Panel(0, 1, True, 4, AREA_M2, (math.nan, -5.0, 900.0, 100.0), (None, None, 800.0, 5.0), ((math.nan, 1.0),))
    for _ in range(10):
        statistics = monitor.add(wrong)
    assert statistics.largest_um == statistics.median_um == 100.0
    assert statistics.count == 4


def test_one_panel_over_its_limit_is_an_alarm_for_some_panels() -> None:
    monitor, line = Monitor(LEARNT), Line()
    run(monitor, line, 60)
    assert monitor.add(panel_of(15)).rule is Rule.COUNT_ABOVE
    assert monitor.add(panel_of(4)).action == Action.WATCH
    alarms = [monitor.add(panel_of(4)).alarm for _ in range(6)]
    assert alarms == [True] * 3 + [False] * 3


def test_limits_follow_the_area_in_view() -> None:
    monitor = Monitor(LEARNT)
    small = monitor.add(replace(panel_of(1), area_m2=AREA_M2 / 4))
    large = monitor.add(panel_of(4))
    assert small.upper_per_m2 is not None
    assert large.upper_per_m2 is not None
    assert small.upper_per_m2 > large.upper_per_m2 > 4 / AREA_M2


def test_twice_the_dirt_is_found_and_advised_upon() -> None:
    monitor, line = Monitor(LEARNT), Line()
    assert not run(monitor, line, 200).alarm
    found = run(monitor, line, 30, mean=8.0)
    assert found.rule is Rule.CUSUM_ABOVE
    assert found.ratio == pytest.approx(2.0, abs=0.5)
    assert 20 <= found.panels_since_change <= 40, "the change is dated by the CUSUM"
    assert (found.action, found.confidence) == (Action.CHECK_FILTER, 0.7)
    assert found.trend is Trend.RISING
    assert found.spread is Spread.RANDOM


def test_several_times_the_dirt_holds_the_line() -> None:
    monitor, line = Monitor(LEARNT), Line()
    run(monitor, line, 60)
    assert run(monitor, line, 10, mean=24.0).action == Action.HOLD


def test_defects_in_clusters_ask_for_cleaning() -> None:
    monitor, line = Monitor(LEARNT), Line()
    run(monitor, line, 60)
    found = run(monitor, line, 30, mean=9.0, spot_mm=60.0)
    assert found.spread is Spread.CLUSTERED
    assert found.spread_index is not None
    assert found.spread_index < 0.6
    assert found.action == Action.CLEAN_BOOTH


def test_a_place_that_comes_back_is_told_with_its_place() -> None:
    monitor, line = Monitor(LEARNT), Line()
    run(monitor, line, 60, mean=3.0)
    for _ in range(12):
        panel = line.panel(3.0)
        jitter = float(panel.count)  # as an encoder's panels have it
        marked = replace(
            panel,
            count=panel.count + 1,
            places_mm=(*panel.places_mm, (300.0, 100.0)),
            bounds_mm=(0.0, 0.0, 400.0 + jitter, 300.0),
        )
        statistics = monitor.add(marked)
    assert statistics.rule is Rule.REPEATED_PLACE
    assert statistics.repeated is not None
    assert math.dist((statistics.repeated.x_mm, statistics.repeated.y_mm), (300.0, 100.0)) < 40.0
    assert statistics.action == Action.CHECK_FIXTURE


def test_a_cluster_on_one_panel_is_no_place_that_comes_back() -> None:
    monitor, line = Monitor(LEARNT), Line()
    run(monitor, line, 40, mean=2.0)
    statistics = monitor.add(panel_of(40, places=[(300.0 + n / 10, 100.0) for n in range(40)]))
    assert statistics.repeated is None


def test_higher_seeds_are_found_by_run_rules_once_heights_have_a_baseline() -> None:
    monitor, line = Monitor(StatisticsSettings()), Line()
    assert run(monitor, line, 49).too_little & TooLittle.HEIGHT_BASELINE
    assert not run(monitor, line, 100).alarm
    found = run(monitor, line, 45, height_um=400.0)
    assert found.rule is Rule.HEIGHT_ABOVE
    assert found.run_rule in (1, 2)
    assert found.action == Action.CHECK_PAINT
    assert run(Monitor(StatisticsSettings(run_rules=())), line, 200, height_um=400.0).run_rule == 0


def test_fewer_defects_than_usual_are_suspicious_too() -> None:
    monitor, line = Monitor(LEARNT), Line()
    run(monitor, line, 60)
    found = run(monitor, line, 40, mean=0.3)
    assert found.rule in (Rule.CUSUM_BELOW, Rule.EWMA_BELOW)
    assert found.action == Action.CHECK_LAMP


def test_a_fault_s_end_ends_the_alarm_within_the_fault_s_own_length() -> None:
    monitor, line = Monitor(LEARNT), Line()
    run(monitor, line, 60)
    assert run(monitor, line, 100, mean=12.0).alarm
    assert not run(monitor, line, 60).alarm


def test_after_a_reset_charts_begin_anew_with_a_head_start_and_baselines_stay() -> None:
    monitor, line = Monitor(StatisticsSettings()), Line()
    run(monitor, line, 60)
    assert run(monitor, line, 30, mean=9.0).alarm
    monitor.reset()
    statistics = monitor.add(panel_of(4))
    assert not statistics.alarm
    assert not statistics.too_little & TooLittle.BASELINE
    assert statistics.cusum_above == pytest.approx(0.5 * 8.0, abs=1.0)
    monitor.relearn()
    assert monitor.add(panel_of(4)).too_little & TooLittle.BASELINE


def test_each_recipe_has_its_baseline_and_all_share_the_charts() -> None:
    monitor, light, dark = Monitor(StatisticsSettings()), Line(1), Line(2)
    for _ in range(100):
        monitor.add(light.panel(2.0, recipe_id=1))
        statistics = monitor.add(dark.panel(10.0, recipe_id=2))
        assert not statistics.alarm, "a colour that shows more seeds is no fault"
    for _ in range(15):
        monitor.add(light.panel(4.0, recipe_id=1))
        statistics = monitor.add(dark.panel(20.0, recipe_id=2))
    assert statistics.rule is Rule.CUSUM_ABOVE
    assert statistics.ratio == pytest.approx(2.0, abs=0.5)


def test_memory_of_recipes_is_bounded() -> None:
    monitor = Monitor(StatisticsSettings())
    for recipe in range(1, MOST_RECIPES + 50):
        monitor.add(panel_of(1, recipe=recipe))
    assert len(json.loads(monitor.to_json())["recipes"]) == MOST_RECIPES


def test_scattered_counts_widen_limits_and_the_overdispersion_is_told() -> None:
    draw, monitor = np.random.default_rng(3), Monitor(StatisticsSettings())
    for _ in range(400):
        count = int(draw.poisson(8.0 * draw.gamma(4.0, 0.25)))
        statistics = monitor.add(panel_of(count))
    assert statistics.overdispersion > 1.5
    assert not statistics.alarm


@given(st.lists(st.integers(-1, 40), max_size=90), st.integers(0, 5))
def test_a_restart_changes_nothing(history: list[int], seed: int) -> None:
    """Counts of panels, -1 for one not inspected; the text is read back in the middle."""
    settings, line = StatisticsSettings(baseline_panels=10, window_panels=20), Line(seed)
    panels = [NOT_INSPECTED if count < 0 else line.panel(count) for count in history]
    through, halted = Monitor(settings), Monitor(settings)
    for n, panel in enumerate(panels):
        if n % 30 == 17:
            halted = Monitor.from_json(settings, halted.to_json())
        assert halted.add(panel) == through.add(panel)
    assert halted.to_json() == through.to_json()


@pytest.mark.parametrize(
    ("change", "place"),
    [
        (lambda d: d.update(version=2), "version"),
        (lambda d: d.update(more=1), "more"),
        (lambda d: d["charts"]["ewma"].update(value="high"), "charts.ewma.value"),
        (lambda d: d["charts"]["cusum"].pop("above") and None, ""),
        (lambda d: d["charts"].update(window=[{"count": 1}]), "charts.window.0"),
    ],
)
def test_a_wrong_history_is_refused_with_its_place(change, place: str) -> None:
    monitor = Monitor(StatisticsSettings())
    monitor.add(panel_of(3))
    data = json.loads(monitor.to_json())
    change(data)
    if not place:
        assert Monitor.from_json(StatisticsSettings(), json.dumps(data)), "what is missing begins anew"
        return
    with pytest.raises(ValueError, match=place):
        Monitor.from_json(StatisticsSettings(), json.dumps(data))


@pytest.mark.parametrize("text", ["", "[]", "{", "null", '{"charts": {"ewma": {"value": NaN}}}'])
def test_what_is_no_history_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"\w"):
        Monitor.from_json(StatisticsSettings(), text)


@given(st.lists(st.tuples(st.integers(0, 300), st.floats(0.001, 5)), min_size=1, max_size=60))
def test_statistics_are_numbers_whatever_comes(panels: list[tuple[int, float]]) -> None:
    monitor = Monitor(StatisticsSettings(baseline_panels=10))
    for count, area_m2 in panels:
        statistics = monitor.add(replace(panel_of(count), area_m2=area_m2))
        values = [getattr(statistics, name) for name in Statistics.__slots__]
        assert all(math.isfinite(v) for v in values if isinstance(v, float))
        assert 0 <= statistics.confidence <= 1


def test_the_first_row_that_holds_advises_and_unknown_statistics_hold_nothing() -> None:
    row = ActionRow(when=When(max_ratio=9.0, trend=("STEADY",)), action=120, confidence=0.5, text="Look at gun 2")
    other = ActionRow(when=When(min_ratio=0.01), action="WATCH", confidence=0.5, text="Look")
    monitor = Monitor(StatisticsSettings(targets=(Target(per_m2=33.3),), actions=(row, other)))
    assert monitor.add(panel_of(4)).action == Action.WATCH, "no trend is known yet"
    for _ in range(20):
        statistics = monitor.add(panel_of(4))
    assert (statistics.action, statistics.action_text) == (120, "Look at gun 2")
    assert monitor.add(NOT_INSPECTED).action == 0, "nothing acts on a panel that was not inspected"
    assert report.codes(monitor.settings) == [(8, "WATCH"), (120, "Look at gun 2")]


@pytest.mark.parametrize(
    "wrong",
    [
        {"when": {}, "action": "HOLD", "confidence": 0.5, "text": "always"},
        {"when": {"min_ratio": 2}, "action": "PAINT", "confidence": 0.5, "text": "no such action"},
        {"when": {"min_ratio": 2}, "action": 7, "confidence": 0.5, "text": "numbers below 100 are ours"},
        {"when": {"rules": ["COUNT"]}, "action": "HOLD", "confidence": 0.5, "text": "no such rule"},
        {"when": {"min_ratio": 2}, "action": "HOLD", "confidence": 1.5, "text": "surer than sure"},
    ],
)
def test_a_wrong_row_is_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        ActionRow.model_validate_json(json.dumps(wrong))


def test_two_targets_for_one_recipe_are_refused() -> None:
    with pytest.raises(ValidationError, match="two targets"):
        StatisticsSettings(targets=(Target(per_m2=1.0), Target(per_m2=2.0)))


@pytest.mark.parametrize("name", [rule.name for rule in Rule if rule])
def test_every_rule_can_be_named_in_the_table(name: str) -> None:
    assert When.model_validate_json(json.dumps({"rules": [name]})).rules == (name,)


def test_every_cell_has_its_places() -> None:
    for cell in range(CELLS):
        x_mm, y_mm = centre_mm(cell, BOUNDS)
        inside = min(max(x_mm, 0.1), 399.9), min(max(y_mm, 0.1), 299.9)
        assert cell in cells_hit([inside], BOUNDS)
    assert cells_hit([(1.0, 1.0)], (0.0, 0.0, 0.0, 0.0)) == ()
    assert cells_hit([(-1.0, 1.0), (400.0, 300.0)], BOUNDS) == (47, CELLS - 1)
