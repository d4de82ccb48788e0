"""Fits of points: exact on exact points, honest about noise, and refusing what fixes no camera."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from board_scene import Scene
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from inspector.estimate.calibration import BoardRefused, Fit, Method, Points, SensorConstants, fit
from inspector.model import CAMERA_PARAMETERS, FloatArray
from inspector.optics import Camera

SENSOR = SensorConstants()
METHODS: list[Method] = ["tsai", "reprojection"]


def points_of(scene: Scene, noise_px: float = 0.0, seed: int = 0) -> Points:
    noise = np.random.default_rng(seed).normal(0, noise_px, (len(scene.world_mm), 2))
    return Points(scene.world_mm, scene.camera.project(scene.world_mm) + noise)


def in_frame(scene: Scene) -> bool:
    xy = scene.camera.project(scene.world_mm)
    return bool(np.isfinite(xy).all() and np.all(xy > 0) and np.all(xy < [639, 479]))


scenes = st.builds(
    Scene,
    view_angle_deg=st.floats(20, 75),
    azimuth_deg=st.floats(-180, 180),
    roll_deg=st.floats(-180, 180),
    distance_mm=st.floats(250, 600),
    f_mm=st.floats(4, 9),
    kappa1_per_mm2=st.floats(-8e-3, 1e-2),
    aim_px=st.tuples(st.floats(-60, 60), st.floats(-40, 40)),
)


@settings(max_examples=60, deadline=None)
@given(scene=scenes)
def test_world_to_image_and_back_is_exact(scene: Scene) -> None:
    assume(in_frame(scene))
    points = points_of(scene)
    assert scene.camera.back_project(points.xy_px) == pytest.approx(points.world_mm[:, :2], abs=1e-9)


def without_roll(view_angle_deg: float, azimuth_deg: float, row_px: float) -> Scene:
    """Rows one and two of its rotation are orthogonal in the board's plane, here to the last bit."""
    camera = {"distance_mm": 250.0, "f_mm": 4.0, "kappa1_per_mm2": 0.0, "aim_px": (0.0, row_px)}
    return Scene(view_angle_deg=view_angle_deg, azimuth_deg=azimuth_deg, roll_deg=0.0, **camera)


@settings(max_examples=25, deadline=None)
@given(scene=scenes)
@example(scene=without_roll(36.0, 37.596687305981405, -9.5))
@example(scene=without_roll(36.0, 37.596687305981405, -8.5))
@example(scene=without_roll(20.0, 37.59375, 10.0))
def test_exact_points_give_the_camera_back(scene: Scene) -> None:
    assume(in_frame(scene))
    fitted = fit(points_of(scene), SENSOR)
    truth = scene.camera
    assert fitted.camera.f_mm == pytest.approx(truth.f_mm, rel=1e-6)
    assert fitted.camera.centre_mm == pytest.approx(truth.centre_mm, abs=1e-3)
    assert np.max(fitted.distances_px) < 1e-5


@pytest.mark.parametrize("method", METHODS)
def test_both_methods_find_the_camera_of_exact_points(method: Method) -> None:
    scene = Scene(aim_px=(15, -20), roll_deg=12)
    assert fit(points_of(scene), SENSOR, method).camera.f_mm == pytest.approx(scene.f_mm, rel=1e-6)


def test_reprojection_needs_no_luck_with_the_origin() -> None:
    """Tsai's first stage divides by Ty, which is zero here; the other method starts from another origin."""
    scene = Scene(view_angle_deg=60, azimuth_deg=0, roll_deg=90)
    on_middle_row = replace(scene, aim_px=(0, 0)).camera
    shift = np.array([0.0, -on_middle_row.translation_mm[1], 0.0])
    camera = replace(on_middle_row, translation_mm=on_middle_row.translation_mm + shift)
    points = Points(scene.world_mm, camera.project(scene.world_mm))
    assert fit(points, SENSOR).camera.f_mm == pytest.approx(scene.f_mm, rel=1e-6)


def parameters(fitted: Fit, truth: Camera) -> FloatArray:
    """The fit's error in its own parameters: rotation vector, translation, f, kappa1."""
    turn = fitted.camera.rotation @ truth.rotation.T
    w = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
    rest = [fitted.camera.f_mm - truth.f_mm, fitted.camera.kappa1_per_mm2 - truth.kappa1_per_mm2]
    return np.concatenate([w, fitted.camera.translation_mm - truth.translation_mm, rest])


@pytest.mark.parametrize(("method", "runs"), [("reprojection", 24), ("tsai", 8)])
def test_uncertainty_is_what_noise_does(method: Method, runs: int) -> None:
    """Noise of 0.05 px: the errors, each over its stated uncertainty, scatter by one."""
    scene = Scene(view_angle_deg=60, roll_deg=10, aim_px=(10, 15))
    fits = [fit(points_of(scene, 0.05, seed), SENSOR, method) for seed in range(runs)]
    z = np.array([parameters(f, scene.camera) / np.sqrt(np.diag(f.covariance)) for f in fits])
    assert z.shape == (runs, len(CAMERA_PARAMETERS))
    assert 0.7 < np.sqrt(np.mean(z**2)) < 1.35


