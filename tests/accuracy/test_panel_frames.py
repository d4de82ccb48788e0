"""A panel that passes the camera, rendered in three overlapping frames: each seed once, at its place and height."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from inspector import reflection
from inspector.judge.panel import PanelStation, judge_panel
from inspector.lab import sets
from inspector.lab.render import render
from inspector.lab.scene import Seed
from inspector.model import Defect, Flag, Frame, FrameResult, PanelFrame, PanelFrames, Verdict
from inspector.optics import Calibration, Light
from inspector.panel_settings import PanelSettings
from inspector.pipeline import Station, inspect
from inspector.recipe import Limits, Recipe

STEP_MM = 50.0
"""Of the 91 mm that a frame shows along x."""
CUT_AT_THE_FAR_EDGE, CUT_AT_THE_NEAR_EDGE = (-49.5, 0.0, 0.45), (-9.5, 4.0, 0.5)
"""Seeds of which the first frame, and the second one, show one spot only."""
SEEDS = [
    (20.0, 5.0, 0.5),
    (-5.0, -12.0, 0.35),
    (-20.0, 10.0, 0.4),
    (-30.0, -5.0, 0.55),
    (-70.0, -8.0, 0.42),
    (-95.0, 12.0, 0.38),
    (-120.0, 0.0, 0.5),
    CUT_AT_THE_FAR_EDGE,
    CUT_AT_THE_NEAR_EDGE,
]
"""x, y on the panel and radius, mm."""

CAMERA = sets.camera(60, 400, 0.15, 16.0, kappa1_per_mm2=-0.0004, size_px=(400, 300))
STATION = sets.Station(CAMERA, sets.lamp(CAMERA, 20, swing_deg=25))
CALIBRATION = Calibration(CAMERA, Light(STATION.lamp.direction), 60.0)
LIMITS = Limits(max_height_um=2000.0, unmeasured_seed="fail")


def panel_station(mm_per_frame: float) -> PanelStation:
    settings = {
        "frames": {"kind": "count", "count": 3},
        "travel": {"by": {"kind": "pitch", "mm_per_frame": mm_per_frame}},
        "area": {"x_min_mm": -130, "x_max_mm": 30, "y_min_mm": -18, "y_max_mm": 18},
    }
    return PanelStation(CALIBRATION, LIMITS, PanelSettings.model_validate_json(json.dumps(settings)))


pytestmark = pytest.mark.xdist_group("panel frames")


@pytest.fixture(scope="module")
def results() -> list[FrameResult]:
    """What the pipeline finds in the panel's three frames."""
    base = next(sets.random_scenes("B", 1, 3, STATION))
    found = []
    for n in range(3):
        here = [(x + n * STEP_MM, y, radius) for x, y, radius in SEEDS]
        seeds = tuple(Seed(x, y, r, r) for x, y, r in here if -55 < x < 45)
        sensor = replace(base.sensor, seed=n)
        image, _ = render(replace(base, seeds=seeds, sensor=sensor))
        found.append(inspect(Frame(image, f"frame {n}"), Station(CALIBRATION, Recipe(limits=LIMITS))))
    return found


def gathered(results: list[FrameResult], mm_per_frame: float) -> PanelFrames:
    return PanelFrames(None, tuple(PanelFrame(r, n * mm_per_frame) for n, r in enumerate(results)))


def nearest(defects: tuple[Defect, ...], x_mm: float, y_mm: float) -> Defect:
    return min(defects, key=lambda d: np.hypot(d.x_mm - x_mm, d.y_mm - y_mm))


@pytest.mark.parametrize("mm_per_frame", [50.0, 50.4, 49.6])
def test_each_seed_is_counted_once_at_its_place_and_height(results: list[FrameResult], mm_per_frame: float) -> None:
    """Also where the line runs almost a percent faster or slower than it was said to."""
    panel = judge_panel(gathered(results, mm_per_frame), panel_station(mm_per_frame))
    assert sum(len(r.defects) for r in results) > len(SEEDS)
    assert len(panel.defects) == len(SEEDS)
    for x_mm, y_mm, radius_mm in SEEDS:
        found = nearest(panel.defects, x_mm, y_mm)
        assert np.hypot(found.x_mm - x_mm, found.y_mm - y_mm) < 0.1 + 2 * abs(mm_per_frame - STEP_MM)
        assert found.height_sigma_um is not None
        allowed_um = 4 * found.height_sigma_um + 0.01 * found.height_um
        assert abs(found.height_um - 2000 * radius_mm) < allowed_um
    assert panel.verdict is Verdict.PASS, panel.reasons_text
    assert panel.unpaired == ()


def test_a_seed_cut_by_a_frames_edge_is_measured_in_the_next_frame(results: list[FrameResult]) -> None:
    for n, (x_mm, y_mm, radius_mm) in ((0, CUT_AT_THE_FAR_EDGE), (1, CUT_AT_THE_NEAR_EDGE)):
        seed = np.array([[x_mm + n * STEP_MM, y_mm, radius_mm, radius_mm]])
        rows = [float(end[0, 1]) for end in reflection.highlights(seed, CALIBRATION)]
        assert min(rows) < -0.5 or max(rows) > CAMERA.height_px - 0.5
        lone = [u for u in results[n].unpaired if u.flags & Flag.PARTNER_OUTSIDE_FRAME]
        assert len(lone) == 1
        assert results[n].verdict is Verdict.FAIL
    whole = judge_panel(gathered(results, STEP_MM), panel_station(STEP_MM))
    assert not whole.unpaired
    # Without the frame that measures it, the cut seed keeps the panel from passing.
    alone = judge_panel(PanelFrames(None, (PanelFrame(results[0]),)), panel_station(STEP_MM))
    assert len(alone.unpaired) == 1
    assert alone.verdict is Verdict.NOT_INSPECTED
