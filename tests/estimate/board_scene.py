"""Images of a calibration board, drawn by projecting its squares and averaging 8 x 8 samples a pixel."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from inspector.optics import Camera

SAMPLES = 8
BLACK_DN, WHITE_DN = 6.0, 200.0


@dataclass(frozen=True)
class Scene:
    """A board of ``columns`` x ``rows`` squares, first at (pitch, pitch) mm, and a camera that looks at its middle.

    ``azimuth_deg`` is where on the panel the camera stands, ``roll_deg`` its turn about its own axis.
    """

    columns: int = 6
    rows: int = 5
    pitch_mm: float = 18.8
    square_mm: float = 12.0
    view_angle_deg: float = 50.0
    azimuth_deg: float = 0.0
    roll_deg: float = 0.0
    distance_mm: float = 330.0
    f_mm: float = 6.0
    kappa1_per_mm2: float = 5e-3
    aim_px: tuple[float, float] = (0.0, 0.0)

    @property
    def middle_mm(self) -> npt.NDArray[np.float64]:
        return self.pitch_mm * np.array([self.columns + 1, self.rows + 1, 0]) / 2

    @property
    def world_mm(self) -> npt.NDArray[np.float64]:
        """Centres of the squares, x then y."""
        i, j = np.indices((self.columns, self.rows)).reshape(2, -1) + 1
        return self.pitch_mm * np.column_stack([i, j, 0 * i]).astype(np.float64)

    @property
    def camera(self) -> Camera:
        view, azimuth, roll = np.radians([self.view_angle_deg, self.azimuth_deg, self.roll_deg])
        away = np.array([np.sin(view) * np.cos(azimuth), np.sin(view) * np.sin(azimuth), np.cos(view)])
        right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        upright = np.array([right, np.cross(-away, right), -away])
        turn = np.array([[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]])
        rotation = turn @ upright
        shift = np.array([*self.aim_px, 0.0]) * 0.0075 / self.f_mm * self.distance_mm
        translation = -rotation @ (self.middle_mm + self.distance_mm * away) + shift
        return Camera(
            640, 480, self.f_mm, self.kappa1_per_mm2, 1.0, 320.0, 240.0, 0.0075, 0.0075, rotation, translation
        )


def render(
    scene: Scene, noise_dn: float = 2.0, seed: int = 0, leave_out: tuple[int, ...] = ()
) -> npt.NDArray[np.uint8]:
    """The board as the camera sees it: slightly blurred, lit aslant, with noise."""
    large = np.zeros((480 * SAMPLES, 640 * SAMPLES), np.uint8)
    for n, centre in enumerate(scene.world_mm):
        if n not in leave_out:
            polygon = scene.camera.project(centre + scene.square_mm * outline())
            cv2.fillPoly(large, [np.rint((polygon + 0.5) * SAMPLES - 0.5).astype(np.int32)], 255)
    cover = cv2.resize(large, (640, 480), interpolation=cv2.INTER_AREA).astype(np.float64) / 255
    light = BLACK_DN + (WHITE_DN - BLACK_DN) * cover * np.linspace(0.85, 1.15, 640)
    return expose(light, noise_dn, seed)


def expose(light_dn: npt.NDArray[np.float64], noise_dn: float = 2.0, seed: int = 0) -> npt.NDArray[np.uint8]:
    """Lens blur, noise and rounding."""
    blurred = cv2.GaussianBlur(light_dn, (0, 0), 0.7)
    noisy = blurred + np.random.default_rng(seed).normal(0, noise_dn, blurred.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def outline() -> npt.NDArray[np.float64]:
    """The outline (32, 3) of a square of side one about the origin."""
    corners = np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]])
    return np.concatenate([np.linspace(a, b, 9)[:-1] for a, b in zip(corners, np.roll(corners, -1, 0), strict=True)])


def turned_half(scene: Scene) -> Scene:
    """The same board seen from the other side."""
    return replace(scene, azimuth_deg=scene.azimuth_deg + 180)
