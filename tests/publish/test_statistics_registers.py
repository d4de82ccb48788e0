"""The statistics area: what is not known has no value, integers and floats agree, nothing stale is valid."""

from __future__ import annotations

import math
import struct
from dataclasses import replace
from typing import Any

import pytest

from inspector.judge.spc.monitor import Monitor
from inspector.judge.spc.panel import Panel
from inspector.judge.spc.settings import StatisticsSettings, Target
from inspector.line_statistics import ACTION_MEANINGS, RULE_MEANINGS, Action, Place, Rule, Statistics
from inspector.model import Snapshot
from inspector.publish.plc_server import as_stalled
from inspector.publish.registers import REGISTERS, decode, encode_image
from inspector.publish.statistics_registers import STATISTICS_ADDRESS, StatisticsStatus
from inspector.publish.wire_fields import WordOrder
from inspector.snapshots import stopped

KNOWN = StatisticsSettings(targets=(Target(per_m2=100.0),))


def panel(count: int = 3, *, inspected: bool = True) -> Panel:
    heights = tuple(200.0 + 10 * n for n in range(count))
    return Panel(7.0, 12, inspected, count, 0.03, heights, (5.0,) * count, ((10.0, 10.0),) * count, (0, 0, 200, 150))


def statistics_of(*panels: Panel, settings: StatisticsSettings = KNOWN) -> Statistics:
    monitor = Monitor(settings)
    for each in panels:
        statistics = monitor.add(each)
    return statistics


def area(statistics: Statistics | None, order: WordOrder = "high_first", now_s: float = 9.5) -> dict[str, Any]:
    image = encode_image(Snapshot(statistics=statistics, statistics_sequence=65_541), now_s, 0, order)
    data = dict(image.areas)[STATISTICS_ADDRESS]
    assert len(data) == 250
    return decode(struct.unpack(">125H", data), STATISTICS_ADDRESS, order)


def test_without_statistics_nothing_has_a_value_and_nothing_is_advised() -> None:
    shown = area(None)
    codes = ("statistics_status", "alarm_rule", "run_rule", "action", "statistics_recipe_id", "trend", "spread")
    assert {shown[name] for name in codes} == {0}
    known = [name for name in shown if name not in codes and not name.startswith("statistics_sequence")]
    assert [name for name in known if shown[name] is not None] == []


def test_zeroed_registers_advise_nothing() -> None:
    zeros = decode([0] * 125, STATISTICS_ADDRESS)
    assert (zeros["statistics_status"], zeros["alarm_rule"], zeros["action"]) == (0, Rule.NONE, Action.NONE)


def test_the_area_opens_and_closes_with_the_sequence() -> None:
    shown = area(statistics_of(panel()))
    assert shown["statistics_sequence"] == shown["statistics_sequence_end"] == 5
    ends = [row.address for row in REGISTERS if row.name == "statistics_sequence_end"]
    assert ends == [STATISTICS_ADDRESS + 124]


@pytest.mark.parametrize("order", ["high_first", "low_first"])
def test_what_is_known_is_told_in_both_kinds(order: WordOrder) -> None:
    shown = area(statistics_of(*[panel()] * 30, panel(20)), order)
    assert shown["panel_defects"] == 20
    assert shown["statistics_recipe_id"] == 12
    assert shown["statistics_panels"] == 31
    assert shown["statistics_age_ms"] == 2500
    assert shown["baseline_per_m2"] == shown["baseline_per_m2_f32"] == 100.0
    assert shown["per_m2_f32"] == pytest.approx(20 / 0.03, rel=1e-6)
    assert (shown["median_height_um"], shown["recent_largest_um"]) == (210, 390)
    twins = [name for name in shown if f"{name}_f32" in shown]
    scales = {row.name: row.scale for row in REGISTERS}
    assert len(twins) == 16
    for name in twins:
        if shown[name] is None:
            assert shown[f"{name}_f32"] is None
        else:
            assert shown[name] == pytest.approx(shown[f"{name}_f32"], abs=scales[name] / 2 + 1e-6)
    bits = StatisticsStatus(shown["statistics_status"])
    assert StatisticsStatus.VALID | StatisticsStatus.ALARM | StatisticsStatus.BASELINE in bits
    assert StatisticsStatus.HEIGHT_BASELINE not in bits
    assert shown["action"] != 0
    assert 0 < shown["confidence"] <= 1


def test_after_a_panel_that_was_not_inspected_nothing_is_valid() -> None:
    shown = area(statistics_of(*[panel()] * 30, panel(40), panel(inspected=False)))
    assert not StatisticsStatus(shown["statistics_status"]) & StatisticsStatus.VALID
    assert shown["panel_defects"] is None
    assert shown["action"] == 0


def test_a_place_is_told_in_millimetres_and_one_far_out_saturates() -> None:
    statistics = statistics_of(panel())
    there = area(replace(statistics, repeated=Place(123.4, -56.7, 9)))
    assert (there["repeated_x_mm"], there["repeated_y_mm"]) == (pytest.approx(123.4), pytest.approx(-56.7))
    assert there["repeated_panels"] == 9
    assert not there["statistics_status"] & StatisticsStatus.SATURATED_VALUE
    far = area(replace(statistics, repeated=Place(1e9, -math.inf, 9)))
    assert far["statistics_status"] & StatisticsStatus.SATURATED_VALUE


def test_a_station_that_stalls_or_stops_stands_behind_no_statistics() -> None:
    live = Snapshot(statistics=statistics_of(*[panel()] * 30, panel(40)))
    assert live.statistics is not None
    assert as_stalled(live).statistics is None
    assert stopped(live).statistics is None


def test_every_rule_and_action_is_explained() -> None:
    assert set(RULE_MEANINGS) == set(Rule)
    assert set(ACTION_MEANINGS) == set(Action)
