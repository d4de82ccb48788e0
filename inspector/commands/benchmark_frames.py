"""Frames to measure speed on: seeds on a dark, noisy panel, as a station of any resolution sees them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from inspector import reflection
from inspector.model import FloatArray, Frame, Image
from inspector.optics import Calibration, Camera, Light
from inspector.pipeline import Station
from inspector.recipe import Limits, Recipe

SIZES = {"640x480": (640, 480), "5 MP": (2448, 2048), "12 MP": (4096, 3000)}
CROWDS = {"sparse": 4, "crowded": 100}
"""How many seeds a frame shows."""
VIEW_DEG, LAMP_DEG, DISTANCE_MM, FOCAL_MM, SENSOR_WIDTH_MM = 65.0, 30.0, 267.0, 8.0, 4.8
"""One camera at every resolution: the same view of the panel on finer pixels."""
SPACING_PX = (16.0, 24.0)
"""From a seed's direct to its mirror spot."""
BLUR_PX, PANEL_DN, NOISE_DN = 0.8, 12.0, 1.5
DIRECT_DN, MIRROR_DN = 450.0, 180.0
"""Peaks before the sensor clips them: the direct spot is over-exposed, as it is in nearly every real frame."""


@dataclass(frozen=True)
class Case:
    """One frame to measure on, and the station that sees it."""

    size: str
    crowd: str
    frame: Frame
    station: Station

    @property
    def seeds(self) -> int:
        """How many seeds the frame shows."""
        return CROWDS[self.crowd]


def draw(size: str, crowd: str) -> Case:
    """The frame of a size and crowd, the same at every call."""
    random = np.random.default_rng(1)
    width, height = SIZES[size]
    calibration = Calibration(_camera(width, height), Light(_toward(LAMP_DEG, np.pi)), VIEW_DEG)
    spots = reflection.highlights(_seeds(CROWDS[crowd], calibration, random), calibration)
    noise = random.standard_normal((height, width), np.float32)
    image = noise * np.float32(NOISE_DN) + np.float32(PANEL_DN)
    for places, peak_dn in zip(spots, (DIRECT_DN, MIRROR_DN), strict=True):
        for x, y in places:
            _add_spot(image, x, y, peak_dn)
    grey: Image = np.clip(np.rint(image), 0, 255).astype(np.uint8)
    recipe = Recipe(limits=Limits(max_count=1000))
    return Case(size, crowd, Frame(grey, f"{size} {crowd}"), Station(calibration, recipe))


def _toward(angle_deg: float, azimuth_rad: float) -> FloatArray:
    angle = np.radians(angle_deg)
    return np.array([np.sin(angle) * np.cos(azimuth_rad), np.sin(angle) * np.sin(azimuth_rad), np.cos(angle)])


def _camera(width_px: int, height_px: int) -> Camera:
    back, right = _toward(VIEW_DEG, 0.0), np.array([0.0, 1.0, 0.0])
    rotation = np.array([right, np.cross(-back, right), -back])
    pitch_mm = SENSOR_WIDTH_MM / width_px
    middle = ((width_px - 1) / 2, (height_px - 1) / 2)
    distance = np.array([0.0, 0.0, DISTANCE_MM])
    return Camera(width_px, height_px, FOCAL_MM, 0.0, 1.0, *middle, pitch_mm, pitch_mm, rotation, distance)


def _seeds(count: int, calibration: Calibration, random: np.random.Generator) -> FloatArray:
    """Seeds (count, 4) with feet in the cells of a square grid over the frame, anywhere in the middle of each."""
    side = int(np.ceil(np.sqrt(count)))
    cells = np.array([(c, r) for r in range(side) for c in range(side)][:count], np.float64)
    size = np.array([calibration.camera.width_px, calibration.camera.height_px]) / side
    feet = calibration.camera.back_project((cells + random.uniform(0.4, 0.6, (count, 2))) * size)
    small = np.full((count, 2), 1e-3)
    direct, mirror = reflection.highlights(np.hstack([feet, small]), calibration)
    px_per_mm = np.hypot(*(mirror - direct).T) / small[:, 0]
    radius = random.uniform(*SPACING_PX, count) / px_per_mm
    return np.column_stack([feet, radius, radius])


def _add_spot(image: npt.NDArray[np.float32], x: float, y: float, peak_dn: float) -> None:
    reach = int(np.ceil(6 * BLUR_PX))
    rows, columns = np.arange(round(y) - reach, round(y) + reach + 1), np.arange(round(x) - reach, round(x) + reach + 1)
    profile = np.exp(-((rows - y) ** 2)[:, None] / (2 * BLUR_PX**2) - (columns - x) ** 2 / (2 * BLUR_PX**2))
    image[np.ix_(rows, columns)] += (peak_dn * profile).astype(np.float32)
