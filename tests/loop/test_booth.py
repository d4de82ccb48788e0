"""The simulated booth: its history is its seed's, dirt grows, and each deed does what it is for."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from inspector.lab.booth import Booth, BoothSettings, Deed

CALM = replace(BoothSettings(), tear_rate=0.0, fixture_rate=0.0, outside_rate=0.0, weather_sd=0.0, success=1.0)


def mean_of(booth: Booth, panels: int) -> float:
    return sum(len(booth.paint()) for _ in range(panels)) / panels


def test_one_seed_is_one_history() -> None:
    first, second, other = Booth(5), Booth(5), Booth(6)
    counts = [[len(booth.paint()) for _ in range(300)] for booth in (first, second, other)]
    assert counts[0] == counts[1] != counts[2]


def test_orders_do_not_change_what_befalls_the_booth() -> None:
    """The tended booth and its untended twin have the same weather, tears and drips: what differs is the care."""
    tended, twin = Booth(7), Booth(7)
    for n in range(2500):
        if n % 100 == 0:
            tended.order(Deed.CLEAN_BOOTH)
        tended.paint()
        twin.paint()
        assert (tended.condition.weather, tended.condition.torn) == (twin.condition.weather, twin.condition.torn)
        assert (tended.condition.drip_mm, tended.condition.outside) == (twin.condition.drip_mm, twin.condition.outside)


def test_a_new_booth_has_the_seeds_it_says_and_an_old_one_more() -> None:
    booth = Booth(1, replace(CALM, filter_life=1e9, wall_life=1e9))
    assert mean_of(booth, 2000) == pytest.approx(2.0, abs=4 * math.sqrt(2.0 / 2000))
    old = Booth(1, CALM)
    mean_of(old, 4000)
    assert old.expected_seeds == pytest.approx(2.0 * 4 + 4 * 0.5)
    assert mean_of(old, 1000) == pytest.approx(old.expected_seeds, abs=0.5)


@pytest.mark.parametrize(
    ("deed", "left"),
    [(Deed.CHANGE_FILTER, 2.0 + 2.0), (Deed.CLEAN_BOOTH, 8.0), (Deed.CLEAN_FIXTURE, 10.0)],
)
def test_a_deed_is_done_some_panels_after_the_order_and_mends_its_own_part(deed: Deed, left: float) -> None:
    booth = Booth(2, CALM)
    mean_of(booth, 4000)
    booth.order(deed)
    booth.order(deed)  # ordered already
    for _ in range(CALM.crew_panels - 1):
        booth.paint()
    assert booth.expected_seeds == pytest.approx(10.0)
    booth.paint()
    assert booth.expected_seeds == pytest.approx(left, abs=0.05)
    assert booth.deeds == [(4000 + CALM.crew_panels - 1, deed)]


def test_a_torn_filter_and_a_drip_are_mended_by_their_deeds() -> None:
    booth = Booth(3, replace(CALM, tear_rate=1.0, fixture_rate=1.0, fixture_panels=1e9))
    booth.paint()
    assert booth.condition.torn
    drip = booth.condition.drip_mm
    assert drip is not None
    near = sum(bool((np.hypot(*(booth.paint().places_mm - drip).T) < 10).any()) for _ in range(200))
    assert 70 <= near <= 140, "every other panel, at one place"


def test_flakes_are_clusters_and_seeds_lie_on_the_panel() -> None:
    flaky = Booth(4, replace(CALM, air_seeds=0.0, wall_flakes=1.0))
    mean_of(flaky, 4000)
    for _ in range(300):
        panel = flaky.paint()
        assert len(panel.heights_um) == len(panel.places_mm) == len(panel)
        assert (panel.places_mm >= 0).all()
        assert (panel.places_mm <= (600.0, 400.0)).all()
        assert (panel.heights_um > 0).all()


def test_a_deed_fails_now_and_then() -> None:
    unlucky = Booth(5, replace(CALM, success=0.0))
    mean_of(unlucky, 3000)
    before = unlucky.expected_seeds
    unlucky.order(Deed.CHANGE_FILTER)
    mean_of(unlucky, 50)
    assert unlucky.deeds
    assert unlucky.expected_seeds >= before
