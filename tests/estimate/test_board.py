"""Board images: the rendered one against its exact truth, drawn ones at every turn, and what must be refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from board_scene import BLACK_DN, WHITE_DN, Scene, expose, render

from inspector import reflection
from inspector.calibration_file import CalibrationFile
from inspector.estimate import board
from inspector.estimate.calibration import BoardRefused, SensorConstants
from inspector.estimate.squares import Squares, fit_squares, seen_squares
from inspector.model import FloatArray
from inspector.optics import Calibration

BOARD = Path(__file__).parents[1] / "data" / "board"
SENSOR = SensorConstants()
Grey = npt.NDArray[np.uint8]


@pytest.fixture(scope="module")
def image() -> Grey:
    return np.asarray(cv2.imread(str(BOARD / "board.png"), cv2.IMREAD_UNCHANGED), np.uint8)


@pytest.fixture(scope="module")
def truth() -> dict[str, Any]:
    return json.loads((BOARD / "truth.json").read_text())


@pytest.fixture(scope="module")
def true_calibration(truth: dict[str, Any]) -> Calibration:
    known = {"version": 1, "camera": truth["camera"], "light": truth["light"]}
    return CalibrationFile.model_validate(known).to_calibration()


def test_the_rendered_board_is_read_as_its_truth_says(image: Grey, truth: dict[str, Any]) -> None:
    found = board.find(image, 18.8, 6, 5)
    assert found.rejected == ()
    assert found.squares.points.world_mm == pytest.approx(np.array([p["world_mm"] for p in truth["points"]]))
    away = found.squares.points.xy_px - [p["centroid_px"] for p in truth["points"]]
    assert np.abs(away).max() < 0.06
    assert np.sqrt(np.mean(away**2)) < 0.02


@pytest.mark.parametrize("square_mm", [None, 12.0])
@pytest.mark.parametrize("method", ["reprojection", "tsai"])
def test_the_rendered_board_gives_the_camera_back(
    image: Grey, true_calibration: Calibration, square_mm: float | None, method: Any
) -> None:
    """The panel's points appear within 0.05 px of where they do, and heights change by less than 0.1 %."""
    fitted = fit_squares(board.find(image, 18.8, 6, 5, square_mm).squares, SENSOR, method)
    assert fitted.side_mm == pytest.approx(12.0, rel=2e-3)
    x, y = np.meshgrid(np.linspace(0, 130, 9), np.linspace(0, 110, 9))
    panel = np.column_stack([x.ravel(), y.ravel(), 0 * x.ravel()])
    camera = fitted.fit.camera
    assert np.linalg.norm(camera.project(panel) - true_calibration.camera.project(panel), axis=1).max() < 0.05
    assert np.abs(height_errors_pct(panel, true_calibration, replace(true_calibration, camera=camera))).max() < 0.1


def height_errors_pct(panel_mm: FloatArray, truth: Calibration, used: Calibration) -> FloatArray:
    """Errors of heights of seeds of 1 mm radius, seen through one calibration and measured by another."""
    n = np.arange(len(panel_mm))
    spots = reflection.highlights(np.column_stack([panel_mm[:, :2], np.ones((len(n), 2))]), truth)
    rays = reflection.rays(used.camera, np.concatenate(spots))
    found = reflection.solve(rays, np.tile(np.eye(2), (2 * len(n), 1, 1)), n, n + len(n), used)
    return np.asarray(100 * (found.radius_mm - 1))


def test_a_centroid_is_not_a_centre(true_calibration: Calibration, truth: dict[str, Any]) -> None:
    centres = np.array([p["world_mm"] for p in truth["points"]])
    centroids, _ = seen_squares(centres, 12.0, true_calibration.camera)
    assert centroids == pytest.approx(np.array([p["centroid_px"] for p in truth["points"]]), abs=3e-4)
    shift = np.linalg.norm(centroids - true_calibration.camera.project(centres), axis=1)
    assert shift.mean() == pytest.approx(0.27, abs=0.01)


def test_exact_centroids_give_the_exact_camera() -> None:
    scene = Scene(view_angle_deg=65)
    centroids, areas = seen_squares(scene.world_mm, scene.square_mm, scene.camera)
    squares = Squares(board.Points(scene.world_mm, centroids), areas)
    fitted = fit_squares(squares, SENSOR)
    assert fitted.side_mm == pytest.approx(scene.square_mm, rel=1e-9)
    assert fitted.fit.camera.centre_mm == pytest.approx(scene.camera.centre_mm, abs=1e-4)


# --- numbering -------------------------------------------------------------------------------------------------------


