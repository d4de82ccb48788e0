"""A running station's page of measured values tells what its registers tell; nothing of it costs a station without."""

from __future__ import annotations

import json
import re
import shutil
import signal
import subprocess
import sys
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from prometheus_client.parser import text_string_to_metric_families

from inspector.metrics.table import METRICS

RULES_FOLDER = Path(__file__).parents[2] / "deploy" / "prometheus"
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
        "import sys, inspector.service.daemon\n"
        "print([m for m in ('inspector.metrics.text', 'asyncio') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout == "[]\n"


@pytest.fixture
def prometheus(
    tmp_path: Path, peer: Callable[[str, str], str], wait_until: Callable[..., Any]
) -> Iterator[Callable[[int], Callable[[str], Any]]]:
    """``prometheus(port)``: a server that scrapes this port; it gives what answers queries of its API."""
    program, started = peer("prometheus", "prometheus"), []

    def start(port: int) -> Callable[[str], Any]:
        text = (RULES_FOLDER / "prometheus.yml").read_text().replace("9464", str(port)).replace("15s", "1s")
        (tmp_path / "prometheus.yml").write_text(text)
        shutil.copy(RULES_FOLDER / "alerts.yml", tmp_path)
        command = [program, f"--config.file={tmp_path}/prometheus.yml", f"--storage.tsdb.path={tmp_path}/data"]
        log = (tmp_path / "log").open("w")
        started.append(subprocess.Popen([*command, "--web.listen-address=127.0.0.1:0"], stderr=log, stdout=log))
        own = int(wait_until(lambda: _listening(started[0].pid), "Prometheus listens", 60))

        def query(expression: str) -> Any:
            address = f"http://127.0.0.1:{own}/api/v1/query?" + urllib.parse.urlencode({"query": expression})
            try:
                with urllib.request.urlopen(address, timeout=20) as answer:
                    return json.loads(answer.read())["data"]["result"]
            except urllib.error.HTTPError as error:
                if error.code == 503:
                    return []  # it is not ready yet
                raise

        return query

    yield start
    for process in started:
        process.send_signal(signal.SIGTERM)
        process.wait(60)


def _listening(pid: int) -> str | None:
    """The port that a process listens on, as the kernel says."""
    inodes = {link.readlink().name for link in Path(f"/proc/{pid}/fd").iterdir() if link.is_symlink()}
    for table_ in ("tcp", "tcp6"):
        for line in Path(f"/proc/{pid}/net/{table_}").read_text().splitlines()[1:]:
            fields = line.split()
            if fields[3] == "0A" and f"socket:[{fields[9]}]" in inodes:
                return str(int(fields[1].rpartition(":")[2], 16))
    return None


@pytest.mark.long
def test_prometheus_sees_what_the_plc_sees(
    station: Any,
    module: Callable[..., Any],
    service: Callable[..., Any],
    metrics_port: Callable[[Any], int],
    prometheus: Callable[[int], Callable[[str], Any]],
    wait_until: Callable[..., Any],
) -> None:
    """Debian's Prometheus with the rules of deploy/ scrapes a station: its numbers, and the alert of a fault."""
    plugged = module()
    station.settings |= {"metrics": {"port": 0}, "cycle": {"trigger": {"kind": "by_hand"}, "retry_first_s": 0.05}}
    station.write()
    at_work = service()
    at_work.until(lambda r: r["state"] == 2, "ready")
    at_work.send(signal.SIGUSR1)
    registers = at_work.until(lambda r: r["sequence"] == 1 and r["state"] == 2, "a result")
    query = prometheus(metrics_port(at_work))

    def value(expression: str) -> float | None:
        found = query(expression)
        return float(found[0]["value"][1]) if found else None

    wait_until(lambda: value("inspector_result_sequence") == 1, "the result in Prometheus", 60)
    for expression, register in SAME.items():
        assert value(expression) == registers[register]
    for metric in METRICS:
        assert query(metric.shown) is not None
    wait_until(lambda: value("rate(inspector_cycle_seconds_count[5m])") is not None, "a rate", 60)
    plugged.stop()
    wait_until(lambda: value('ALERTS{alertname="InspectorFault"}'), "the alert, pending", 60)
