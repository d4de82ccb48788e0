"""A seed and its two highlights: where they appear (forward), and the seed that explains two pixels (inverse).

A seed is a sphere of radius R with its centre S = (X, Y, c) over the panel z = 0, c = R where it rests on it. Light L
(unit, to the lamp) reaches the camera C from the surface point whose normal bisects the two directions: the direct
spot at P = S + R n, n = unit(L + unit(C - P)). The mirror spot is the same for the camera C* mirrored in the paint.

Inverse: a pixel gives its viewing ray, and with it unit(C - P) exactly: n is known before the seed is. What is left,
that S + R n lies on the ray, is linear in (X, Y, R): two equations for each pixel, four for three unknowns. Weighted
with the pixels' covariance they are solved in one step; the spare equation tells a true pair from a chance one. The
inverse is in `_reflection.c`.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from firmware_bridge import native
from firmware_bridge.native import out
from inspector.model import FloatArray, IntArray
from inspector.optics import Calibration, Camera, Light

MIRROR = np.array([1.0, 1.0, -1.0])
MOST_ROUNDS, SETTLED_MM = 200, 1e-12
"""Fixed-point rounds of the forward model: each wins three digits, fewer where the lamp glares into the camera."""
STEP_PX = 0.1
"""Step of the rays' forward differences."""
RAY, _SEED = 9, 22
"""Doubles in a `Ray` and a `Seed` of `_reflection.h`."""
_SCENE = struct.Struct("6dq")
_rays = native.function("inspector._reflection", "reflection_rays", "pipdp")
_directions = native.function("inspector._reflection", "reflection_directions", "pipp")
_seeds = native.function("inspector._reflection", "reflection_seeds", "pippppp")


def unit(v: FloatArray) -> FloatArray:
    """Vectors (..., 3) scaled to length one."""
    return np.asarray(v / np.sqrt((v * v).sum(axis=-1, keepdims=True)))


def highlights(seeds: FloatArray, calibration: Calibration) -> tuple[FloatArray, FloatArray]:
    """Pixels (n, 2) of the direct and the mirror spots of seeds (n, 4): X, Y, R, c in mm. NaN where out of view."""
    camera, light = calibration.camera, calibration.light
    centre = seeds[:, (0, 1, 3)]
    eye = camera.centre_mm
    direct = surface_point(centre, seeds[:, 2], light, eye)
    mirror = surface_point(centre, seeds[:, 2], light, eye * MIRROR)
    return camera.project(direct), camera.project(mirror * MIRROR)


def surface_point(centre: FloatArray, radius: FloatArray, light: Light, eye: FloatArray) -> FloatArray:
    """The point (n, 3) of each sphere whose normal bisects lamp and eye."""
    point = centre
    for _ in range(MOST_ROUNDS):
        before, point = point, centre + radius[:, None] * unit(light.toward(point) + unit(eye - point))
        if not np.any(np.abs(point - before) > SETTLED_MM):
            break
    return point


def rays(camera: Camera, xy_px: FloatArray) -> FloatArray:
    """Viewing rays (n, 9) of pixels (n, 2): unit direction (3), and (2 x 3) what turns mm at unit distance into pixels.

    The latter is the pseudo-inverse of the direction's derivative by the pixel (forward differences).
    """
    found = np.empty((len(xy_px), RAY))
    _rays(camera.packed, len(xy_px), np.asarray(xy_px, np.float64).tobytes(), STEP_PX, out(found))
    return found


@lru_cache(maxsize=4)
def scene(calibration: Calibration) -> bytes:
    """Camera centre and lamp as the C functions take them: `Scene` of `_reflection.h`. Kept for the latest few."""
    light = calibration.light
    lamp = light.direction if light.position_mm is None else light.position_mm
    assert lamp is not None
    return _SCENE.pack(*calibration.camera.centre_mm, *lamp, light.position_mm is not None)


def directions(found: FloatArray, calibration: Calibration) -> FloatArray:
    """Pixels (n, 2) from direct to mirror spot of a small seed at each ray's foot, per mm of radius.

    ``found`` (n, 9) are :func:`rays`. In the limit of small R both rays go to the foot F: P = F + R (z + n), and the
    mirrored P* = F - R (z + n* mirrored). NaN where a ray does not meet the panel.
    """
    toward = np.empty((len(found), 2))
    _directions(scene(calibration), len(found), found.tobytes(), out(toward))
    return toward


@dataclass(frozen=True)
class Seeds:
    """Seeds that explain n pairs of pixels best.

    ``x_mm``, ``y_mm``, ``radius_mm`` (n,); ``covariance`` (n, 3, 3) of the three; ``chi2`` (n,) of the one spare
    equation; ``sunk_share`` (n,) the share of its height that a seed sunk to half its radius is read low by.
    """

    x_mm: FloatArray
    y_mm: FloatArray
    radius_mm: FloatArray
    covariance: FloatArray
    chi2: FloatArray
    sunk_share: FloatArray


def solve(
    found: FloatArray, covariance_px2: FloatArray, direct: IntArray, mirror: IntArray, calibration: Calibration
) -> Seeds:
    """The resting seeds that explain n pairs of pixels; infinite or NaN where none does.

    ``found``: the pixels' :func:`rays` (m, 9), ``covariance_px2`` (m, 2, 2) theirs; ``direct`` and ``mirror`` (n,)
    index both.
    """
    n = len(direct)
    seeds = np.empty((n, _SEED))
    _seeds(
        scene(calibration), n, direct.tobytes(), mirror.tobytes(), found.tobytes(), covariance_px2.tobytes(), out(seeds)
    )
    return Seeds(seeds[:, 0], seeds[:, 1], seeds[:, 2], seeds[:, 3:12].reshape(n, 3, 3), seeds[:, 12], seeds[:, 21])
