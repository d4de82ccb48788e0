"""What the cycle notes in passing: every duration in its bucket, every outage once."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from inspector.faults import Fault
from inspector.metrics.observed import BOUNDS_S, Histogram, Observed
from inspector.model import Snapshot

WORKS = Snapshot(camera_ok=True, lamp_ok=True)


@given(st.lists(st.floats(0, 20) | st.sampled_from(BOUNDS_S)))
def test_a_histogram_counts_what_is_not_longer(durations_s: list[float]) -> None:
    histogram = Histogram()
    for duration_s in durations_s:
        histogram.add(duration_s)
    now = histogram.now
    assert list(now.below) == [sum(d <= bound for d in durations_s) for bound in (*BOUNDS_S, float("inf"))]
    assert now.sum_s == pytest.approx(sum(durations_s))


def test_an_outage_counts_when_it_begins_whatever_it_is_told_by() -> None:
    observed = Observed()
    gone = replace(WORKS, camera_ok=False, fault_code=Fault.CAMERA_GONE)
    weak = replace(WORKS, lamp_weak=True)
    both = replace(weak, settings_refused=True)
    for shown in (WORKS, gone, replace(gone, sequence=2), WORKS, weak, both, weak, both, gone, WORKS):
        observed.show(shown)
    began = {fault: count for fault, count in observed.outages.items() if count}
    assert began == {Fault.CAMERA_GONE: 2, Fault.LAMP_WEAK: 1, Fault.SETTINGS_REFUSED: 2}
    assert observed.device_outages == {"camera": 2, "lamp": 0}


def test_one_fault_after_another_is_an_outage_of_each() -> None:
    observed = Observed()
    for code in (Fault.CAMERA_GONE, Fault.CAMERA_TIMEOUT, Fault.CAMERA_GONE):
        observed.show(replace(WORKS, camera_ok=False, fault_code=code))
    assert (observed.outages[Fault.CAMERA_GONE], observed.outages[Fault.CAMERA_TIMEOUT]) == (2, 1)
