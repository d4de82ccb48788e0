"""The calibration's share of a height's uncertainty, against cameras drawn from the calibration's own covariance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from spot_lists import spots_at
from views import View, seeds_at, spread_px

from inspector import reflection
from inspector.estimate import heights
from inspector.estimate.field_sigma import field_sigma
from inspector.model import CAMERA_PARAMETERS, FloatArray, HighlightPairs
from inspector.optics import Calibration

VIEWS = pytest.mark.parametrize(
    "view", [View(), View(view_angle_deg=55, roll_deg=40, alpha_deg=20, lamp_mm=400.0)], ids=["far", "near"]
)
SIGMAS = np.array([2e-3, 1.5e-3, 1e-3, 0.2, 0.2, 0.5, 0.02, 2e-4])
"""Standard deviations of a camera's parameters as a board gives them, in the order of CAMERA_PARAMETERS."""


def fitted(view: View, names: tuple[str, ...] = CAMERA_PARAMETERS) -> Calibration:
    """A calibration that knows its parameters so badly, and correlated as focal length and distance are."""
    correlation = np.eye(len(CAMERA_PARAMETERS))
    correlation[5, 6] = correlation[6, 5] = 0.9
    covariance = correlation * np.outer(SIGMAS, SIGMAS)
    keep = [CAMERA_PARAMETERS.index(name) for name in names]
    return replace(view.calibration, covariance=covariance[np.ix_(keep, keep)], covariance_of=names)


def measured(
    direct_px: FloatArray, mirror_px: FloatArray, calibration: Calibration, spot_px: float
) -> tuple[FloatArray, FloatArray]:
    """Heights and sigmas (n,) um in the pairs' order, of spots known to ``spot_px``."""
    n = len(direct_px)
    xy = np.concatenate([direct_px, mirror_px])
    spots = spots_at(xy, 1000.0, spot_px)
    index = np.arange(n)
    rays = reflection.rays(calibration.camera, xy)
    pairs = HighlightPairs(index, index + n, index[:0], np.zeros(n, np.intp), index[:0], rays)
    defects, _ = heights.measure(spots, pairs, calibration, "exact")
    by_place = {d.direct_px: d for d in defects}
    found = [by_place[(x, y)] for x, y in direct_px.tolist()]
    return np.array([d.height_um for d in found]), np.array([d.height_sigma_um for d in found])


@VIEWS
@pytest.mark.parametrize("names", [CAMERA_PARAMETERS, ("f_mm", "translation_z_mm")], ids=["all", "two"])
def test_sigma_is_what_other_cameras_of_the_covariance_give(view: View, names: tuple[str, ...]) -> None:
    """Exact pixels read through 400 drawn cameras: heights spread as stated, seed by seed over the whole field."""
    calibration, rng = fitted(view, names), np.random.default_rng(4)
    assert calibration.covariance is not None
    seeds = seeds_at(spread_px(20, rng), 14.0, calibration)
    pixels = reflection.highlights(seeds, calibration)
    field = field_sigma(calibration)
    assert field is not None
    stated = field.at(pixels[0]) * 2000 * seeds[:, 2]
    draws = np.zeros((400, len(CAMERA_PARAMETERS)))
    draws[:, [CAMERA_PARAMETERS.index(n) for n in names]] = rng.multivariate_normal(
        np.zeros(len(names)), calibration.covariance, 400
    )
    cameras = [calibration.camera.perturbed(d) for d in draws]
    spread = np.std(
        [measured(*pixels, replace(calibration, camera=c, covariance=None), 1.0)[0] for c in cameras], axis=0
    )
    assert stated == pytest.approx(spread, rel=0.15)


def test_spots_and_calibration_add_as_squares() -> None:
    calibration = fitted(View())
    pixels = reflection.highlights(seeds_at(spread_px(10, np.random.default_rng(5)), 14.0, calibration), calibration)
    _, both = measured(*pixels, calibration, 0.02)
    _, spots = measured(*pixels, replace(calibration, covariance=None), 0.02)
    _, camera = measured(*pixels, calibration, 1e-4)
    assert both == pytest.approx(np.hypot(spots, camera), rel=1e-3)
    assert np.all(both > spots)


def test_the_grid_is_fine_enough() -> None:
    """Between its points the share is what a probe right there gives."""
    calibration = fitted(View())
    field = field_sigma(calibration)
    assert field is not None
    shifted = replace(calibration, camera=replace(calibration.camera, cx_px=calibration.camera.cx_px + 40.0))
    moved = field_sigma(shifted)  # the same camera with its frame cut 40 px further left
    assert moved is not None
    inner = spread_px(50, np.random.default_rng(6))
    assert field.at(inner) == pytest.approx(moved.at(inner + (40.0, 0.0)), rel=0.03)


def test_a_calibration_of_unknown_uncertainty_adds_nothing() -> None:
    assert field_sigma(View().calibration) is None


def test_it_is_computed_once_for_a_calibration() -> None:
    calibration = fitted(View())
    assert field_sigma(calibration) is field_sigma(calibration)


def test_a_frame_that_looks_past_the_panel_has_numbers_everywhere() -> None:
    field = field_sigma(fitted(View(view_angle_deg=80, f_mm=5.0, kappa1_per_mm2=0.0)))
    assert field is not None
    assert np.all(np.isfinite(field.share))
