"""The one table of what is measured: the page that Prometheus reads, the dashboard and the manual's page come from it.

Names end in their unit, a base unit of Prometheus: seconds, volts, ratios from 0 to 1. What is not known has no sample.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Literal, Protocol

from inspector.faults import Fault
from inspector.line_statistics import Rule, Statistics
from inspector.metrics.observed import DEVICES, Distribution, Levels, Observed, faults_of, working
from inspector.metrics.process import Process
from inspector.model import Snapshot, State, Verdict
from inspector.publish.outbox import Outbox
from inspector.publish.plc_server import Diagnostics
from inspector.publish.registers import MAP_VERSION

Kind = Literal["counter", "gauge", "histogram"]
Sample = tuple[tuple[str, ...], "float | int | Distribution"]
"""Values of the labels, and the number they are of."""
One = float | int | Distribution | None
LAG_S = "5m"
"""Rates and quantiles on the dashboard are taken over this time."""


class Gauges(Protocol):
    """What another part offers: numbers by a name of the table's. Called by a thread of its own; must not wait."""

    def __call__(self) -> Mapping[str, float]: ...


@dataclass(frozen=True, slots=True)
class Scrape:
    """What a page is made from: what the PLC is shown, what was noted and counted, at one moment."""

    station: Snapshot
    observed: Observed
    plc: Diagnostics
    now_s: float
    """Monotonic, as the snapshot's times."""
    unix_s: float
    name: str
    version: str
    period_s: float | None = None
    """The time between two cycles where a clock sets the pace."""
    posting: Outbox | None = None
    """None where nothing is posted."""
    process: Process | None = None
    more: Mapping[str, float] = field(default_factory=dict)
    """What other parts offer, by the metrics' names."""


@dataclass(frozen=True, slots=True)
class Metric:
    """A row: ``values`` gives its samples, ``query`` is what the dashboard shows if that does not follow from kind."""

    name: str
    kind: Kind
    group: str
    meaning: str
    values: Callable[[Scrape], Iterable[Sample]]
    labels: tuple[str, ...] = ()
    query: str = ""

    @property
    def unit(self) -> str:
        """The unit in the name: one of UNITS, or "" for a plain number."""
        words = self.name.removesuffix("_total").split("_")
        return words[-1] if words[-1] in UNITS else ""

    @property
    def shown(self) -> str:
        """What the dashboard shows of it, in PromQL."""
        return self.query or _QUERIES[self.kind].format(name=self.name)


UNITS = {"seconds": "s", "volts": "volt", "ratio": "percentunit", "bytes": "bytes", "sigmas": "none"}
"""Units of names, and what Grafana calls them."""

_QUERIES = {
    "counter": f"rate({{name}}[{LAG_S}])",
    "gauge": "{name}",
    "histogram": f"histogram_quantile(0.99, rate({{name}}_bucket[{LAG_S}]))",
}


def _one(value: Callable[[Scrape], One]) -> Callable[[Scrape], Iterator[Sample]]:
    """The one sample of a metric without labels; none where the value is None."""

    def samples(scrape: Scrape) -> Iterator[Sample]:
        number = value(scrape)
        if number is not None:
            yield (), number

    return samples


def _offered(name: str) -> Callable[[Scrape], Iterator[Sample]]:
    """What another part offers under this name; none where that part is not at work."""
    return _one(lambda s: s.more.get(name))


def _flags(names: Iterable[str], are_set: Callable[[Scrape], Iterable[str]]) -> Callable[[Scrape], Iterator[Sample]]:
    """A 0 or 1 for each name."""
    every = tuple(names)

    def samples(scrape: Scrape) -> Iterator[Sample]:
        chosen = set(are_set(scrape))
        return (((name,), int(name in chosen)) for name in every)

    return samples


def _by(values: Callable[[Scrape], Mapping[str, float | int | None]]) -> Callable[[Scrape], Iterator[Sample]]:
    """A sample for each value of the one label that has a number."""
    return lambda scrape: (((name,), number) for name, number in values(scrape).items() if number is not None)


