"""Stations of any geometry, and seeds in their view, for tests that must hold for every camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from hypothesis import strategies as st

from inspector import reflection
from inspector.model import FloatArray
from inspector.optics import Calibration, Camera, Light

GLARE_COSINE = np.cos(np.radians(25.0))
"""Half of the field is 17 degrees at the most: nothing in it is nearer than 8 to the glare."""

LARGEST_RADIUS_MM = 4.0
"""The thesis' largest seed has 3.75 mm."""


@dataclass(frozen=True)
class View:
    """A camera that looks at the world's origin, and a lamp; angles from the panel's normal, azimuths from x to y.

    ``lamp_mm`` None: a lamp far away. ``mirrored``: the image is turned left to right, as some sensors are read.
    """

    view_angle_deg: float = 65.0
    azimuth_deg: float = 0.0
    roll_deg: float = 0.0
    distance_mm: float = 267.0
    f_mm: float = 8.0
    kappa1_per_mm2: float = 8e-3
    alpha_deg: float = 30.0
    lamp_azimuth_deg: float = 180.0
    lamp_mm: float | None = None
    mirrored: bool = False

    @property
    def glares(self) -> bool:
        """Whether the paint mirrors the lamp towards the camera: the mirror spots are then not defined."""
        mirrored_lamp = _toward(self.alpha_deg, self.azimuth_deg + self.lamp_azimuth_deg + 180)
        return float(mirrored_lamp @ _toward(self.view_angle_deg, self.azimuth_deg)) > GLARE_COSINE

    @property
    def calibration(self) -> Calibration:
        toward_lamp = _toward(self.alpha_deg, self.azimuth_deg + self.lamp_azimuth_deg)
        light = Light(toward_lamp) if self.lamp_mm is None else Light(None, self.lamp_mm * toward_lamp)
        return Calibration(self._camera(), light, self.view_angle_deg)

    def _camera(self) -> Camera:
        back, azimuth, roll = (
            _toward(self.view_angle_deg, self.azimuth_deg),
            *np.radians([self.azimuth_deg, self.roll_deg]),
        )
        right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        turn = np.array([[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]])
        turn[0] *= -1 if self.mirrored else 1
        rotation = turn @ np.array([right, np.cross(-back, right), -back])
        translation = np.array([0.0, 0.0, self.distance_mm])
        return Camera(
            640, 480, self.f_mm, self.kappa1_per_mm2, 1.0, 320.0, 240.0, 0.0075, 0.0075, rotation, translation
        )


def _toward(angle_deg: float, azimuth_deg: float) -> FloatArray:
    angle, azimuth = np.radians([angle_deg, azimuth_deg])
    return np.array([np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), np.cos(angle)])


views = st.builds(
    View,
    view_angle_deg=st.floats(25, 72),
    azimuth_deg=st.floats(-180, 180),
    roll_deg=st.floats(-180, 180),
    distance_mm=st.floats(150, 600),
    f_mm=st.floats(8, 35),
    kappa1_per_mm2=st.floats(-8e-3, 1e-2),
    alpha_deg=st.floats(15, 60),
    lamp_azimuth_deg=st.floats(100, 260),
    lamp_mm=st.none() | st.floats(250, 800),
    mirrored=st.booleans(),
).filter(lambda view: not view.glares)
"""Cameras and lamps as they stand in practice, lamp roughly opposite the camera, any roll and handedness."""


def seeds_at(
    xy_px: FloatArray, spacing_px: FloatArray | float, calibration: Calibration, sunk: FloatArray | float = 1.0
) -> FloatArray:
    """Seeds (n, 4) with feet at pixels (n, 2), spots about ``spacing_px`` apart or less, and centres at ``sunk`` R."""
    foot = calibration.camera.back_project(xy_px)
    small = np.full(len(foot), 1e-3)
    direct, mirror = reflection.highlights(np.column_stack([foot, small, small]), calibration)
    per_mm = np.hypot(*(mirror - direct).T) / small
    radius = np.minimum(spacing_px / per_mm, LARGEST_RADIUS_MM)
    return np.column_stack([foot, radius, sunk * radius])


def spread_px(n: int, rng: np.random.Generator, margin_px: float = 60.0) -> FloatArray:
    """Pixels (n, 2) anywhere in the frame but its margin."""
    return rng.uniform([margin_px, margin_px], [640 - margin_px, 480 - margin_px], (n, 2))
