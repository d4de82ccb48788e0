"""`inspector bench` measures every stage on every frame; how long things take is not a test's business."""

from __future__ import annotations

import json
from typing import Any

import pytest
from typer.testing import CliRunner

from inspector.cli.app import app
from inspector.commands import benchmark
from inspector.commands.benchmark_frames import CROWDS, SIZES, draw
from inspector.pipeline import inspect

ALWAYS = set(benchmark.MEANINGS) - set(benchmark.OTHERS.values())


def test_a_quick_run_measures_everything_everywhere() -> None:
    result = CliRunner().invoke(app, ["bench", "--quick", "--format", "json"])
    assert result.exit_code == 0, result.output
    report: dict[str, Any] = json.loads(result.stdout)
    rows = {(row["size"], row["crowd"], row["what"]): row for row in report["rows"]}
    assert {(s, c, what) for s in SIZES for c in CROWDS for what in ALWAYS} <= set(rows)
    assert all(row["p50_us"] <= row["p99_us"] for row in rows.values())
    assert rows["12 MP", "sparse", benchmark.READ_PASS]["of_read_pass"] == 1
    assert rows["12 MP", "sparse", benchmark.TWO_CALLS]["of_two_calls"] == 1
    for module, what in benchmark.OTHERS.items():  # measured, or said by name that it is not there
        assert ((*next(iter(rows))[:2], what) in rows) != any(module in text for text in report["missing"])


def test_the_table_has_a_line_for_each_row_and_says_where_and_with_what() -> None:
    rows = tuple(
        benchmark.Row(size, crowd, what, 100.0 + n, 200.0 + n, 1.5, 0.25)
        for size in SIZES
        for crowd in CROWDS
        for n, what in enumerate(benchmark.MEANINGS)
    )
    report = benchmark.Report(
        {"cpu": "abacus"}, {"opencv": "5.0"}, ("sep",), benchmark.ROUNDS, benchmark.MEANINGS, rows
    )
    lines = benchmark.table(report).splitlines()
    assert {"cpu: abacus", "opencv: 5.0", "opencv threads: 1", "not measured: sep"} <= set(lines)
    for n, what in enumerate(benchmark.MEANINGS):
        of_this = [line.split()[-4:] for line in lines if line.startswith(f"  {what}  ")]
        assert of_this == [[f"{100 + n:.1f}", f"{200 + n:.1f}", "1.50", "0.2500"]] * len(SIZES) * len(CROWDS)


@pytest.mark.parametrize("crowd", CROWDS)
def test_the_frames_are_what_they_claim(crowd: str) -> None:
    case = draw("640x480", crowd)
    result = inspect(case.frame, case.station)
    assert len(result.defects) == case.seeds
    assert not result.unpaired


def test_a_frame_that_is_not_inspected_right_is_not_timed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(CROWDS, "sparse", 5)
    case = draw("640x480", "sparse")
    monkeypatch.setitem(CROWDS, "sparse", 6)
    with pytest.raises(ValueError, match="5 of 6 seeds found"):
        benchmark._stages(case)