def _statistic(read: Callable[[Statistics], float | int | None]) -> Callable[[Scrape], Iterator[Sample]]:
    """A number of the line's statistics; none while there are none."""
    return _one(lambda s: None if s.station.statistics is None else read(s.station.statistics))


def _statistics(read: Callable[[Statistics], Mapping[str, float | None]]) -> Callable[[Scrape], Iterator[Sample]]:
    return _by(lambda s: {} if s.station.statistics is None else read(s.station.statistics))


def _age_s(scrape: Scrape) -> float | None:
    at_s = scrape.station.result_at_s
    return None if at_s is None else max(0.0, scrape.now_s - at_s)


def _process(read: Callable[[Process], float]) -> Callable[[Scrape], Iterator[Sample]]:
    return _one(lambda s: None if s.process is None else read(s.process))


def _identity(scrape: Scrape) -> Iterator[Sample]:
    s = scrape.station
    yield (scrape.name, f"{s.configuration_hash:08x}", str(s.recipe_id), f"{s.recipe_hash:08x}"), 1


def _active(scrape: Scrape) -> Iterator[Sample]:
    active = faults_of(scrape.station)
    return (((str(fault.value), fault.name), int(fault in active)) for fault in Fault if fault)


def _outages(scrape: Scrape) -> Iterator[Sample]:
    seen = scrape.observed.outages | {Fault.CYCLE_STALLED: scrape.plc.stalls}
    return (((str(fault.value), fault.name), seen[fault]) for fault in Fault if fault)


def _verdicts(scrape: Scrape) -> dict[str, float | int | None]:
    s = scrape.station
    counts = {Verdict.PASS: s.panels_passed, Verdict.FAIL: s.panels_failed}
    return {v.name: (counts | {Verdict.NOT_INSPECTED: s.panels_not_inspected})[v] for v in Verdict}


def _queues(scrape: Scrape) -> dict[str, float | int | None]:
    box = scrape.posting
    return {"plc": scrape.station.plc.results_waiting, "posting": box.undelivered if box else None}


def _alarm(scrape: Scrape) -> list[str]:
    statistics = scrape.station.statistics
    return [statistics.rule.name] if statistics and statistics.alarm else []


def _level(read: Callable[[Levels], float]) -> Callable[[Scrape], Iterator[Sample]]:
    return _one(lambda s: None if s.observed.levels is None else read(s.observed.levels))


_M = Metric
STATION = (
    _M("inspector_build_info", "gauge", "Station", "1; the program's version and that of its register map",
       lambda s: [((s.version, str(MAP_VERSION)), 1)], ("version", "map_version")),
    _M("inspector_settings_info", "gauge", "Station", "1; the hashes change when any setting, or the recipe, does",
       _identity, ("station", "settings_hash", "recipe_id", "recipe_hash")),
    _M("inspector_state", "gauge", "Station", "1 for the state the station is in",
       _flags([state.name for state in State], lambda s: [s.station.state.name]), ("state",)),
    _M("inspector_simulated", "gauge", "Station", "1 while a device is simulated or shows recordings",
       _one(lambda s: int(s.station.simulated))),
    _M("inspector_clock_seconds", "gauge", "Station", "Unix time by the station's clock", _one(lambda s: s.unix_s),
       query="inspector_clock_seconds - timestamp(inspector_clock_seconds)"),
    _M("inspector_log_lines_lost_total", "counter", "Station", "Lines that the journal did not take",
       _offered("inspector_log_lines_lost_total")),
)  # fmt: skip

RESULTS = (
    _M("inspector_results_total", "counter", "Results", "Results by verdict",
       _by(_verdicts), ("verdict",)),
    _M("inspector_result_sequence", "gauge", "Results", "Number of the last result",
       _one(lambda s: s.station.sequence)),
    _M("inspector_result_age_seconds", "gauge", "Results", "Time since the last result", _one(_age_s)),
    _M("inspector_result_defects", "gauge", "Results", "Defects of the last result",
       _one(lambda s: len(s.station.defects))),
    _M("inspector_results_overrun_total", "counter", "Results", "Results lost because the PLC did not take them",
       _one(lambda s: s.station.overruns)),
    _M("inspector_queue_results", "gauge", "Results", "Results that wait: for the PLC that polls, for posting",
       _by(_queues), ("queue",)),
    _M("inspector_posting_lost_total", "counter", "Results", "Results lost because posting found no room for them",
       _one(lambda s: s.posting.lost if s.posting else None)),
)  # fmt: skip

