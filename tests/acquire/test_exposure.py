"""Exposure and lamp level from the spots: as long and as low as can be, without a spot that bleeds."""

from __future__ import annotations

import csv
import itertools
import math
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
from drawn import Drawing
from hypothesis import given
from hypothesis import strategies as st

from inspector.acquire import exposure
from inspector.acquire.exposure import DARK, OVERLIT, Automatic, Bounds, Brightness, Level, next_level
from inspector.detect.highlights import FrameRefused, find
from inspector.model import Flag, FloatArray, FrameResult, Highlights, Image, Reason, Verdict
from inspector.recipe import Detection

THESIS = Path(__file__).parents[1] / "data" / "thesis"
BOUNDS = Bounds(10.0, 20000.0, 1.0, 75.0, 100.0)
START = Level(1000.0, 80.0)
SPOTS = np.array([[70.4, 147.5], [122.3, 148.0], [70.9, 115.0], [122.1, 172.3]])
SHARES = np.array([1.0, 0.85, 0.9, 0.8])
THRESHOLDS = range(60, 151, 5)


@dataclass
class Scene:
    """A panel with four seeds' spots. ``peak_dn``: the brightest's, at 1000 us and 80 %, if it did not clip."""

    peak_dn: float
    drawing: Drawing = field(default_factory=lambda: Drawing((300, 200), blur_px=3.0, panel_dn=1.0))

    def frame(self, level: Level) -> Image:
        light = level.exposure_us * level.lamp_percent / (1000 * 80)
        panel = replace(self.drawing, panel_dn=self.drawing.panel_dn * light)
        return panel.draw(SPOTS, SHARES * self.peak_dn * light)

    def seen(self, level: Level) -> Brightness:
        try:
            found = find(self.frame(level), Detection(max_lit_fraction=0.5), self.drawing.sensor)
        except FrameRefused as refused:
            return exposure.brightness(FrameResult("x", Verdict.NOT_INSPECTED, refused.reason))
        return exposure.of_spots(found)

    def settled(self, level: Level, bounds: Bounds = BOUNDS) -> list[Level]:
        """The levels from ``level`` on until nothing changes."""
        levels = [level]
        while (following := next_level(levels[-1], self.seen(levels[-1]), bounds)) != levels[-1]:
            levels.append(following)
            assert len(levels) < 40
        return levels


def binary_centroids(image: Image, sensor: object) -> FloatArray:
    """Plain centroids (thresholds, spots, 2) as the thesis took them: of each spot's component at each threshold."""
    found = (
        find(image, Detection(threshold_dn=float(t), max_area_px=10**6, max_lit_fraction=0.5), sensor)
        for t in THRESHOLDS
    )
    return np.array([[spots.binary_px[_nearest(spots, spot)] for spot in SPOTS] for spots in found])


def _nearest(spots: Highlights, place: FloatArray) -> int:
    return int(np.hypot(*(spots.binary_px - place).T).argmin())


def printed_spread_px() -> float:
    """The most that a coordinate moves over the thresholds of the thesis' Table H-1."""
    with (THESIS / "table_h1.csv").open(newline="") as file:
        rows = np.array([[float(cell) for cell in row[2:]] for row in list(csv.reader(file))[1:]])
    return float(np.ptp(rows, axis=0).max())


def test_with_the_exposure_right_the_thesis_centroids_stay_over_thresholds_and_bleeding_moves_them() -> None:
    """Section 5.2: spots that bleed run into each other; Table H-1: with the right exposure the threshold hardly
    matters."""
    scene = Scene(peak_dn=10000.0)
    scene.drawing = replace(scene.drawing, bloom=0.97)
    levels = scene.settled(START)
    assert scene.seen(levels[0]).bleeding
    bleeding = binary_centroids(scene.frame(levels[0]), scene.drawing.sensor)
    right = binary_centroids(scene.frame(levels[-1]), scene.drawing.sensor)
    assert np.abs(bleeding - SPOTS).max() > 10
    assert np.abs(right - SPOTS).max() < 0.5
    assert np.ptp(right, axis=0).max() < 0.5
    assert printed_spread_px() == pytest.approx(0.35)  # its own two spots; a pixel more moves one 0.1 to 0.5


