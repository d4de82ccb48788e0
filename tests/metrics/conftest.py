"""A scrape of a station that does not run, with a value for everything there is."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from inspector.line_statistics import Action, Rule, Spread, Statistics, TooLittle, Trend
from inspector.metrics import process
from inspector.metrics.observed import Levels, Observed
from inspector.metrics.server import MetricsServer
from inspector.metrics.settings import MetricsSettings
from inspector.metrics.table import ARCHIVE, Scrape
from inspector.model import PlcSide, Snapshot, State
from inspector.publish.outbox import Outbox
from inspector.publish.plc_server import PlcServer

STATISTICS = Statistics(
    at_s=5.0, recipe_id=3, inspected=True, too_little=TooLittle(0), panels=900, panels_not_inspected=9,
    not_inspected_share=0.01, count=2, per_m2=10.0, recent_panels=50, recent_per_panel=1.5, recent_per_m2=7.5,
    baseline_per_m2=5.0, baseline_is_doubtful=False, ratio=1.5, upper_per_m2=20.0, lower_per_m2=0.5,
    overdispersion=1.0, ewma=np.float64(0.4), ewma_limit=0.9, cusum_above=9.0, cusum_below=0.0, cusum_limit=8.0,
    median_um=1500.0, p95_um=2500.0, largest_um=2600.0, large_share=0.1, mean_height=0.2, trend=Trend.RISING,
    trend_percent=12.0,
    spread=Spread.RANDOM, spread_index=1.0, repeated=None, alarm=True, rule=Rule.CUSUM_ABOVE, run_rule=0,
    alarm_text="more defects", panels_since_change=12, action=Action.CHECK_FILTER,
)  # fmt: skip
STATION = Snapshot(
    state=State.CONTINUOUS_EXECUTION, sequence=70000, verdict=1, panels_passed=60000, panels_failed=9000,
    panels_not_inspected=1000, missed_triggers=4, late_triggers=5, overruns=6, lamp_set_v=4.0, lamp_read_v=3.99,
    lamp_ok=True, camera_ok=True, result_at_s=7.0, configuration_hash=0xABC, recipe_id=3,
    plc=PlcSide(results_waiting=2), statistics=STATISTICS,
)  # fmt: skip


@pytest.fixture
def scrape() -> Scrape:
    """A station at work, everything of it known."""
    observed = Observed()
    observed.turned(0.02, 4000.0, Levels(80.0, 1000.0, 812.4))
    observed.grab.add(0.012)
    observed.module_request.add(0.003)
    plc = replace(PlcServer().diagnostics, connected=2, requests=100, exceptions={1: 3, 2: 4}, stalls=1)
    box = Outbox(8, False, STATION, lost=3)
    offered = {"inspector_log_lines_lost_total": 1.0} | {metric.name: 1.0 for metric in ARCHIVE}
    return Scrape(STATION, observed, plc, 7.5, 1.8e9, "line 4", "1.2.3", 0.02, box, process.now(), offered)


@pytest.fixture
def serving(scrape: Scrape) -> Iterator[Callable[..., MetricsServer]]:
    """``serving(scrape_now, **settings)``: a page served on any free port until the test ends."""
    servers: list[MetricsServer] = []

    def start(scrape_now: Callable[[], Scrape] = lambda: scrape, **settings: Any) -> MetricsServer:
        servers.append(MetricsServer(MetricsSettings(**{"port": 0} | settings), scrape_now))
        servers[-1].start()
        return servers[-1]

    yield start
    for server in servers:
        server.stop()
