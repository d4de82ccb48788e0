"""What a scene holds: the camera, the lamp, the paint, what lies on it, the lens and the sensor; and the mirror points.

World frame: the panel is z = 0, z points out of the paint, millimetres.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from inspector.model import FloatArray
from inspector.optics import Camera

THESIS_CAMERA = Camera(
    width_px=640,
    height_px=480,
    f_mm=7.972616,
    kappa1_per_mm2=0.008464034,
    sx=1.0,
    cx_px=320.0,
    cy_px=240.0,
    dx_mm=0.0075,
    dy_mm=0.0075,
    rotation=np.array(
        [[0.427326, 0.00879, -0.904055], [-0.014612, -0.999755, -0.016627], [-0.90398, 0.020315, -0.427092]]
    ),
    translation_mm=np.array([-31.566435, 51.851543, 331.419589]),
)
"""The thesis' calibrated camera, Table 5.3."""


@dataclass(frozen=True)
class Lamp:
    """A lamp of Gaussian radiance (W/m2/sr) over the angle from its middle, nothing beyond ``cutoff_deg``.

    Far away in a unit ``direction`` (panel to lamp), or at ``position_mm``, where the angles are those seen from the
    world point ``seen_from_mm``; the direction is then the one from there.
    """

    direction: FloatArray
    position_mm: FloatArray | None = None
    seen_from_mm: FloatArray = field(default_factory=lambda: np.zeros(3))
    sigma_deg: float = 1.75
    cutoff_deg: float = 6.0
    radiance: float = 18.4

    @staticmethod
    def at(position_mm: FloatArray, seen_from_mm: FloatArray, sigma_deg: float = 1.75) -> Lamp:
        """A lamp at a finite distance."""
        away = position_mm - seen_from_mm
        return Lamp(away / np.linalg.norm(away), position_mm, seen_from_mm, sigma_deg)

    def toward(self, points_mm: FloatArray) -> FloatArray:
        """Unit vectors (n, 3) from world points (n, 3) mm to the lamp's middle."""
        if self.position_mm is None:
            return np.broadcast_to(self.direction, points_mm.shape)
        return unit(self.position_mm - points_mm)

    def off_axis_rad(self, points_mm: FloatArray, directions: FloatArray) -> FloatArray:
        """How far rays (n, 3) from points (n, 3) mm miss the lamp's middle, (n,) radians at the nominal place."""
        toward = self.toward(points_mm)
        chord = np.linalg.norm(directions - toward, axis=1)
        return np.asarray(2 * np.arcsin(np.minimum(chord / 2, 1.0)) * self._closeness(points_mm))

    def seen(self, off_axis_rad: FloatArray) -> FloatArray:
        """Radiance (n,) in rays that miss the lamp's middle by ``off_axis_rad`` (n,)."""
        profile = np.exp(-0.5 * (off_axis_rad / np.radians(self.sigma_deg)) ** 2)
        return np.asarray(self.radiance * np.where(off_axis_rad <= np.radians(self.cutoff_deg), profile, 0.0))

    def irradiance(self, points_mm: FloatArray) -> FloatArray:
        """On a surface that faces the lamp, (n,): the radiance over the Gaussian's solid angle."""
        return np.asarray(2 * np.pi * np.radians(self.sigma_deg) ** 2 * self.radiance / self._closeness(points_mm) ** 2)

    def _closeness(self, points_mm: FloatArray) -> FloatArray:
        """Distance of points (n, 3) to the lamp over the nominal distance; 1 for a lamp far away."""
        if self.position_mm is None:
            return np.ones(len(points_mm))
        nominal = np.linalg.norm(self.position_mm - self.seen_from_mm)
        return np.asarray(np.linalg.norm(self.position_mm - points_mm, axis=1) / nominal)


