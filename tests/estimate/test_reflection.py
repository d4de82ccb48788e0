"""The model forward and back, for any camera and lamp: exact on exact pixels, honest on noise and on sunk seeds."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from views import View, seeds_at, spread_px, views

from inspector import reflection
from inspector.model import FloatArray
from inspector.optics import Calibration

LAMPS = pytest.mark.parametrize("lamp_mm", [None, 350.0], ids=["far lamp", "near lamp"])


def solved(
    direct_px: FloatArray, mirror_px: FloatArray, calibration: Calibration, spread_px: FloatArray | float = 0.05
) -> reflection.Seeds:
    """The seeds of pairs of pixels (n, 2) that scatter by ``spread_px`` (2, 2, 2): square roots of both covariances."""
    n = len(direct_px)
    roots = np.broadcast_to(spread_px * np.eye(2) if np.ndim(spread_px) == 0 else spread_px, (2, 2, 2))
    covariance = np.repeat(roots @ roots.swapaxes(1, 2), n, axis=0)
    rays = reflection.rays(calibration.camera, np.concatenate([direct_px, mirror_px]))
    return reflection.solve(rays, covariance, np.arange(n), np.arange(n) + n, calibration)


@given(view=views, spacing_px=st.floats(4, 40), seed=st.integers(0, 2**32 - 1))
def test_exact_pixels_give_the_seed_back(view: View, spacing_px: float, seed: int) -> None:
    calibration = view.calibration
    seeds = seeds_at(spread_px(8, np.random.default_rng(seed)), spacing_px, calibration)
    found = solved(*reflection.highlights(seeds, calibration), calibration)
    rounds = 1e-10 if view.lamp_mm is None else 1e-9  # a near lamp is solved in rounds
    assert found.radius_mm == pytest.approx(seeds[:, 2], rel=rounds)
    assert np.column_stack([found.x_mm, found.y_mm]) == pytest.approx(seeds[:, :2], abs=100 * rounds)
    assert np.all(found.chi2 < 1e-12)


@given(view=views, seed=st.integers(0, 2**32 - 1))
def test_a_spot_is_where_lamp_and_camera_are_bisected(view: View, seed: int) -> None:
    """The law of reflection at both spots, and that both spots lie on the sphere: nothing of the solver is used."""
    calibration = view.calibration
    eye = calibration.camera.centre_mm
    seeds = seeds_at(spread_px(8, np.random.default_rng(seed)), 20.0, calibration)
    for eye_mm, pixels in zip((eye, eye * reflection.MIRROR), reflection.highlights(seeds, calibration), strict=True):
        normal = surface_normal(seeds, eye_mm, pixels, calibration)
        point = seeds[:, (0, 1, 3)] + seeds[:, 2:3] * normal
        away, lamp = reflection.unit(eye_mm - point), calibration.light.toward(point)
        reflected = 2 * (lamp * normal).sum(axis=1, keepdims=True) * normal - lamp
        assert reflected == pytest.approx(away, abs=1e-7)


def surface_normal(seeds: FloatArray, eye_mm: FloatArray, pixels: FloatArray, calibration: Calibration) -> FloatArray:
    """Where the ray of each pixel first meets its sphere (for the mirrored eye, the ray mirrored in the paint)."""
    ray = reflection.unit(calibration.camera.rays(pixels))
    ray = ray * (reflection.MIRROR if eye_mm[2] < 0 else 1.0)
    centre = seeds[:, (0, 1, 3)] - eye_mm
    along = (ray * centre).sum(axis=1)
    depth = np.sqrt(seeds[:, 2] ** 2 - (centre**2).sum(axis=1) + along**2)
    return ((along - depth)[:, None] * ray - centre) / seeds[:, 2:3]


@LAMPS
def test_stated_covariance_is_what_noise_does(lamp_mm: float | None) -> None:
    """Noise of 0.05 px on both spots, 4000 times: errors of x, y and R scatter and correlate as stated."""
    calibration = View(lamp_mm=lamp_mm).calibration
    rng = np.random.default_rng(0)
    seeds = np.repeat(seeds_at(np.array([[200.0, 300.0]]), 14.0, calibration), 4000, axis=0)
    direct, mirror = (p + rng.normal(0, 0.05, p.shape) for p in reflection.highlights(seeds, calibration))
    found = solved(direct, mirror, calibration)
    errors = np.column_stack([found.x_mm, found.y_mm, found.radius_mm]) - seeds[:, :3]
    whitened = np.einsum("nij,nj->ni", np.linalg.inv(np.linalg.cholesky(found.covariance)), errors)
    assert np.cov(whitened.T) == pytest.approx(np.eye(3), abs=0.08)
    assert found.chi2.mean() == pytest.approx(1.0, abs=0.08)
    assert np.abs(errors.mean(axis=0)) == pytest.approx(0, abs=4 * np.sqrt(found.covariance[0].max() / 4000))


@LAMPS
def test_unequal_spots_are_weighted_and_their_covariance_is_carried_through(lamp_mm: float | None) -> None:
    calibration = View(roll_deg=30, lamp_mm=lamp_mm).calibration
    rng, n = np.random.default_rng(1), 4000
    seeds = np.repeat(seeds_at(np.array([[400.0, 200.0]]), 12.0, calibration), n, axis=0)
    spread = np.array([[[0.02, 0.0], [0.01, 0.03]], [[0.10, 0.02], [0.0, 0.05]]])
    pixels = [
        p + rng.normal(size=(n, 2)) @ s.T
        for p, s in zip(reflection.highlights(seeds, calibration), spread, strict=True)
    ]
    found = solved(*pixels, calibration, spread)
    assert np.std((found.radius_mm - seeds[:, 2]) / np.sqrt(found.covariance[:, 2, 2])) == pytest.approx(1, abs=0.05)


@pytest.mark.parametrize(("sunk", "low_pct"), [(0.7, 0.7), (0.5, 1.2), (0.3, 2.0), (0.0, 3.7)])
def test_a_sunk_seed_reads_low_and_fits_worse(sunk: float, low_pct: float) -> None:
    """Read as resting, at the thesis' geometry; height is c + R. Off the symmetry plane the spare equation tells."""
    calibration = View().calibration
    seeds = seeds_at(spread_px(40, np.random.default_rng(2)), 20.0, calibration, sunk)
    found = solved(*reflection.highlights(seeds, calibration), calibration, spread_px=0.01)
    height = seeds[:, 2] + seeds[:, 3]
    assert np.median(100 * (1 - 2 * found.radius_mm / height)) == pytest.approx(low_pct, abs=0.25)
    assert np.median(found.chi2) > 0.01


def test_no_pairs_give_no_seeds() -> None:
    found = solved(np.empty((0, 2)), np.empty((0, 2)), View().calibration)
    assert found.radius_mm.shape == found.chi2.shape == (0,)