def test_turning_the_image_changes_no_number(image: Grey) -> None:
    """The camera turned about its own axis sees the same squares in other places."""
    upright = board.find(image, 18.8, 6, 5).squares.points
    for quarter in (1, 2, 3):
        turned = board.find(np.rot90(image, quarter).copy(), 18.8, 6, 5).squares.points
        x, y = upright.xy_px.T
        where = {1: (y, 639 - x), 2: (639 - x, 479 - y), 3: (479 - y, x)}[quarter]
        assert turned.xy_px == pytest.approx(np.column_stack(where), abs=0.02)
        assert np.array_equal(turned.world_mm, upright.world_mm)


def test_a_mirrored_image_is_numbered_right_handed_too(image: Grey) -> None:
    fitted = fit_squares(board.find(image[:, ::-1].copy(), 18.8, 6, 5).squares, SENSOR)
    assert fitted.fit.distances_px.max() < 0.1
    assert fitted.fit.camera.centre_mm[2] > 0


def test_a_cropped_or_wider_image_is_read_alike(image: Grey) -> None:
    whole = board.find(image, 18.8, 6, 5).squares.points
    cropped = board.find(image[5:430, 200:440].copy(), 18.8, 6, 5).squares.points
    assert cropped.xy_px + [200, 5] == pytest.approx(whole.xy_px, abs=0.03)


def test_sixteen_bits_read_as_eight(image: Grey) -> None:
    eight, sixteen = (board.find(i, 18.8, 6, 5).squares.points for i in (image, image.astype(np.uint16) * 16))
    assert sixteen.xy_px == pytest.approx(eight.xy_px, abs=1e-9)


def expected_world(scene: Scene) -> FloatArray:
    """Numbers as board.py states: the axis that lies more towards the camera points to it."""
    towards = scene.camera.centre_mm - scene.middle_mm
    to_camera = towards[np.argmax(np.abs(towards[:2]))] > 0
    return scene.world_mm if to_camera else 2 * scene.middle_mm - scene.world_mm


