"""Statistics in the service: fed by results, served whole, kept over restarts, never in the way of an inspection."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from inspector import calibration_file
from inspector.judge.spc.settings import DEFAULT_ACTIONS
from inspector.line_statistics import Action, Statistics
from inspector.model import Defect, FloatArray, Snapshot, Verdict
from inspector.pipeline import Station
from inspector.service import line_history
from inspector.service.line_history import Extent, LineHistory, extent_of
from inspector.settings import Settings, SettingsError, check, configuration_hash, load

ROOT = Path(__file__).parents[2]
DEMO = load(ROOT / "config" / "demo.yaml")
EXTENT = extent_of(calibration_file.read(DEMO.calibration).camera)


def result(sequence: int, seeds: int = 2, verdict: Verdict = Verdict.PASS) -> Snapshot:
    """A published result with seeds spread over the field."""
    x_min, y_min, x_max, y_max = EXTENT.bounds_mm
    golden = (math.sqrt(5) - 1) / 2
    share = [((sequence * 7 + n) * golden % 1, (sequence * 3 + n) * golden**2 % 1) for n in range(seeds)]
    defects = tuple(
        Defect(x_min + x * (x_max - x_min), y_min + y * (y_max - y_min), 300.0, 9.0, (0.0, 0.0), (0.0, 0.0))
        for x, y in share
    )
    return Snapshot(sequence=sequence, recipe_id=1, verdict=verdict, defects=defects, result_at_s=float(sequence))


def kept_in(folder: Path) -> Settings:
    return DEMO.model_copy(update={"statistics_file": folder / "statistics.json"})


class Clock:
    """Time that the test moves."""

    now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def history(tmp_path: Path, clock: Clock) -> Iterator[LineHistory]:
    history = LineHistory(kept_in(tmp_path), clock)
    yield history
    history.close()


def after(history: LineHistory, snapshot: Snapshot) -> Statistics:
    statistics = history.after(snapshot).statistics
    assert statistics is not None
    return statistics


def test_the_extent_is_the_area_that_limits_are_judged_by() -> None:
    calibration = calibration_file.read(DEMO.calibration)
    assert EXTENT.area_m2 == pytest.approx(Station(calibration).area_m2)
    x_min, y_min, x_max, y_max = EXTENT.bounds_mm
    assert 0 < EXTENT.area_m2 * 1e6 <= (x_max - x_min) * (y_max - y_min)
    assert EXTENT.rim_mm >= 2 * math.sqrt(math.pi * EXTENT.area_m2 * 1e6), "no rim is shorter than a circle's"


def test_each_result_carries_the_statistics_after_it(history: LineHistory) -> None:
    for sequence in range(1, 4):
        shown = history.after(result(sequence))
        assert shown.statistics_sequence == sequence
        assert shown.statistics is not None
        assert (shown.statistics.panels, shown.statistics.at_s) == (sequence, float(sequence))
    not_inspected = after(history, result(4, 0, Verdict.NOT_INSPECTED))
    assert (not_inspected.panels, not_inspected.panels_not_inspected, not_inspected.inspected) == (3, 1, False)


def test_an_outage_leaves_the_recent_panels_as_they_were(history: LineHistory) -> None:
    for sequence in range(1, 60):
        before = after(history, result(sequence))
    for sequence in range(60, 700):
        outage = after(history, result(sequence, 0, Verdict.NOT_INSPECTED))
    assert outage.action == Action.CHECK_STATION
    back = after(history, result(700))
    assert (back.recent_panels, back.baseline_per_m2) == (before.recent_panels, pytest.approx(before.baseline_per_m2))


def test_a_restart_goes_on_where_the_service_stopped(tmp_path: Path) -> None:
    first = LineHistory(kept_in(tmp_path))
    for sequence in range(1, 71):
        last = after(first, result(sequence))
    first.close()
    second = LineHistory(kept_in(tmp_path))
    goes_on = after(second, result(71))
    second.close()
    assert goes_on.panels == last.panels + 1
    assert goes_on.baseline_per_m2 is not None


def test_what_a_crash_costs_is_the_time_since_the_last_write(tmp_path: Path, clock: Clock) -> None:
    crashes = LineHistory(kept_in(tmp_path), clock)
    for sequence in range(1, 8):
        clock.now_s = sequence * line_history.SAVE_EVERY_S / 3
        crashes.after(result(sequence))
        assert crashes._written is None or crashes._written.result(10) is None
    crashes._writer.shutdown()  # what was handed over is written; what came after is lost
    again = LineHistory(kept_in(tmp_path), clock)
    assert after(again, result(8)).panels == 7
    again.close()


@pytest.mark.parametrize("text", ["", "{", '{"version": 9}', '{"charts": {"panels": "many"}}', "\x00\x01", "[1]"])
def test_a_damaged_file_is_put_aside_and_named(tmp_path: Path, text: str, caplog: pytest.LogCaptureFixture) -> None:
    file = tmp_path / "statistics.json"
    file.write_text(text)
    history = LineHistory(kept_in(tmp_path))
    assert after(history, result(1)).panels == 1
    history.close()
    assert (tmp_path / "statistics.json.damaged").read_text() == text
    assert str(file) in caplog.text
    assert "put aside" in caplog.text
    assert json.loads(file.read_text())["charts"]["panels"] == 1


def test_a_file_that_is_no_text_is_put_aside_too(tmp_path: Path) -> None:
    (tmp_path / "statistics.json").write_bytes(b"\xff\xfe\x00")
    LineHistory(kept_in(tmp_path)).close()
    assert (tmp_path / "statistics.json.damaged").exists()


def test_a_file_that_cannot_be_written_is_said_once_and_stops_nothing(
    tmp_path: Path, clock: Clock, caplog: pytest.LogCaptureFixture
) -> None:
    history = LineHistory(kept_in(tmp_path / "missing"), clock)
    for sequence in range(1, 6):
        clock.now_s = 100.0 * sequence
        assert after(history, result(sequence)).panels == sequence
    history.close()
    assert caplog.text.count("cannot be written") == 1
    assert "statistics.json" in caplog.text


def test_without_a_file_nothing_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    history = LineHistory(DEMO)
    after(history, result(1))
    history.close()
    assert list(tmp_path.iterdir()) == []


def test_statistics_that_fail_cost_no_result(
    history: LineHistory, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fails(_: object) -> None:
        raise ZeroDivisionError

    with monkeypatch.context() as broken:
        broken.setattr(history._monitor, "add", fails)
        for sequence in (1, 2):
            shown = history.after(result(sequence))
            assert (shown.statistics, shown.sequence, shown.verdict) == (None, sequence, Verdict.PASS)
    assert caplog.text.count("statistics fails") == 1
    assert after(history, result(3)).panels == 1


def test_a_reset_begins_charts_or_baselines_anew_and_is_kept(history: LineHistory, tmp_path: Path) -> None:
    for sequence in range(1, 61):
        after(history, result(sequence))
    history.reset(line_history.CHARTS_ANEW)
    reset = after(history, result(61))
    assert (reset.panels, reset.recent_panels) == (1, 1)
    assert reset.baseline_per_m2 is not None
    history.reset(line_history.BASELINES_ANEW)
    assert after(history, result(62)).baseline_per_m2 is None
    with pytest.raises(SettingsError, match=r"command_argument: '?2'?: allowed: 0 the charts"):
        history.reset(2)


def test_new_settings_go_on_with_what_is_remembered(history: LineHistory) -> None:
    for sequence in range(1, 61):
        after(history, result(sequence))
    wide = DEMO.statistics.model_copy(update={"window_panels": 20})
    history.take_over(DEMO.model_copy(update={"statistics": wide}), EXTENT)
    found = after(history, result(61))
    assert (found.panels, found.recent_panels) == (61, 20)


def test_a_camera_that_sees_past_the_panel_has_an_unknown_area() -> None:
    class Camera:
        def outline_mm(self) -> FloatArray:
            return np.array([[0.0, 0.0], [100.0, 0.0], [math.nan, math.nan], [0.0, 100.0]])

    assert extent_of(cast(Any, Camera())) == Extent(0.0)


def test_the_table_that_comes_with_the_program_is_the_one_without_a_table() -> None:
    line = check(ROOT / "config" / "line.yaml")
    assert line.statistics.actions == DEFAULT_ACTIONS


def test_a_wrong_table_is_refused_with_its_place(tmp_path: Path) -> None:
    text = (ROOT / "config" / "demo.yaml").read_text()
    text = text.replace("calibration/demo.yaml", str(ROOT / "config" / "calibration" / "demo.yaml"))
    file = tmp_path / "station.yaml"
    file.write_text(text + "\nstatistics: {actions: actions.yaml}\n")
    table = tmp_path / "actions.yaml"
    row = "- when: {rules: [CUSUM_ABOVE]}\n  action: PAINT_IT_BLACK\n  confidence: 0.5\n  text: no such action\n"
    table.write_text(row)
    with pytest.raises(SettingsError, match=r"actions.yaml:2: statistics.actions\[0\].action"):
        load(file)
    table.write_text(row.replace("PAINT_IT_BLACK", "140"))
    assert load(file).statistics.actions[0].action == 140
    table.unlink()
    with pytest.raises(SettingsError, match="cannot be read"):
        load(file)


def test_the_history_file_is_no_part_of_the_configuration(tmp_path: Path) -> None:
    assert configuration_hash(kept_in(tmp_path)) == configuration_hash(DEMO)
