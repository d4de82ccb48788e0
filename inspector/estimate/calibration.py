"""Board points -> camera: Tsai's two stages for a flat board as the thesis used them, and a reprojection fit.

Sources: R. Y. Tsai, IEEE J. Robotics and Automation RA-3(4), 1987; the thesis, App. A (its sign rule after A.28 is
misprinted, see :func:`_rotation_from_rows`); R. Willson's three-parameter optimisation, which printed Table 5.3.
Everything here is pure; a board that cannot give a camera is refused with the reason.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from inspector.model import CAMERA_PARAMETERS, FloatArray, IntArray
from inspector.optics import Camera

Method = Literal["reprojection", "tsai"]

MIN_POINTS = 6
"""Eight parameters need four points; two more leave four equations to judge the fit by."""
MIN_SPREAD = 0.02
"""Thinner than this share of its length, a set of points is a line."""
MIN_TILT_DEG = 10.0
"""Under this, a tenth of a pixel hides the tilt, and with it the split between f and distance (the two scale alike)."""
MAX_F_SIGMA = 0.1
"""A focal length less certain than this share says nothing about where the camera stands."""
WORST_CONDITION = 1e13
"""Beyond this, rounding decides what the fit leaves open: a camera as good as infinitely far away."""
MAX_RESIDUAL_SHARE = 0.01
"""A point further from its prediction than this share of the image's width is misnumbered or mistyped."""


class BoardRefused(ValueError):
    """The board, or its points, cannot give a camera; the message says why and what to do."""


@dataclass(frozen=True)
class SensorConstants:
    """What a fit takes as known of the sensor; the defaults are the thesis' Table 5.1."""

    width_px: int = 640
    height_px: int = 480
    dx_mm: float = 0.0075
    dy_mm: float = 0.0075
    cx_px: float = 320.0
    cy_px: float = 240.0
    sx: float = 1.0

    def camera(self, rotation: FloatArray, translation_mm: FloatArray, f_mm: float, kappa1_per_mm2: float) -> Camera:
        """A camera with this sensor."""
        return Camera(
            width_px=self.width_px,
            height_px=self.height_px,
            f_mm=f_mm,
            kappa1_per_mm2=kappa1_per_mm2,
            sx=self.sx,
            cx_px=self.cx_px,
            cy_px=self.cy_px,
            dx_mm=self.dx_mm,
            dy_mm=self.dy_mm,
            rotation=rotation,
            translation_mm=translation_mm,
        )


@dataclass(frozen=True)
class Points:
    """Board points: ``world_mm`` (n, 3) with z = 0, and where they appear, ``xy_px`` (n, 2)."""

    world_mm: FloatArray
    xy_px: FloatArray

    def __len__(self) -> int:
        return len(self.world_mm)


@dataclass(frozen=True)
class Fit:
    """A fitted camera, the points it was fitted to, and the covariance (8, 8) of its ``CAMERA_PARAMETERS``."""

    method: Method
    camera: Camera
    points: Points
    covariance: FloatArray

    @property
    def residuals_px(self) -> FloatArray:
        """Measured minus predicted pixels (n, 2)."""
        return self.points.xy_px - self.camera.project(self.points.world_mm)

    @property
    def distances_px(self) -> FloatArray:
        """Lengths (n,) of the residuals."""
        return np.asarray(np.linalg.norm(self.residuals_px, axis=1))

    @property
    def computed_mm(self) -> FloatArray:
        """The measured pixels carried back to the board, (n, 2) mm (the thesis' verification, Table 5.4)."""
        return self.camera.back_project(self.points.xy_px)

    @property
    def percent_errors(self) -> FloatArray:
        """|computed - nominal| / |nominal| (n, 2) percent; NaN where the nominal coordinate is zero."""
        nominal = self.points.world_mm[:, :2]
        with np.errstate(divide="ignore", invalid="ignore"):
            share = np.abs(self.computed_mm - nominal) / np.abs(nominal)
        return np.asarray(100 * np.where(nominal == 0, np.nan, share))