CYCLE = (
    _M("inspector_cycle_seconds", "histogram", "Cycle", "Whole cycles, from lamp to result, also those that failed",
       _one(lambda s: s.observed.cycle.now)),
    _M("inspector_inspection_seconds", "histogram", "Cycle", "Inspections of frames",
       _one(lambda s: s.observed.inspection.now)),
    _M("inspector_cycle_period_seconds", "gauge", "Cycle", "Time between two cycles, where a clock sets the pace",
       _one(lambda s: s.period_s)),
    _M("inspector_triggers_missed_total", "counter", "Cycle", "Triggers that came while the station was not ready",
       _one(lambda s: s.station.missed_triggers)),
    _M("inspector_triggers_late_total", "counter", "Cycle", "Cycles begun late",
       _one(lambda s: s.station.late_triggers)),
)  # fmt: skip

FAULTS = (
    _M("inspector_fault_active", "gauge", "Faults", "1 while the fault lasts", _active, ("code", "fault"),
       query="inspector_fault_active == 1"),
    _M("inspector_fault_outages_total", "counter", "Faults", "How often the fault began", _outages, ("code", "fault"),
       query=f"increase(inspector_fault_outages_total[{LAG_S}]) > 0"),
)  # fmt: skip

DEVICE = (
    _M("inspector_device_ok", "gauge", "Devices", "1 if the device did what was asked of it last",
       _flags(DEVICES, lambda s: working(s.station)), ("device",)),
    _M("inspector_device_outages_total", "counter", "Devices", "How often a device that worked failed",
       _by(lambda s: dict(s.observed.device_outages)), ("device",)),
    _M("inspector_camera_grab_seconds", "histogram", "Devices", "Waits for a frame that came",
       _one(lambda s: s.observed.grab.now)),
    _M("inspector_module_request_seconds", "histogram", "Devices", "Requests to the I/O module, also unanswered ones",
       _one(lambda s: s.observed.module_request.now)),
    _M("inspector_lamp_volts", "gauge", "Devices", "Level of the lamp's input as set, and as read back",
       _by(lambda s: {"set": s.station.lamp_set_v, "read": s.station.lamp_read_v}), ("level",)),
    _M("inspector_lamp_level_ratio", "gauge", "Devices", "Intensity asked of the lamp, by its curve",
       _level(lambda level: level.lamp_percent / 100)),
    _M("inspector_lamp_burnt_seconds", "gauge", "Devices", "Time the lamp has burnt in its life",
       _level(lambda level: level.burnt_hours * 3600)),
    _M("inspector_exposure_seconds", "gauge", "Devices", "Exposure asked of the camera",
       _level(lambda level: level.exposure_us / 1e6)),
)  # fmt: skip

PLC = (
    _M("inspector_plc_connections", "gauge", "PLC", "Clients of the register server", _one(lambda s: s.plc.connected)),
    _M("inspector_plc_accepted_total", "counter", "PLC", "Connections let in", _one(lambda s: s.plc.accepted)),
    _M("inspector_plc_refused_total", "counter", "PLC", "Connections refused, by why",
       _by(lambda s: {"stranger": s.plc.refused_strangers, "full": s.plc.refused_full, "not_secure": s.plc.not_secure}),
       ("why",)),
    _M("inspector_plc_closed_total", "counter", "PLC", "Connections that the station closed, by why",
       _by(lambda s: {"gave_way": s.plc.gave_way, "idle": s.plc.closed_idle, "slow": s.plc.closed_slow}), ("why",)),
    _M("inspector_plc_requests_total", "counter", "PLC", "Requests", _one(lambda s: s.plc.requests)),
    _M("inspector_plc_exceptions_total", "counter", "PLC", "Requests answered with an exception, by its code",
       _by(lambda s: {str(code): count for code, count in sorted(s.plc.exceptions.items())}), ("code",)),
    _M("inspector_plc_out_of_step_total", "counter", "PLC", "Stretches of bytes that were no Modbus",
       _one(lambda s: s.plc.out_of_step)),
    _M("inspector_plc_serial_open", "gauge", "PLC", "1 while the serial line to the PLC is there",
       _one(lambda s: int(s.plc.serial_open))),
)  # fmt: skip

