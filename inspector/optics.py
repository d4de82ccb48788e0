"""The camera, the lamp and the paint as a mirror: where a point of the panel appears, and where a pixel looks.

Camera model: R. Y. Tsai, "A versatile camera calibration technique ...", IEEE J. Robotics and Automation RA-3(4),
1987, as the thesis uses it (App. B, B.1-B.19): world -> camera (R, T), perspective, radial distortion of one
coefficient that acts from the *distorted* to the undistorted sensor plane, then pixels.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from firmware_bridge import native
from firmware_bridge.native import out
from inspector.model import FloatArray

_CAMERA = struct.Struct("14d")
_directions = native.function("inspector._optics", "camera_directions", "pipp")


@dataclass(frozen=True)
class Camera:
    """A calibrated camera. ``rotation`` (3, 3) and ``translation_mm`` (3,) carry world points into its frame."""

    width_px: int
    height_px: int
    f_mm: float
    kappa1_per_mm2: float
    sx: float
    cx_px: float
    cy_px: float
    dx_mm: float
    dy_mm: float
    rotation: FloatArray
    translation_mm: FloatArray

    @cached_property
    def centre_mm(self) -> FloatArray:
        """The centre of projection in the world, (3,) mm: C = -R^T T, by solving, since a file's R is rounded."""
        return np.asarray(-np.linalg.solve(self.rotation, self.translation_mm))

    @cached_property
    def _origin_px(self) -> FloatArray:
        return np.array([self.cx_px, self.cy_px])

    @cached_property
    def _pitch_mm(self) -> FloatArray:
        """The sensor's pixel pitch, x (as digitised) and y."""
        return np.array([self.dx_mm / self.sx, self.dy_mm])

    @cached_property
    def packed(self) -> bytes:
        """What the C functions need to know where a pixel looks: `Camera` of `_optics.h`."""
        inverse = np.linalg.inv(self.rotation)
        to_world = [*inverse[:, 0], *inverse[:, 1], *(self.f_mm * inverse[:, 2])]
        return _CAMERA.pack(self.kappa1_per_mm2, *self._origin_px, *self._pitch_mm, *to_world)

    def project(self, points_mm: FloatArray) -> FloatArray:
        """Pixels (n, 2) of world points (n, 3) mm. NaN behind the camera or beyond the distortion's reach."""
        c = points_mm @ self.rotation.T + self.translation_mm
        with np.errstate(divide="ignore", invalid="ignore"):
            undistorted = self.f_mm * c[:, :2] / np.where(c[:, 2:] > 0, c[:, 2:], np.nan)
        return self.pixels(self.distort(undistorted))

    def pixels(self, sensor_mm: FloatArray) -> FloatArray:
        """Pixels (n, 2) of distorted sensor coordinates (n, 2) mm (B.16, B.17)."""
        return sensor_mm / self._pitch_mm + self._origin_px

    def sensor(self, xy_px: FloatArray) -> FloatArray:
        """Distorted sensor coordinates (n, 2) mm of pixels (n, 2)."""
        return (xy_px - self._origin_px) * self._pitch_mm

    def undistort(self, distorted_mm: FloatArray) -> FloatArray:
        """Undistorted sensor coordinates: Xu = Xd (1 + kappa1 r_d^2)."""
        r2 = (distorted_mm * distorted_mm).sum(axis=1, keepdims=True)
        return np.asarray(distorted_mm * (1 + self.kappa1_per_mm2 * r2))

    def distort(self, undistorted_mm: FloatArray) -> FloatArray:
        """The inverse of :meth:`undistort`: Newton on r_d (1 + kappa1 r_d^2) = r_u. NaN where there is none."""
        k = self.kappa1_per_mm2
        if k == 0:
            return undistorted_mm
        ru = np.linalg.norm(undistorted_mm, axis=1, keepdims=True)
        # Start above the root where kappa1 > 0 (f is convex there), at r_u where it is not: Newton is then monotone.
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            rd = np.minimum(ru, np.cbrt(ru / k)) if k > 0 else ru
            for _ in range(20):
                step = (rd * (1 + k * rd * rd) - ru) / (1 + 3 * k * rd * rd)
                rd = rd - step
                if not np.nanmax(np.abs(step), initial=0.0) > 1e-15:
                    break
            bad = (1 + 3 * k * rd * rd <= 0) | ~(np.abs(rd * (1 + k * rd * rd) - ru) <= 1e-9 * (1 + ru))
            return np.where(bad, np.nan, undistorted_mm * np.where(ru > 0, rd / ru, 1.0))

    def rays(self, xy_px: FloatArray) -> FloatArray:
        """Directions (n, 3) in the world, not normalised, from the centre through pixels (n, 2)."""
        directions = np.empty((len(xy_px), 3))
        _directions(self.packed, len(xy_px), np.asarray(xy_px, np.float64).tobytes(), out(directions))
        return directions

    def back_project(self, xy_px: FloatArray, z_mm: float = 0.0) -> FloatArray:
        """Panel coordinates (n, 2) mm of pixels (n, 2), on the plane z = ``z_mm``; NaN if the ray never meets it."""
        ray = self.rays(xy_px)
        with np.errstate(divide="ignore", invalid="ignore"):
            along = (z_mm - self.centre_mm[2]) / ray[:, 2]
            along = np.where(along > 0, along, np.nan)
        return self.centre_mm[:2] + along[:, None] * ray[:, :2]

    def outline_mm(self, points_a_side: int = 16, share: float = 1.0) -> FloatArray:
        """The frame's outline carried to the panel, (4 points_a_side, 2) mm; NaN where it does not meet the panel.

        ``share``: of a frame so much smaller about the same middle.
        """
        middle = np.array([self.width_px - 1, self.height_px - 1]) / 2
        half = share * np.array([self.width_px, self.height_px]) / 2
        corners = middle + half * [[-1, -1], [1, -1], [1, 1], [-1, 1]]
        sides = zip(corners, np.roll(corners, -1, 0), strict=True)
        return self.back_project(np.concatenate([np.linspace(a, b, points_a_side + 1)[:-1] for a, b in sides]))

    @property
    def view_angle_deg(self) -> float:
        """The angle between the optical axis and the panel's normal, degrees: 0 looks straight down."""
        return float(np.degrees(np.arccos(np.clip(-self.rotation[2, 2], -1.0, 1.0))))

    def perturbed(self, by: FloatArray) -> Camera:
        """This camera with ``by`` (8,) added to its :data:`~inspector.model.CAMERA_PARAMETERS`.

        The rotation's three are a rotation vector w (radians, about the camera's own axes) that is zero at this
        camera: R' = exp([w]x) R, and T' = T + dT, not turned.
        """
        return replace(
            self,
            rotation=_rotation(by[:3]) @ self.rotation,
            translation_mm=self.translation_mm + by[3:6],
            f_mm=self.f_mm + float(by[6]),
            kappa1_per_mm2=self.kappa1_per_mm2 + float(by[7]),
        )