def fit(points: Points, sensor: SensorConstants, method: Method = "reprojection") -> Fit:
    """The camera that explains ``points``, with its uncertainty.

    Raises BoardRefused for a degenerate board and for a fit that explains nothing.
    """
    camera = fit_camera(points, sensor, method)
    _check_camera(points, camera)
    unit = _propagated(points, sensor, camera) if method == "tsai" else _least_squares_covariance(points, camera)
    fitted = Fit(method, camera, points, _noise_px(points, camera) ** 2 * unit)
    _check_uncertainty(fitted)
    return fitted


def fit_camera(points: Points, sensor: SensorConstants, method: Method) -> Camera:
    """The camera alone, its fit not yet judged. Raises BoardRefused for a degenerate board."""
    check_points(points)
    return tsai(points, sensor) if method == "tsai" else reprojection(points, sensor)


# --- what cannot be fitted -------------------------------------------------------------------------------------------


def check_points(points: Points) -> None:
    """Refuse points that fix no camera: not finite, off the plane, too few, repeated, or on one line."""
    world, pixels = points.world_mm, points.xy_px
    bad = np.flatnonzero(~(np.isfinite(world).all(axis=1) & np.isfinite(pixels).all(axis=1)))
    if len(bad):
        raise BoardRefused(f"{_rows(bad)} not finite: give every coordinate as a number")
    raised = np.flatnonzero(world[:, 2] != 0)
    if len(raised):
        raise BoardRefused(f"{_rows(raised)} off the board's plane: zw_mm must be 0 for every point of a flat board")
    for what, values in (("board", world), ("image", pixels)):
        repeated = _repeated(values)
        if len(repeated):
            raise BoardRefused(f"{_rows(repeated)} repeated on the {what}: each point must be listed once")
    if len(points) < MIN_POINTS:
        raise BoardRefused(f"too few points: {len(points)}, at least {MIN_POINTS} are needed for eight parameters")
    for what, values in (("on the board", world[:, :2]), ("in the image", pixels)):
        if _spread(values) < MIN_SPREAD:
            raise BoardRefused(f"the points are collinear {what}: use points spread over two directions")


def _rows(indices: IntArray) -> str:
    """ "point 3 is" or "points 3, 5, 6 are", counted from 1."""
    names = ", ".join(str(int(i) + 1) for i in indices[:8]) + (", ..." if len(indices) > 8 else "")
    return f"point {names} is" if len(indices) == 1 else f"points {names} are"


def _repeated(values: FloatArray) -> IntArray:
    """Indices of rows that appeared before."""
    _, first = np.unique(values, axis=0, return_index=True)
    return np.setdiff1d(np.arange(len(values)), first)


def _spread(values: FloatArray) -> float:
    """Thickness over length of a cloud of points (n, 2): zero on a line."""
    singular = np.linalg.svd(values - values.mean(axis=0), compute_uv=False)
    return float(singular[1] / singular[0]) if singular[0] > 0 else 0.0


def _check_tilt(tilt_deg: float) -> None:
    if not tilt_deg >= MIN_TILT_DEG:
        raise BoardRefused(
            f"the board is fronto-parallel: tilted by only {tilt_deg:.1f} deg from the image plane, so focal length and"
            f" distance cannot be told apart; tilt it by {MIN_TILT_DEG:.0f} deg at the very least, 30 to 65 is good"
        )


def _check_camera(points: Points, camera: Camera) -> None:
    """Refuse a camera that does not explain its points or does not look at the panel's front."""
    away = np.linalg.norm(points.xy_px - camera.project(points.world_mm), axis=1)
    limit = MAX_RESIDUAL_SHARE * camera.width_px
    if not np.max(away) <= limit:
        n, distance = _odd_one(points)
        raise BoardRefused(
            f"no camera explains the points to {limit:.1f} px: point {n + 1} agrees least, it is {distance:.1f} px from"
            " where the others put it; check its coordinates, the numbering and the sensor constants"
        )
    if not camera.centre_mm[2] > 0:
        raise BoardRefused(
            "the camera comes out behind the board: the world frame is not right-handed with z towards the camera;"
            " swap or reverse one of the board's axes"
        )
    _check_tilt(min(camera.view_angle_deg, 180 - camera.view_angle_deg))