LINE = (
    _M("inspector_spc_defects_per_m2", "gauge", "Paint line", "Defects per square metre, and their control limits",
       _statistics(lambda t: {"recent": t.recent_per_m2, "panel": t.per_m2, "baseline": t.baseline_per_m2,
                              "upper": t.upper_per_m2, "lower": t.lower_per_m2}), ("of",)),
    _M("inspector_spc_defects_per_panel", "gauge", "Paint line", "Defects per panel, of the recent ones",
       _statistic(lambda t: t.recent_per_panel)),
    _M("inspector_spc_ewma_sigmas", "gauge", "Paint line", "EWMA of the panels' counts, and its limits up and down",
       _statistics(lambda t: {"ewma": t.ewma, "upper": t.ewma_limit, "lower": -t.ewma_limit}), ("of",)),
    _M("inspector_spc_cusum_sigmas", "gauge", "Paint line", "CUSUM for more and for fewer defects, and their limit",
       _statistics(lambda t: {"above": t.cusum_above, "below": t.cusum_below, "limit": t.cusum_limit}), ("of",)),
    _M("inspector_spc_alarm", "gauge", "Paint line", "1 for the rule that raised the alarm, while it lasts",
       _flags([rule.name for rule in Rule if rule], _alarm), ("rule",), query="inspector_spc_alarm == 1"),
    _M("inspector_spc_not_inspected_ratio", "gauge", "Paint line", "Share of recent panels that were not inspected",
       _statistic(lambda t: t.not_inspected_share)),
    _M("inspector_spc_action_code", "gauge", "Paint line", "Advice by its code, 0 none",
       _statistic(lambda t: t.action)),
)  # fmt: skip

ARCHIVE = (
    _M("inspector_store_waiting_entries", "gauge", "Archive", "Entries not yet in the results' store",
       _offered("inspector_store_waiting_entries")),
    _M("inspector_store_lag_seconds", "gauge", "Archive", "For how long the oldest of them has waited",
       _offered("inspector_store_lag_seconds")),
    _M("inspector_store_lost_entries_total", "counter", "Archive", "Entries that no room was left for",
       _offered("inspector_store_lost_entries_total")),
    _M("inspector_archive_image_bytes", "gauge", "Archive", "Images that wait for the disk",
       _offered("inspector_archive_image_bytes")),
    _M("inspector_archive_left_out_frames_total", "counter", "Archive", "Frames that the disk was too full or slow for",
       _offered("inspector_archive_left_out_frames_total")),
)  # fmt: skip

PROCESS = (
    _M("process_resident_memory_bytes", "gauge", "Process", "Memory that it has", _process(lambda p: p.resident_bytes)),
    _M("process_open_fds", "gauge", "Process", "Open descriptors", _process(lambda p: p.open_fds)),
    _M("process_threads", "gauge", "Process", "Threads", _process(lambda p: p.threads)),
    _M("process_cpu_seconds_total", "counter", "Process", "Processor time", _process(lambda p: p.cpu_s)),
    _M("process_start_time_seconds", "gauge", "Process", "Unix time of its start", _process(lambda p: p.started_s),
       query="time() - process_start_time_seconds"),
)  # fmt: skip

METRICS = STATION + RESULTS + CYCLE + FAULTS + DEVICE + PLC + LINE + ARCHIVE + PROCESS


def names() -> set[str]:
    """Every name of a sample."""
    histograms = {f"{m.name}_{part}" for m in METRICS if m.kind == "histogram" for part in ("bucket", "sum", "count")}
    return {m.name for m in METRICS if m.kind != "histogram"} | histograms
