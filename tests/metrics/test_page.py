"""The page is what the format's own parser reads, every row of the table is on it, and nothing else."""

from __future__ import annotations

import subprocess
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from prometheus_client.parser import text_string_to_metric_families

from inspector.metrics import table, text
from inspector.metrics.table import METRICS, Scrape
from inspector.model import Snapshot


def read(page: bytes) -> dict[str, dict[str, float]]:
    """Samples by name, then by the values of their labels, joined."""
    samples: dict[str, dict[str, float]] = {}
    for family in text_string_to_metric_families(page.decode()):
        for sample in family.samples:
            samples.setdefault(sample.name, {})["/".join(sample.labels.values())] = sample.value
    return samples


def test_every_row_has_a_sample_and_every_sample_a_row(scrape: Scrape) -> None:
    assert set(read(text.page(scrape))) == table.names()


def test_names_are_given_once_and_say_their_kind_and_unit() -> None:
    assert not [name for name, times in Counter(metric.name for metric in METRICS).items() if times > 1]
    assert not [m.name for m in METRICS if (m.kind == "counter") is not m.name.endswith("_total")]
    assert not [m.name for m in METRICS if not m.meaning or (m.kind == "histogram" and m.unit != "seconds")]


def test_what_is_not_known_has_no_sample(scrape: Scrape) -> None:
    bare = replace(scrape, station=Snapshot(), posting=None, period_s=None)
    missing = table.names() - set(read(text.page(bare)))
    assert {"inspector_result_age_seconds", "inspector_posting_lost_total", "inspector_spc_alarm"} - missing == {
        "inspector_spc_alarm"
    }
    assert not [name for name in missing if "results_total" in name or "fault" in name]


def test_values_are_those_of_the_station(scrape: Scrape) -> None:
    samples = read(text.page(scrape))
    assert samples["inspector_results_total"] == {"NOT_INSPECTED": 1000, "PASS": 60000, "FAIL": 9000}
    assert samples["inspector_spc_alarm"]["CUSUM_ABOVE"] == 1
    assert sum(samples["inspector_spc_alarm"].values()) == 1
    assert (samples["inspector_spc_action_code"][""], samples["inspector_spc_ewma_sigmas"]["ewma"]) == (2, 0.4)
    assert samples["inspector_lamp_burnt_seconds"][""] == pytest.approx(812.4 * 3600)
    assert samples["inspector_fault_outages_total"]["501/CYCLE_STALLED"] == 1
    assert samples["inspector_cycle_seconds_bucket"]["0.015"] == 0
    assert samples["inspector_cycle_seconds_bucket"]["0.02"] == samples["inspector_cycle_seconds_bucket"]["+Inf"] == 1


@given(st.text())
def test_a_station_may_be_called_anything(name: str) -> None:
    scrape = Scrape(Snapshot(), table.Observed(), _DIAGNOSTICS, 0.0, 0.0, name, "1")
    (identity,) = read(text.page(scrape))["inspector_settings_info"]
    assert name in identity


_DIAGNOSTICS = table.Diagnostics(*(0,) * 9, {}, *(0,) * 3)


@pytest.mark.long
def test_promtool_finds_nothing_to_say(scrape: Scrape, peer: Callable[[str, str], str]) -> None:
    command: list[Any] = [peer("promtool", "prometheus"), "check", "metrics"]
    done = subprocess.run(command, input=text.page(scrape), capture_output=True, timeout=60)
    assert (done.returncode, done.stdout + done.stderr) == (0, b"")