def _odd_one(points: Points) -> tuple[int, float]:
    """The point without which the others agree best on a plane's image, and its distance, px, from where they put it.

    One gross error bends a whole fit, so the largest residual need not be its own.
    """
    away = np.array([_plane_residuals(points, k) for k in range(len(points))])
    others = np.where(np.eye(len(points), dtype=bool), 0.0, away)
    k = int(np.argmin(np.sum(others**2, axis=1)))
    return k, float(away[k, k])


def _plane_residuals(points: Points, left_out: int) -> FloatArray:
    """Distances (n,) px from the homography of all points but one (linear least squares on centred, scaled points)."""
    board, image = (v - v.mean(axis=0) for v in (points.world_mm[:, :2], points.xy_px))
    size = float(np.std(image))
    b, i = np.column_stack([board / np.std(board), np.ones(len(board))]), image / size
    rows = [np.hstack([b, 0 * b, -i[:, :1] * b]), np.hstack([0 * b, b, -i[:, 1:] * b])]
    h = np.linalg.svd(np.concatenate([np.delete(r, left_out, axis=0) for r in rows]))[2][-1].reshape(3, 3)
    x, y, w = h @ b.T
    return np.asarray(size * np.hypot(x / w - i[:, 0], y / w - i[:, 1]))


def _check_uncertainty(fitted: Fit) -> None:
    """Refuse a camera that the points leave open."""
    f_share = float(np.sqrt(fitted.covariance[6, 6])) / fitted.camera.f_mm
    if not f_share <= MAX_F_SIGMA:
        raise BoardRefused(
            f"the focal length is not known well enough (to {100 * f_share:.0f} %, allowed {100 * MAX_F_SIGMA:.0f} %):"
            " let the board fill more of the image, tilt it more, or measure its points better"
        )


# --- Tsai's two stages and the three-parameter optimisation ----------------------------------------------------------


def tsai(points: Points, sensor: SensorConstants) -> Camera:
    """The thesis' calibration: R, Tx, Ty linearly, then f, Tz, kappa1 by least distance in the undistorted plane.

    Raises BoardRefused for a fronto-parallel board, or where the linear equations have no camera.
    """
    sensor_mm = sensor.camera(np.eye(3), np.zeros(3), 1.0, 0.0).sensor(points.xy_px)
    rotation, tx, ty = _stage_one(points.world_mm[:, :2], sensor_mm)
    rotation, f, tz = _stage_two(points.world_mm[:, :2], sensor_mm, rotation, ty)
    camera = sensor.camera(rotation, np.array([tx, ty, tz]), f, 0.0)
    return _optimise_three(points.world_mm, sensor_mm, camera)


def _stage_one(board_mm: FloatArray, sensor_mm: FloatArray) -> tuple[FloatArray, float, float]:
    """Rotation (third column up to its sign), Tx and Ty, from the direction of each point about the image's centre.

    That direction is free of f, Tz and distortion: Xd (r21 x + r22 y + Ty) = Yd (r11 x + r12 y + Tx), linear in the
    five unknowns over Ty (A.20).
    """
    x, y = board_mm.T
    xd, yd = sensor_mm.T
    system = np.column_stack([yd * x, yd * y, yd, -xd * x, -xd * y])
    scale = np.linalg.norm(system, axis=0)
    u, _, rank, _ = np.linalg.lstsq(system / scale, xd, rcond=1e-10)
    if rank < 5:
        raise BoardRefused(
            "Tsai's linear equations have no single solution for these points: the world origin appears on the image's"
            " middle row, or the points are too regular about the image's centre; use the method reprojection"
        )
    u = u / scale
    ty = _ty_size(u)
    far = np.argmax(xd**2 + yd**2)  # the point whose direction is surest decides the sign of Ty
    r11, r12, tx, r21, r22 = u * ty
    if np.sign(r11 * x[far] + r12 * y[far] + tx) != np.sign(xd[far]):
        ty = -ty
    r11, r12, tx, r21, r22 = u * ty
    return _rotation_from_rows(r11, r12, r21, r22), float(tx), float(ty)


