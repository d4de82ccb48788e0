"""Rules and dashboard name what there is, and do what their tests say, in Prometheus' own hands."""

from __future__ import annotations

import json
import re
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

from inspector.metrics import dashboard, table
from inspector.metrics.table import METRICS

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "deploy" / "prometheus"
RULES = [rule for group in yaml.safe_load((FOLDER / "alerts.yml").read_text())["groups"] for rule in group["rules"]]
PANELS = [panel for panel in json.loads(dashboard.as_json())["panels"] if panel["type"] != "row"]
EXPRESSIONS = [rule["expr"] for rule in RULES] + [panel["targets"][0]["expr"] for panel in PANELS]


@pytest.mark.parametrize(("file", "made"), [
    ("deploy/prometheus/dashboard.json", dashboard.as_json), ("docs/metrics.md", dashboard.as_markdown),
])  # fmt: skip
def test_the_committed_copy_is_current(file: str, made: Callable[[], str]) -> None:
    assert (ROOT / file).read_text() == made(), "run: make docs"


@pytest.mark.parametrize("expression", EXPRESSIONS)
def test_expressions_name_what_there_is(expression: str) -> None:
    named = set(re.findall(r"\b(?:inspector|process)_\w+", expression))
    assert named <= table.names()
    assert named or 'up{job="inspector"}' in expression


def test_every_metric_has_its_panel_and_none_lies_on_another() -> None:
    assert [panel["description"] for panel in PANELS] == [metric.name for metric in METRICS]
    cells = [(p["gridPos"]["x"], p["gridPos"]["y"]) for p in json.loads(dashboard.as_json())["panels"]]
    assert len(set(cells)) == len(cells)


def test_every_rule_says_what_to_do_and_has_its_test() -> None:
    tests = (FOLDER / "alerts_test.yml").read_text()
    firing = set(re.findall(r'labels: .*alertname="(\w+)"', tests))
    assert firing == {rule["alert"] for rule in RULES}
    assert not [rule["alert"] for rule in RULES if not {"summary", "remedy"} <= rule["annotations"].keys()]
    assert {rule["labels"]["severity"] for rule in RULES} == {"page", "ticket"}


@pytest.mark.long
def test_promtool_takes_rules_settings_and_every_expression(tmp_path: Path, peer: Callable[[str, str], str]) -> None:
    promtool = peer("promtool", "prometheus")
    rules = [{"record": f"of:{n}", "expr": expression} for n, expression in enumerate(EXPRESSIONS)]
    (tmp_path / "all.yml").write_text(yaml.safe_dump({"groups": [{"name": "all", "rules": rules}]}))
    checks = (
        ("check", "rules", "alerts.yml"),
        ("test", "rules", "alerts_test.yml"),
        ("check", "config", "prometheus.yml"),
        ("check", "rules", tmp_path / "all.yml"),
    )
    for check in checks:
        done = subprocess.run([promtool, *check], cwd=FOLDER, capture_output=True, text=True, timeout=100)
        assert done.returncode == 0, done.stdout + done.stderr
