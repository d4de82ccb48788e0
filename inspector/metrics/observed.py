"""What the cycle's thread notes in passing, microseconds a cycle; any thread may read it, and nothing here waits."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import accumulate
from typing import TypeVar

from inspector.faults import Fault
from inspector.model import Snapshot

BOUNDS_MS = (1, 1.5, 2, 3, 5, 7, 10, 15, 20, 30, 50, 70, 100, 150, 200, 300, 500, 700, 1000, 1500, 2000, 3000, 5000)
"""Upper bounds of the buckets, six or seven a decade: from what a stage takes to what a device may be waited for."""
BOUNDS_S = tuple(bound_ms / 1000 for bound_ms in BOUNDS_MS)


@dataclass(frozen=True, slots=True)
class Distribution:
    """Durations counted: ``below`` has, for each of BOUNDS_S and then in all, how many were not longer."""

    below: tuple[int, ...]
    sum_s: float


class Histogram:
    """Counts durations. One thread adds, any may read."""

    def __init__(self) -> None:
        self._counts = [0] * (len(BOUNDS_S) + 1)
        self._sum_s = 0.0

    def add(self, duration_s: float) -> None:
        """One more, seconds."""
        self._counts[bisect_left(BOUNDS_S, duration_s)] += 1
        self._sum_s += duration_s

    @property
    def now(self) -> Distribution:
        """What was counted so far."""
        return Distribution(tuple(accumulate(self._counts)), self._sum_s)


@dataclass(frozen=True, slots=True)
class Levels:
    """What lamp and exposure are asked to be, and for how long the lamp has burnt in its life."""

    lamp_percent: float
    exposure_us: float
    burnt_hours: float


def faults_of(shown: Snapshot) -> frozenset[Fault]:
    """The faults that a snapshot shows: the one with the code, and those that go beside inspection."""
    beside = {
        Fault.LAMP_WEAK: shown.lamp_weak,
        Fault.SETTINGS_REFUSED: shown.settings_refused,
        Fault.STORE_DEGRADED: shown.store_degraded,
        Fault.STORE_DAMAGED: shown.store_damaged,
    }
    codes = {shown.fault_code, *(fault for fault, lasts in beside.items() if lasts)}
    return frozenset(fault for fault in Fault if fault and fault in codes)


DEVICES = ("camera", "lamp")


def working(shown: Snapshot) -> frozenset[str]:
    """Those of DEVICES that did what was asked of them last."""
    return frozenset(device for device, ok in zip(DEVICES, (shown.camera_ok, shown.lamp_ok), strict=True) if ok)


class Observed:
    """Everything that is noted of one station since it started."""

    def __init__(self) -> None:
        self.cycle, self.inspection = Histogram(), Histogram()
        self.grab, self.module_request = Histogram(), Histogram()
        self.levels: Levels | None = None
        self.outages = dict.fromkeys(Fault, 0)
        """How often each fault began. That a cycle has stalled is not seen from within it: the server counts that."""
        self.device_outages = dict.fromkeys(DEVICES, 0)
        self._last = Snapshot()
        self._faults: frozenset[Fault] = frozenset()

    def turned(self, cycle_s: float, inspection_us: float | None, levels: Levels) -> None:
        """A cycle has ended; ``inspection_us`` is None where nothing was inspected."""
        self.cycle.add(cycle_s)
        if inspection_us is not None:
            self.inspection.add(inspection_us / 1e6)
        self.levels = levels

    def show(self, shown: Snapshot) -> None:
        """What the station is from now on."""
        last, self._last = self._last, shown
        if _signs(shown) == _signs(last):
            return
        faults, before = faults_of(shown), self._faults
        self._faults = faults
        _count(self.outages, faults - before)
        _count(self.device_outages, working(last) - working(shown))


def _signs(shown: Snapshot) -> tuple[int, bool, bool, bool, bool]:
    """What outages are told by; alike from one result to the next as long as nothing happens."""
    return shown.fault_code, shown.lamp_ok, shown.camera_ok, shown.lamp_weak, shown.settings_refused


KeyT = TypeVar("KeyT")


def _count(counts: dict[KeyT, int], began: Iterable[KeyT]) -> None:
    for what in began:
        counts[what] += 1