def _ty_size(u: FloatArray) -> float:
    """|Ty|, from the first two rows of a rotation being unit and orthogonal (A.25)."""
    sr = u[0] ** 2 + u[1] ** 2 + u[3] ** 2 + u[4] ** 2
    determinant = u[0] * u[4] - u[1] * u[3]
    root = np.sqrt(max(sr**2 - 4 * determinant**2, 0.0))
    return float(np.sqrt(2 / (sr + root)))  # the printed form times its conjugate: exact where the determinant is zero


def _rotation_from_rows(r11: float, r12: float, r21: float, r22: float) -> FloatArray:
    """Rotation (3, 3) from its upper left corner, with r13 >= 0.

    Rows are orthogonal, so r13 and r23 differ in sign where r11 r21 + r12 r22 > 0 (the thesis prints it the wrong way).
    Where that is exactly 0, as for a camera without roll, r13 is 0, and either sign of r23 will do.
    """
    r13 = np.sqrt(max(1 - r11**2 - r12**2, 0.0))
    r23 = np.sqrt(max(1 - r21**2 - r22**2, 0.0))
    if r11 * r21 + r12 * r22 > 0:
        r23 = -r23
    first, second = np.array([r11, r12, r13]), np.array([r21, r22, r23])
    return np.array([first, second, np.cross(first, second)])


def _stage_two(
    board_mm: FloatArray, sensor_mm: FloatArray, rotation: FloatArray, ty: float
) -> tuple[FloatArray, float, float]:
    """Rotation with the right sign, f and Tz without distortion, linearly (A.30); a negative f turns the sign."""
    _check_tilt(float(np.degrees(np.arccos(min(abs(rotation[2, 2]), 1.0)))))
    turned = rotation * np.array([[1, 1, -1], [1, 1, -1], [-1, -1, 1]])
    yd = sensor_mm[:, 1]
    for candidate in (rotation, turned):
        yc = board_mm @ candidate[1, :2] + ty
        right = board_mm @ candidate[2, :2] * yd
        f, tz = np.linalg.lstsq(np.column_stack([yc, -yd]), right, rcond=None)[0]
        if f > 0 and tz > 0:
            return candidate, float(f), float(tz)
    raise BoardRefused("no camera in front of the board explains the points: check their order, signs and units")


def _optimise_three(world_mm: FloatArray, sensor_mm: FloatArray, start: Camera) -> Camera:
    """f, Tz, kappa1 that minimise the summed squared distances in the undistorted sensor plane, the rest held."""
    from scipy.optimize import least_squares

    flat = world_mm @ start.rotation.T + start.translation_mm * [1, 1, 0]
    r2 = np.sum(sensor_mm**2, axis=1, keepdims=True)

    def distances(x: FloatArray) -> FloatArray:
        f, tz, kappa1 = x
        away = sensor_mm * (1 + kappa1 * r2) - f * flat[:, :2] / (flat[:, 2:] + tz)
        return np.asarray(away.ravel())

    x0 = [start.f_mm, start.translation_mm[2], 0.0]
    best = least_squares(distances, x0, x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-14)
    f, tz, kappa1 = best.x
    if not (f > 0 and tz > 0):
        raise BoardRefused("Tsai's optimisation ends behind the camera: check the points and the sensor constants")
    translation = np.array([*start.translation_mm[:2], tz])
    return replace(start, f_mm=float(f), kappa1_per_mm2=float(kappa1), translation_mm=translation)


# --- reprojection ----------------------------------------------------------------------------------------------------


def reprojection(points: Points, sensor: SensorConstants) -> Camera:
    """The eight ``CAMERA_PARAMETERS`` of least squared pixel residuals; image centre and aspect are held.

    Freeing the centre would win 0.03 px on the thesis' board and move it by 31 and 43 px. Starts from Tsai's;
    raises BoardRefused as :func:`tsai` does.
    """
    from scipy.optimize import least_squares

    start = _start(points, sensor)

    def residuals(by: FloatArray) -> FloatArray:
        away = start.perturbed(by).project(points.world_mm) - points.xy_px
        # A trial camera that cannot see a point is as wrong about it as the image is wide.
        return np.where(np.isfinite(away), away, float(sensor.width_px)).ravel()

    best = least_squares(residuals, np.zeros(8), x_scale=_scales(start), xtol=1e-14, ftol=1e-14, gtol=1e-14)
    return start.perturbed(best.x)


