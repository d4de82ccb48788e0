"""What the image of a square is: an area whose centroid is not the image of the square's centre.

Perspective and distortion shift it (0.27 px on average at the thesis' tilt), towards the nearer side; a fit that took
one for the other would carry that shift into every height. So each measured centroid is corrected by the shift that
the camera itself predicts, and the fit repeated: the exact observation model at the fixed point.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from inspector.estimate.calibration import BoardRefused, Fit, Method, Points, SensorConstants, fit, fit_camera
from inspector.model import FloatArray
from inspector.optics import Camera

ROUNDS = 6
"""The shift hardly depends on the camera: each round wins two digits."""
AREA_TOLERANCE = 0.1
"""Areas agree to a percent on clean boards; a tenth missing on one side moves a centroid by a twentieth of the side."""
SIDES_PER_EDGE = 16
"""Chords that stand for one distorted edge: wrong by a millionth of its bow."""


@dataclass(frozen=True)
class Squares:
    """Squares of a board as seen: ``points`` with their area centroids as pixels, and their areas (n,) px^2.

    Their edges are parallel to the world's x and y. ``side_mm`` None: found from the areas.
    """

    points: Points
    area_px2: FloatArray
    side_mm: float | None = None


@dataclass(frozen=True)
class SquaresFit:
    """A fit to squares' centres: its points are the centroids less their shift; ``side_mm`` as used."""

    fit: Fit
    side_mm: float
    shifts_px: FloatArray


def fit_squares(squares: Squares, sensor: SensorConstants, method: Method = "reprojection") -> SquaresFit:
    """The camera that explains squares' centroids. Raises BoardRefused as :func:`calibration.fit`."""
    world, seen_px = squares.points.world_mm, squares.points.xy_px
    centres = squares.points
    for _ in range(ROUNDS):
        camera = fit_camera(centres, sensor, method)
        side_mm = squares.side_mm or side_of(squares, camera)
        centroids, _ = seen_squares(world, side_mm, camera)
        shifts = centroids - camera.project(world)
        centres = replace(squares.points, xy_px=seen_px - shifts)
    fitted = fit(centres, sensor, method)
    _check_areas(squares, side_mm, fitted.camera)
    return SquaresFit(fitted, side_mm, shifts)


def _check_areas(squares: Squares, side_mm: float, camera: Camera) -> None:
    """Refuse squares that are larger or smaller than the rest: covered in part, or grown by a reflection."""
    _, areas = seen_squares(squares.points.world_mm, side_mm, camera)
    share = squares.area_px2 / areas
    share /= np.median(share)
    worst = int(np.argmax(np.abs(share - 1)))
    if not abs(share[worst] - 1) <= AREA_TOLERANCE:
        x, y = squares.points.xy_px[worst]
        raise BoardRefused(
            f"the square at ({x:.0f}, {y:.0f}) px has {100 * share[worst]:.0f} % of the area it should have: clean the"
            " board and keep reflections off it"
        )


def side_of(squares: Squares, camera: Camera) -> float:
    """The squares' side, mm, that gives their total area in the image."""
    side = 1.0
    for _ in range(3):  # areas go with the side's square but for a little perspective
        _, areas = seen_squares(squares.points.world_mm, side, camera)
        side *= float(np.sqrt(np.sum(squares.area_px2) / np.sum(areas)))
    return side


def seen_squares(centres_mm: FloatArray, side_mm: float, camera: Camera) -> tuple[FloatArray, FloatArray]:
    """Area centroids (n, 2) px and areas (n,) px^2 of the images of squares centred at (n, 3) mm."""
    outline = side_mm * _unit_outline()
    corners = centres_mm[:, None, :] + outline
    x, y = np.moveaxis(camera.project(corners.reshape(-1, 3)).reshape(len(centres_mm), -1, 2), 2, 0)
    # The shoelace sums about each outline's mean: far fewer digits cancel than about the image's corner.
    mean = np.column_stack([x.mean(axis=1), y.mean(axis=1)])
    x, y = x - mean[:, :1], y - mean[:, 1:]
    x2, y2 = np.roll(x, -1, axis=1), np.roll(y, -1, axis=1)
    cross = x * y2 - x2 * y
    double_area = cross.sum(axis=1)
    moments = np.column_stack([((x + x2) * cross).sum(axis=1), ((y + y2) * cross).sum(axis=1)])
    return mean + moments / (3 * double_area[:, None]), np.abs(double_area) / 2


def _unit_outline() -> FloatArray:
    """The outline (4 k, 3) of a square of side one about the origin, k points an edge."""
    corners = np.array([[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [0.5, 0.5, 0.0], [-0.5, 0.5, 0.0]])
    along = np.arange(SIDES_PER_EDGE)[:, None] / SIDES_PER_EDGE
    return np.concatenate([a + along * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)])