TURNS = [(azimuth_deg, roll_deg) for azimuth_deg in (10, 100, 190, 280) for roll_deg in range(0, 360, 30)]
SOME_TURNS = {(10 + 90 * ((n + n // 4) % 4), 30 * n) for n in range(12)}
"""Each roll once, each azimuth with three that lie apart: both axes are met from every side."""


@pytest.mark.parametrize(
    ("azimuth_deg", "roll_deg"),
    [turn if turn in SOME_TURNS else pytest.param(*turn, marks=pytest.mark.long) for turn in TURNS],
)
def test_any_turn_of_camera_and_board(azimuth_deg: float, roll_deg: float) -> None:
    scene = Scene(azimuth_deg=azimuth_deg, roll_deg=roll_deg, view_angle_deg=45 + roll_deg / 20)
    points = board.find(render(scene, seed=int(roll_deg)), 18.8, 6, 5).squares.points
    seen, _ = seen_squares(scene.world_mm, scene.square_mm, scene.camera)
    place = {tuple(np.rint(xyz).astype(int)): xy for xyz, xy in zip(expected_world(scene), seen, strict=True)}
    expected = np.array([place[tuple(np.rint(xyz).astype(int))] for xyz in points.world_mm])
    assert np.abs(points.xy_px - expected).max() < 0.15


@pytest.mark.parametrize("azimuth_deg", [20, 110, 200, 290])
def test_a_board_with_as_many_rows_as_columns_points_x_to_the_camera(azimuth_deg: float) -> None:
    scene = Scene(columns=5, rows=5, azimuth_deg=azimuth_deg, roll_deg=33)
    camera = fit_squares(board.find(render(scene), 18.8, 5, 5).squares, SENSOR).fit.camera
    towards = camera.centre_mm - scene.middle_mm
    assert towards[0] > abs(towards[1])
    assert camera.centre_mm[2] == pytest.approx(scene.camera.centre_mm[2], rel=5e-3)


@pytest.mark.parametrize("noise_dn", [0.0, 5.0, 15.0])
def test_noise_costs_little(noise_dn: float) -> None:
    scene = Scene(view_angle_deg=60)
    fitted = fit_squares(board.find(render(scene, noise_dn), 18.8, 6, 5).squares, SENSOR).fit
    assert fitted.camera.f_mm == pytest.approx(scene.f_mm, abs=4 * np.sqrt(fitted.covariance[6, 6]) + 1e-3)
    assert fitted.camera.f_mm == pytest.approx(scene.f_mm, rel=0.01)


def test_squares_of_six_pixels_are_still_squares() -> None:
    scene = Scene(view_angle_deg=55, distance_mm=560, f_mm=4.5, square_mm=10, roll_deg=20)
    _, areas = seen_squares(scene.world_mm, scene.square_mm, scene.camera)
    assert areas.min() < 60
    assert fit_squares(board.find(render(scene), 18.8, 6, 5).squares, SENSOR).fit.distances_px.max() < 0.2


# --- what is no square of the board ----------------------------------------------------------------------------------


def with_clutter(*draw: Any) -> Grey:
    """A board in the middle of the image, with other bright things about."""
    light = render(Scene(), noise_dn=0).astype(np.float64)
    for function, *arguments in draw:
        function(light, *arguments)
    return expose(light)


CLUTTER = {
    "disc": (cv2.circle, (60, 60), 14, WHITE_DN, -1),
    "triangle": (cv2.fillPoly, [np.array([[560, 40], [610, 60], [575, 90]])], WHITE_DN),
    "streak": (cv2.line, (30, 400), (110, 440), 255.0, 5),
    "square far off": (cv2.rectangle, (580, 420), (605, 445), WHITE_DN, -1),
    "large patch": (cv2.rectangle, (20, 120), (110, 260), WHITE_DN, -1),
    "small squares": (cv2.rectangle, (600, 200), (608, 208), WHITE_DN, -1),
    "glare at the edge": (cv2.ellipse, (639, 300), (20, 50), 0, 0, 360, 255.0, -1),
    "specks": (cv2.circle, (500, 20), 1, 255.0, -1),
}


@pytest.mark.parametrize("things", [[name] for name in CLUTTER] + [list(CLUTTER)], ids=[*CLUTTER, "all"])
def test_clutter_is_left_out_and_said(things: list[str]) -> None:
    found = board.find(with_clutter(*(CLUTTER[name] for name in things)), 18.8, 6, 5)
    clean = board.find(with_clutter(), 18.8, 6, 5)
    assert found.squares.points.xy_px == pytest.approx(clean.squares.points.xy_px, abs=0.02)
    assert len(found.rejected) == len([name for name in things if name != "specks"])


def test_dirt_inside_a_square_does_not_move_it() -> None:
    x, y = board.find(with_clutter(), 18.8, 6, 5).squares.points.xy_px[12]
    dirty = with_clutter((cv2.circle, (round(x) + 4, round(y) + 3), 2, BLACK_DN, -1))
    moved = board.find(dirty, 18.8, 6, 5).squares.points.xy_px[12] - [x, y]
    assert np.abs(moved).max() < 0.03


def covered_in_part() -> Grey:
    """A square with a straight strip off one side: still a rectangle, at nearly the right place."""
    x, y = np.rint(board.find(with_clutter(), 18.8, 6, 5).squares.points.xy_px[12]).astype(int)
    return with_clutter((cv2.rectangle, (x - 40, y + 5), (x + 40, y + 18), BLACK_DN, -1))


def test_a_square_covered_in_part_is_refused() -> None:
    with pytest.raises(BoardRefused, match=r"% of the area it should have|missing near|not 6 x 5"):
        fit_squares(board.find(covered_in_part(), 18.8, 6, 5).squares, SENSOR)


@pytest.mark.parametrize(
    ("image", "columns", "rows", "reason"),
    [
        pytest.param(np.zeros((480, 640), np.uint8), 6, 5, "no bright squares on black", id="black"),
        pytest.param(np.full((480, 640), 200, np.uint8), 6, 5, "no bright squares on black", id="white"),
        pytest.param(expose(np.full((480, 640), 90.0), 12), 6, 5, "no bright squares on black", id="noise"),
        pytest.param(expose(np.tile(np.linspace(0, 255, 640), (480, 1))), 6, 5, "no bright squares", id="ramp"),
        pytest.param(render(Scene(), leave_out=(7, 20)), 6, 5, r"found 28 .* missing near \(\d+, \d+\), ", id="holes"),
        pytest.param(render(Scene(aim_px=(260, 0))), 6, 5, "is cut by the image's edge", id="half out of view"),
        pytest.param(render(Scene(aim_px=(0, 180))), 6, 5, r"found \d+ squares in a grid of", id="rows out of view"),
        pytest.param(render(Scene()), 7, 5, "found 30 squares in a grid of 6 x 5, not 7 x 5", id="a column too many"),
        pytest.param(render(Scene()), 5, 5, "more squares than stated", id="a column too few"),
        pytest.param(render(Scene()), 6, 1, "at least 2 x 2", id="one row"),
        pytest.param(255 - render(Scene()), 6, 5, "found 0 squares|no bright squares", id="black on white"),
    ],
)  # fmt: skip
def test_refused_with_what_was_found(image: Grey, columns: int, rows: int, reason: str) -> None:
    with pytest.raises(BoardRefused, match=reason):
        board.find(image, 18.8, columns, rows)


def test_a_known_square_size_that_is_wrong_is_refused() -> None:
    with pytest.raises(BoardRefused, match="not 6 x 5"):
        board.find(render(Scene()), 18.8, 6, 5, square_mm=6.0)