def _rotation(vector_rad: FloatArray) -> FloatArray:
    """exp([w]x), (3, 3), of a rotation vector (3,) (Rodrigues' formula, exact down to zero)."""
    x, y, z = vector_rad
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    angle = float(np.linalg.norm(vector_rad))
    half = np.sinc(angle / (2 * np.pi))
    return np.asarray(np.eye(3) + np.sinc(angle / np.pi) * cross + 0.5 * half * half * (cross @ cross))


@dataclass(frozen=True)
class Light:
    """The lamp: far away in a ``direction`` (unit, panel to lamp), or near, at ``position_mm``; one of them is None."""

    direction: FloatArray | None
    position_mm: FloatArray | None = None
    angular_sigma_deg: float | None = None

    def toward(self, points_mm: FloatArray) -> FloatArray:
        """Unit vectors (..., 3) from world points (..., 3) mm towards the lamp."""
        if self.position_mm is None:
            assert self.direction is not None
            return np.broadcast_to(self.direction, points_mm.shape)
        away = self.position_mm - points_mm
        return np.asarray(away / np.linalg.norm(away, axis=-1, keepdims=True))


@dataclass(frozen=True)
class Sensor:
    """Grey value = black + (saturation - black) * light ** gamma. ``black_dn`` None: estimated from the frame."""

    gamma: float = 1.0
    black_dn: float | None = None
    saturation_dn: float = 255.0


@dataclass(frozen=True, eq=False)
class Calibration:
    """One station's geometry: all that turns two pixels into a height. Two are the same only if they are one object.

    ``view_angle_deg`` is the nominal beta that only the thesis' method uses; ``height_gain`` multiplies heights
    (fitted from measured samples); ``covariance`` is the camera parameters' own (p, p) with ``covariance_of`` naming
    its p rows, some or all of CAMERA_PARAMETERS; None when the calibration was not fitted here.
    """

    camera: Camera
    light: Light
    view_angle_deg: float
    sensor: Sensor = Sensor()
    height_gain: float = 1.0
    covariance: FloatArray | None = None
    covariance_of: tuple[str, ...] = ()

    @cached_property
    def lamp_angle_deg(self) -> float:
        """The nominal alpha: the lamp's direction from the panel's normal, degrees, where the optical axis meets it."""
        axis_px = np.array([[self.camera.cx_px, self.camera.cy_px]])
        foot = np.append(self.camera.back_project(axis_px)[0], 0.0)
        return float(np.degrees(np.arccos(self.light.toward(foot[None])[0, 2])))