def _start(points: Points, sensor: SensorConstants) -> Camera:
    """Tsai's camera, with the world's origin moved to the point furthest from the image's middle row and back.

    Stage one divides by Ty, so an origin on the middle row would spoil it; the moved one cannot be there.
    """
    origin = points.world_mm[np.argmax(np.abs(points.xy_px[:, 1] - sensor.cy_px))]
    camera = tsai(Points(points.world_mm - origin, points.xy_px), sensor)
    return replace(camera, translation_mm=camera.translation_mm - camera.rotation @ origin)


def _scales(camera: Camera) -> FloatArray:
    """Typical sizes (8,) of changes of the CAMERA_PARAMETERS, for steps and differences."""
    distance = float(np.linalg.norm(camera.translation_mm))
    reach_mm = 0.5 * camera.width_px * camera.dx_mm
    return np.array([1.0, 1.0, 1.0, distance, distance, distance, camera.f_mm, reach_mm**-2])


# --- uncertainty -----------------------------------------------------------------------------------------------------


def _noise_px(points: Points, camera: Camera) -> float:
    """Standard deviation of one pixel coordinate, from the residuals of 2 n equations for eight parameters."""
    residuals = points.xy_px - camera.project(points.world_mm)
    return float(np.sqrt(np.sum(residuals**2) / (2 * len(points) - len(CAMERA_PARAMETERS))))


def _least_squares_covariance(points: Points, camera: Camera) -> FloatArray:
    """Covariance (8, 8) for pixel noise of one: (J^T J)^-1, J the pixels' derivatives by the CAMERA_PARAMETERS."""
    scales = _scales(camera)
    steps = 1e-6 * scales
    moved = [
        (camera.perturbed(step).project(points.world_mm) - camera.perturbed(-step).project(points.world_mm)).ravel()
        for step in np.diag(steps)
    ]
    jacobian = np.array(moved).T / 2e-6  # by parameters in units of their scales, so that the inverse is well posed
    normal = jacobian.T @ jacobian
    if not (np.isfinite(normal).all() and np.linalg.cond(normal) < WORST_CONDITION):
        return np.full((len(CAMERA_PARAMETERS), len(CAMERA_PARAMETERS)), np.inf)
    covariance = np.linalg.inv(normal)
    return np.asarray((covariance + covariance.T) / 2 * np.outer(scales, scales))


def _propagated(points: Points, sensor: SensorConstants, camera: Camera) -> FloatArray:
    """Covariance (8, 8) of Tsai's camera for pixel noise of one: G G^T, G its derivatives by each pixel coordinate."""
    step_px = 1e-3
    gain = np.empty((len(CAMERA_PARAMETERS), points.xy_px.size))
    for k in range(points.xy_px.size):
        xy_px = points.xy_px.copy()
        xy_px.flat[k] += step_px
        gain[:, k] = _difference(tsai(Points(points.world_mm, xy_px), sensor), camera) / step_px
    return gain @ gain.T


def _difference(camera: Camera, base: Camera) -> FloatArray:
    """What ``base.perturbed`` needs (8,) to become ``camera``, for small turns."""
    turn = camera.rotation @ base.rotation.T
    w = [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]
    inner = [camera.f_mm - base.f_mm, camera.kappa1_per_mm2 - base.kappa1_per_mm2]
    return np.concatenate([np.array(w) / 2, camera.translation_mm - base.translation_mm, inner])


def angles_deg(rotation: FloatArray) -> tuple[float, float, float]:
    """Rx, Ry, Rz, degrees, of R = Rz Ry Rx (Table 5.3's form)."""
    rz = np.arctan2(rotation[1, 0], rotation[0, 0])
    ry = np.arctan2(-rotation[2, 0], rotation[0, 0] * np.cos(rz) + rotation[1, 0] * np.sin(rz))
    rx = np.arctan2(rotation[2, 1], rotation[2, 2])
    return float(np.degrees(rx)), float(np.degrees(ry)), float(np.degrees(rz))