@dataclass(frozen=True)
class Seed:
    """A glossy sphere on the panel, its centre at height ``centre_z_mm`` (the radius, or less when it is sunk).

    ``fillet_mm``: the radius of a paint pool's concave profile, an arc tangent to both the sphere and the panel.
    """

    x_mm: float
    y_mm: float
    radius_mm: float
    centre_z_mm: float
    fillet_mm: float | None = None

    @property
    def centre_mm(self) -> FloatArray:
        """The sphere's centre, (3,) mm."""
        return np.array([self.x_mm, self.y_mm, self.centre_z_mm])

    @property
    def height_mm(self) -> float:
        """How far the seed stands out of the paint."""
        return self.centre_z_mm + self.radius_mm

    @property
    def kind(self) -> str:
        """The word for it in a truth file."""
        if self.fillet_mm is not None:
            return "seed_with_pool"
        return "seed" if self.centre_z_mm == self.radius_mm else "submerged_seed"

    @property
    def pool_radius_mm(self) -> float:
        """Where the pool's profile meets the panel, from the seed's axis; 0 without a pool."""
        if self.fillet_mm is None:
            return 0.0
        rise = self.centre_z_mm - self.fillet_mm
        return float(np.sqrt((self.radius_mm + self.fillet_mm) ** 2 - rise**2))

    @property
    def pool_top_mm(self) -> float:
        """The height at which the pool's profile meets the sphere; 0 without a pool."""
        if self.fillet_mm is None:
            return 0.0
        share = self.radius_mm / (self.radius_mm + self.fillet_mm)
        return self.centre_z_mm + share * (self.fillet_mm - self.centre_z_mm)


@dataclass(frozen=True)
class Dust:
    """A matt white speck: a ball lying on the paint, or a flake flat on it."""

    kind: Literal["ball", "flake"]
    x_mm: float
    y_mm: float
    radius_mm: float


@dataclass(frozen=True)
class Paint:
    """``spec``: what a mirror-like coat reflects head on (Fresnel at other angles); ``diffuse``: the base's albedo."""

    spec: float = 0.05
    diffuse: float = 0.002


@dataclass(frozen=True)
class Lens:
    """``psf_sigma_px``: the blur; ``halo``: the share of light in a wider Gaussian of ``halo_sigma_px``."""

    f_number: float = 8.0
    psf_sigma_px: float = 0.7
    halo: float = 0.02
    halo_sigma_px: float = 4.0


@dataclass(frozen=True)
class Sensor:
    """grey = offset + (top - offset) (E / e_saturation) ** gamma, clipped; E = pi / 4 / N^2 cos^4 L ``exposure``.

    ``hot`` pixels are (x, y, DN above the offset at 8 bits); ``bloom`` is the share of charge above the full well that
    spills along the column instead of being drained; ``seed`` starts every random number of the frame.
    """

    exposure: float = 0.02
    e_saturation: float = 1e-6
    gamma: float = 1.0
    full_well_e: float = 15000.0
    read_noise_e: float = 80.0
    offset_dn: float = 5.0
    prnu: float = 0.006
    bloom: float = 0.0
    hot: tuple[tuple[int, int, float], ...] = ()
    bits: int = 8
    seed: int = 0


@dataclass(frozen=True)
class Scene:
    """All that decides a frame, to the last bit."""

    camera: Camera
    lamp: Lamp
    seeds: tuple[Seed, ...] = ()
    dust: tuple[Dust, ...] = ()
    paint: Paint = Paint()
    lens: Lens = Lens()
    sensor: Sensor = Sensor()

    def exposed(self, exposure: float) -> Scene:
        """The same scene at another exposure."""
        return replace(self, sensor=replace(self.sensor, exposure=exposure))


def unit(vectors: FloatArray) -> FloatArray:
    """Vectors (..., 3) brought to length one."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def mirrored(points: FloatArray) -> FloatArray:
    """Points (..., 3) as the paint mirrors them."""
    return points * [1.0, 1.0, -1.0]


def sphere_glint_mm(seed: Seed, lamp: Lamp, eye_mm: FloatArray) -> FloatArray:
    """The point (3,) of a seed's sphere whose normal bisects the lamp and an eye (3,): a spot's place in the world."""
    return _glint(lamp, eye_mm, seed.centre_mm, lambda n: seed.centre_mm + seed.radius_mm * n)


def pool_glint_mm(seed: Seed, lamp: Lamp, eye_mm: FloatArray) -> FloatArray | None:
    """The same on a seed's paint pool; None where the profile is not tilted enough to hold such a point."""
    if seed.fillet_mm is None:
        return None
    fillet = seed.fillet_mm
    axis = np.array([seed.x_mm, seed.y_mm, fillet])

    def surface(normal: FloatArray) -> FloatArray:
        outward = unit(normal * [1.0, 1.0, 0.0])
        return np.asarray(axis + seed.pool_radius_mm * outward - fillet * normal)

    point = _glint(lamp, eye_mm, seed.centre_mm, surface)
    return point if 0 <= point[2] <= seed.pool_top_mm else None


def _glint(
    lamp: Lamp, eye_mm: FloatArray, start_mm: FloatArray, surface: Callable[[FloatArray], FloatArray]
) -> FloatArray:
    point = start_mm
    for _ in range(60):
        point = surface(unit(lamp.toward(point[None])[0] + unit(eye_mm - point)))
    return point