@pytest.mark.parametrize("peak_dn", [3.0, 60.0, 225.0, 300.0, 2000.0, 20000.0])
@pytest.mark.parametrize("lamp_percent", [75.0, 80.0, 100.0])
def test_from_any_light_the_longest_exposure_at_the_lowest_lamp_without_bleeding(
    peak_dn: float, lamp_percent: float
) -> None:
    scene = Scene(peak_dn)
    levels = scene.settled(Level(1000.0, lamp_percent), replace(BOUNDS, exposure_max_us=1e6))
    seen = scene.seen(levels[-1])
    assert exposure.is_right(seen)
    assert levels[-1].lamp_percent == 75.0
    assert levels[-1].exposure_us == round(levels[-1].exposure_us)
    for old, new in itertools.pairwise(levels):
        assert abs(new.lamp_percent - old.lamp_percent) <= exposure.LAMP_STEP_PERCENT
        gain = new.exposure_us * new.lamp_percent / (old.exposure_us * old.lamp_percent)
        assert 0.9 * exposure.STEP_DOWN <= gain <= exposure.STEP_UP * 1.001


def test_where_the_panel_moves_too_fast_the_lamp_gives_the_rest() -> None:
    last = Scene(peak_dn=190.0).settled(START, replace(BOUNDS, exposure_max_us=1000.0))[-1]
    assert last.exposure_us == 1000.0
    assert 85 < last.lamp_percent < 100


def test_what_cannot_be_had_ends_at_the_bounds() -> None:
    assert Scene(peak_dn=1e6).settled(START)[-1] == Level(10.0, 75.0)
    assert Scene(peak_dn=0.05).settled(START)[-1] == Level(20000.0, 100.0)


def test_only_spots_count() -> None:
    """The dark panel, hot pixels and frames refused for other reasons say nothing; one lit all over says too much."""
    spots = find(Scene(200.0).frame(START), Detection(), Drawing().sensor)
    hot = replace(spots, flags=np.where(spots.peak_dn == spots.peak_dn.max(), int(Flag.HOT_PIXEL), spots.flags))
    assert exposure.of_spots(spots).spots == 4
    assert exposure.of_spots(hot).peak_share < exposure.of_spots(spots).peak_share
    refused = {reason: FrameResult("x", Verdict.NOT_INSPECTED, reason) for reason in Reason}
    assert exposure.brightness(refused[Reason.FRAME_OVERLIT]) == OVERLIT
    assert math.isnan(exposure.brightness(refused[Reason.FRAME_BLACK]).peak_share)


LEVELS = st.builds(Level, st.floats(1, 1e6), st.floats(0, 100))
SEEN = st.one_of(
    st.just(DARK),
    st.just(OVERLIT),
    st.builds(Brightness, st.integers(1, 50), st.integers(0, 3), st.floats(1e-3, 50)),
)


@given(LEVELS, SEEN)
def test_whatever_is_seen_the_next_level_is_within_the_bounds(level: Level, seen: Brightness) -> None:
    level = exposure.within(level, BOUNDS)
    following = next_level(level, seen, BOUNDS)
    assert BOUNDS.exposure_min_us <= following.exposure_us <= BOUNDS.exposure_max_us
    assert 75 <= following.lamp_percent <= 100
    if seen.bleeding or seen.peak_share > exposure.HIGH_SHARE:
        light, before = following.exposure_us * following.lamp_percent, level.exposure_us * level.lamp_percent
        assert light < before or following.exposure_us == BOUNDS.exposure_min_us


def spots_at(share: float, bleeding: int = 0) -> Brightness:
    return Brightness(3, bleeding, share)


def test_within_a_panel_nothing_moves_and_after_it_one_step_down_at_once() -> None:
    automatic = Automatic(Level(1000.0, 75.0))
    for _ in range(5):
        automatic.saw(spots_at(2.0, bleeding=1))
        assert automatic.level == Level(1000.0, 75.0)
    automatic.saw(DARK)
    assert automatic.panel_done(BOUNDS).exposure_us == pytest.approx(500, abs=1)


def test_up_only_after_a_row_of_dim_panels_and_by_the_brightest_of_them() -> None:
    automatic = Automatic(Level(1000.0, 75.0))
    shares = [0.3] * (exposure.PANELS - 2) + [0.6, 0.3]
    for share in shares:
        assert automatic.level == Level(1000.0, 75.0)
        automatic.saw(spots_at(share))
        automatic.panel_done(BOUNDS)
        automatic.panel_done(BOUNDS)  # a panel without seeds says nothing
    assert automatic.level.exposure_us == pytest.approx(1500, abs=1)


def test_a_panel_that_is_bright_enough_keeps_the_level() -> None:
    automatic = Automatic(Level(1000.0, 75.0))
    for _ in range(3 * exposure.PANELS):
        automatic.saw(spots_at(0.8))
        assert automatic.panel_done(BOUNDS) == Level(1000.0, 75.0)
