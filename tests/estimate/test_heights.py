"""Pairs to defects: gain, order, flags, and what each method gives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from spot_lists import seen
from views import View, seeds_at

from inspector import reflection
from inspector.detect.pairs import pair
from inspector.estimate.heights import measure
from inspector.model import Defect, Flag, FloatArray, HighlightPairs, Highlights
from inspector.optics import Calibration

CALIBRATION = View().calibration
FEET = np.array([[150.0, 120.0], [400.0, 130.0], [250.0, 300.0], [450.0, 380.0]])
SEEDS = seeds_at(FEET, np.array([9.0, 20.0, 14.0, 17.0]), CALIBRATION)


def spots(seeds: FloatArray = SEEDS, sigma_px: float = 0.03) -> Highlights:
    return seen(seeds, CALIBRATION, np.random.default_rng(0), sigma_px)


def exact(found: Highlights, calibration: Calibration = CALIBRATION) -> tuple[Defect, ...]:
    return measure(found, pair(found, calibration), calibration, "exact")[0]


def test_the_gain_multiplies_heights_and_their_uncertainty() -> None:
    plain, larger = exact(spots()), exact(spots(), replace(CALIBRATION, height_gain=1.064))
    assert len(plain) == 4
    for one, other in zip(plain, larger, strict=True):
        assert other.height_um == pytest.approx(1.064 * one.height_um)
        assert one.height_sigma_um is not None
        assert other.height_sigma_um == pytest.approx(1.064 * one.height_sigma_um)
        assert (other.x_mm, other.y_mm) == (one.x_mm, one.y_mm)


def test_the_highest_defect_comes_first_and_stands_where_its_seed_does() -> None:
    defects = exact(spots())
    by_height = SEEDS[np.argsort(-SEEDS[:, 2])]
    assert [d.height_um for d in defects] == pytest.approx(2000 * by_height[:, 2], rel=0.02)
    assert np.array([(d.x_mm, d.y_mm) for d in defects]) == pytest.approx(by_height[:, :2], abs=0.1)


def test_stated_sigma_is_the_scatter_of_heights() -> None:
    """Four seeds, 100 draws of 0.05 px noise on each spot."""
    z = []
    truth = np.sort(2000 * SEEDS[:, 2])[::-1]
    for k in range(100):
        defects = exact(seen(SEEDS, CALIBRATION, np.random.default_rng(k), 0.05))
        assert all(d.height_sigma_um is not None for d in defects)
        z += [(d.height_um - t) / (d.height_sigma_um or 1.0) for d, t in zip(defects, truth, strict=True)]
    assert 0.85 < np.std(z) < 1.2


def test_the_thesis_method_states_no_uncertainty() -> None:
    found = spots()
    defects, _ = measure(found, pair(found, CALIBRATION), CALIBRATION, "thesis")
    assert all(d.height_sigma_um is None and d.residual_sigma is None for d in defects)


def test_a_sunk_seed_is_told_apart_from_noise() -> None:
    """Centres at 0.4 of the radius, spots known to 0.01 px: where the spare equation sees it, the defect says so."""
    sunk = SEEDS * [1, 1, 1, 0.4]
    defects = exact(spots(sunk, 0.01))
    assert len(defects) == 4
    told = [d.flags & (Flag.SUNK | Flag.INCONSISTENT) or (d.residual_sigma or 0) > 3 for d in defects]
    assert sum(map(bool, told)) >= 2


def test_a_sunk_seed_of_negative_size_is_none() -> None:
    """Two spots that no seed explains well: of a sunk one both radius and centre would lie below zero."""
    camera = replace(CALIBRATION.camera, width_px=45, height_px=39, cx_px=22.5, cy_px=19.5)
    calibration = replace(CALIBRATION, camera=camera)
    two = replace(
        spots(SEEDS[:1]),
        xy_px=np.array([[6.553, 30.549], [41.859, 5.432]]),
        covariance_px2=np.array([[[0.5841, 0.0189], [0.0189, 0.0815]], [[0.2932, -0.5726], [-0.5726, 1.7043]]]),
    )
    first, none = np.array([0]), np.array([], np.intp)
    pairs = HighlightPairs(first, first + 1, none, first, none, reflection.rays(camera, two.xy_px))
    (defect,) = measure(two, pairs, calibration, "exact")[0]
    assert defect.height_um > 0
    assert defect.flags == Flag.INCONSISTENT


def test_no_spots_no_defects() -> None:
    assert exact(spots(SEEDS[:0])) == ()