def test_perturbed_turns_and_shifts_as_it_says() -> None:
    camera = Scene().camera
    by = np.array([0.01, -0.02, 0.03, 1.0, 2.0, 3.0, 0.1, 1e-4])
    moved = camera.perturbed(by)
    assert moved.rotation @ moved.rotation.T == pytest.approx(np.eye(3), abs=1e-14)
    axis = by[:3] / np.linalg.norm(by[:3])
    assert moved.rotation.T @ axis == pytest.approx(camera.rotation.T @ axis)  # the axis itself does not turn
    assert np.trace(moved.rotation @ camera.rotation.T) == pytest.approx(1 + 2 * np.cos(np.linalg.norm(by[:3])))
    assert moved.translation_mm - camera.translation_mm == pytest.approx(by[3:6])
    assert (moved.f_mm, moved.kappa1_per_mm2) == (camera.f_mm + 0.1, camera.kappa1_per_mm2 + 1e-4)
    assert camera.perturbed(np.zeros(8)).rotation == pytest.approx(camera.rotation, abs=0)


def with_world(points: Points, row: int, *xyz: float) -> Points:
    world = points.world_mm.copy()
    world[row] = xyz
    return Points(world, points.xy_px)


def with_pixel(points: Points, row: int, *xy: float) -> Points:
    pixels = points.xy_px.copy()
    pixels[row] = xy
    return Points(points.world_mm, pixels)


GOOD = points_of(Scene(roll_deg=10, aim_px=(10, 15)), 0.02)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("points", "reason"),
    [
        pytest.param(Points(GOOD.world_mm[:0], GOOD.xy_px[:0]), "too few points: 0", id="none"),
        pytest.param(Points(GOOD.world_mm[[0, 4, 25, 29]], GOOD.xy_px[[0, 4, 25, 29]]), "too few points: 4", id="four"),
        pytest.param(Points(GOOD.world_mm[::5], GOOD.xy_px[::5]), "collinear on the board", id="one row"),
        pytest.param(Points(np.outer(np.arange(8), [10, 7, 0]), GOOD.xy_px[:8]), "collinear on the board", id="slant"),
        pytest.param(Points(GOOD.world_mm, np.outer(np.arange(30.0), [7, 3])), "collinear in the image", id="edge on"),
        pytest.param(with_world(GOOD, 3, 18.8, 75.2, 0.5), "point 4 is off the board's plane", id="raised"),
        pytest.param(with_world(GOOD, 3, np.nan, 75.2, 0), "point 4 is not finite", id="nan"),
        pytest.param(with_pixel(GOOD, 7, np.inf, 3), "point 8 is not finite", id="infinite"),
        pytest.param(with_world(GOOD, 1, *GOOD.world_mm[0]), "point 2 is repeated on the board", id="twice on board"),
        pytest.param(with_pixel(GOOD, 9, *GOOD.xy_px[2]), "point 10 is repeated on the image", id="twice in image"),
        pytest.param(with_pixel(GOOD, 9, *(GOOD.xy_px[9] + [25, 0])), "point 10 agrees least, it is 2", id="mistyped"),
        pytest.param(with_pixel(GOOD, 2, *(GOOD.xy_px[2] + [0, 200])), "point 3 agrees|in front", id="far off"),
        pytest.param(Points(GOOD.world_mm[np.random.default_rng(1).permutation(30)], GOOD.xy_px), ".", id="shuffled"),
        pytest.param(Points(GOOD.world_mm * [1, -1, 1], GOOD.xy_px), "behind the board", id="left-handed"),
    ],
)  # fmt: skip
def test_points_that_fix_no_camera_are_refused_with_the_reason(points: Points, reason: str, method: Method) -> None:
    with pytest.raises(BoardRefused, match=reason):
        fit(points, SENSOR, method)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("noise_px", [0.0, 0.05])
@pytest.mark.parametrize("view_angle_deg", [0.0, 1.0, 5.0])
def test_a_fronto_parallel_board_is_refused(view_angle_deg: float, noise_px: float, method: Method) -> None:
    scene = Scene(view_angle_deg=view_angle_deg, roll_deg=10, aim_px=(10, 15), kappa1_per_mm2=8e-3)
    with pytest.raises(BoardRefused, match=r"fronto-parallel: tilted by only \d"):
        fit(points_of(scene, noise_px), SENSOR, method)


@pytest.mark.parametrize("seed", range(5))
def test_a_board_too_small_in_the_image_is_refused(seed: int) -> None:
    scene = Scene(view_angle_deg=25, distance_mm=3000, aim_px=(10, 15))  # f comes out at a metre, or at infinity
    with pytest.raises(BoardRefused, match=r"focal length is not known well enough|behind the camera"):
        fit(points_of(scene, 0.3, seed), SENSOR)
