"""A running station's page of measured values tells what its registers tell; nothing of it costs a station without."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import urllib.request
from collections.abc import Callable
from typing import Any

import pytest
from prometheus_client.parser import text_string_to_metric_families

SAME = {
    "inspector_result_sequence": "sequence_u32",
    'inspector_results_total{verdict="PASS"}': "panels_passed",
    'inspector_results_total{verdict="FAIL"}': "panels_failed",
    'inspector_results_total{verdict="NOT_INSPECTED"}': "panels_not_inspected",
    "inspector_triggers_missed_total": "missed_triggers",
    "inspector_triggers_late_total": "late_triggers",
    "inspector_results_overrun_total": "overruns",
    'inspector_queue_results{queue="plc"}': "results_waiting",
    "inspector_result_defects": "defect_count",
}
"""Samples, and the register that holds the same number."""


def samples(port: int) -> dict[str, float]:
    """Every sample of the page, named as in the format."""
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=20) as answer:
        families = [*text_string_to_metric_families(answer.read().decode())]
    return {_named(sample): sample.value for family in families for sample in family.samples}


def _named(sample: Any) -> str:
    labels = ",".join(f'{name}="{value}"' for name, value in sample.labels.items())
    return f"{sample.name}{{{labels}}}" if labels else str(sample.name)


@pytest.fixture
def metrics_port(wait_until: Callable[..., Any]) -> Callable[[Any], int]:
    """``metrics_port(service)``: the port that its log names last."""

    def port(service: Any) -> int:
        def said() -> list[str]:
            return [found[1] for line in service.log if (found := re.search(r"metrics on \S+:(\d+)/", line))]

        return int(wait_until(said, "the metrics' port")[-1])

    return port


def test_the_page_tells_what_the_registers_tell(
    station: Any,
    module: Callable[..., Any],
    service: Callable[..., Any],
    metrics_port: Callable[[Any], int],
    wait_until: Callable[..., Any],
) -> None:
    module()
    # Triggered by hand, results stand still while both are read.
    station.settings |= {"metrics": {"port": 0}, "cycle": {"trigger": {"kind": "by_hand"}, "retry_first_s": 0.05}}
    station.write()
    at_work = service()
    for sequence in (1, 2, 3):
        at_work.until(lambda r: r["state"] == 2, "ready")
        at_work.send(signal.SIGUSR1)
        at_work.until(lambda r, n=sequence: r["sequence"] == n, "a result")
    registers, port = at_work.until(lambda r: r["state"] == 2, "ready"), metrics_port(at_work)

    def page() -> dict[str, float] | None:
        found = samples(port)
        return found if found["inspector_result_sequence"] == 3 else None

    found = wait_until(page, "the third result on the page")
    assert {name: found[name] for name in SAME} == {name: registers[register] for name, register in SAME.items()}
    assert found['inspector_lamp_volts{level="read"}'] * 1000 == pytest.approx(registers["lamp_read_mv"], abs=0.51)
    assert found["inspector_exposure_seconds"] * 1e6 == registers["exposure_us"]
    assert [found[f"inspector_{what}_seconds_count"] for what in ("cycle", "inspection", "camera_grab")] == [3, 3, 3]
    assert found["inspector_inspection_seconds_sum"] * 1e6 >= registers["elapsed_us"]
    assert found["inspector_module_request_seconds_count"] >= 6
    hashed = [name for name in found if name.startswith("inspector_settings_info")]
    assert f'settings_hash="{int(registers["configuration_hash"]):08x}"' in hashed[0]


def test_a_fault_shows_while_it_lasts_and_counts_once(
    station: Any,
    module: Callable[..., Any],
    service: Callable[..., Any],
    metrics_port: Callable[[Any], int],
    wait_until: Callable[..., Any],
) -> None:
    plugged = module()
    station.settings["metrics"] = {"port": 0}
    station.write()
    at_work = service()
    at_work.until_inspecting()
    plugged.stop()
    at_work.until(lambda r: r["fault_code"] == 101, "the module is gone")
    port, gone = metrics_port(at_work), 'code="101",fault="MODULE_GONE"'
    wait_until(lambda: samples(port)[f"inspector_fault_active{{{gone}}}"] == 1, "the fault on the page")
    module()
    at_work.until(lambda r: r["verdict"], "inspecting again")
    wait_until(lambda: samples(port)[f"inspector_fault_active{{{gone}}}"] == 0, "no fault on the page")
    found = samples(port)
    assert found[f"inspector_fault_outages_total{{{gone}}}"] >= 1
    assert found['inspector_device_outages_total{device="lamp"}'] == 1
    assert found['inspector_device_ok{device="lamp"}'] == 1


def test_a_reload_moves_the_page_and_takes_it_away(
    station: Any,
    module: Callable[..., Any],
    service: Callable[..., Any],
    metrics_port: Callable[[Any], int],
    wait_until: Callable[..., Any],
) -> None:
    module()
    at_work = service()
    at_work.until_inspecting()
    station.settings["metrics"] = {"port": 0}
    station.write()
    at_work.send(signal.SIGHUP)
    port = metrics_port(at_work)
    assert samples(port)["inspector_simulated"] == 1
    station.settings["metrics"] = None
    station.write()
    at_work.send(signal.SIGHUP)

    def gone() -> bool:
        try:
            samples(port)
        except OSError:
            return True
        return False

    wait_until(gone, "no page")


def test_a_station_without_metrics_loads_nothing_for_them() -> None:
    script = (
        "import sys, inspector.daemon; print([m for m in ('inspector.metrics.text', 'asyncio') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout == "[]\n"
