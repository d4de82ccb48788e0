"""A seed and its two highlights: where they appear (forward), and the seed that explains two pixels (inverse).

A seed is a sphere of radius R with its centre S = (X, Y, c) over the panel z = 0, c = R where it rests on it. Light L
(unit, to the lamp) reaches the camera C from the surface point whose normal bisects the two directions: the direct
spot at P = S + R n, n = unit(L + unit(C - P)). The mirror spot is the same for the camera C* mirrored in the paint.

Inverse: a pixel gives its viewing ray, and with it unit(C - P) exactly: n is known before the seed is. What is left,
that S + R n lies on the ray, is linear in (X, Y, R): two equations for each pixel, four for three unknowns. Weighted
with the pixels' covariance they are solved in one step; the spare equation tells a true pair from a chance one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from inspector.model import FloatArray, IntArray
from inspector.optics import Calibration, Camera, Light

MIRROR = np.array([1.0, 1.0, -1.0])
UP = np.array([0.0, 0.0, 1.0])
LAMP_ROUNDS = 6
"""A lamp at a finite distance is seen from the spot, which moves with the seed: each round wins two digits."""
NORMAL_ROUNDS = 8
"""Fixed-point rounds of the forward model; each wins three digits."""


def unit(v: FloatArray) -> FloatArray:
    """Vectors (..., 3) scaled to length one."""
    return np.asarray(v / np.sqrt((v * v).sum(axis=-1, keepdims=True)))


def highlights(seeds: FloatArray, calibration: Calibration) -> tuple[FloatArray, FloatArray]:
    """Pixels (n, 2) of the direct and the mirror spots of seeds (n, 4): X, Y, R, c in mm. NaN where out of view."""
    camera, light = calibration.camera, calibration.light
    centre = seeds[:, (0, 1, 3)]
    eye = camera.centre_mm
    direct = _surface_point(centre, seeds[:, 2], light, eye)
    mirror = _surface_point(centre, seeds[:, 2], light, eye * MIRROR)
    return camera.project(direct), camera.project(mirror * MIRROR)


def _surface_point(centre: FloatArray, radius: FloatArray, light: Light, eye: FloatArray) -> FloatArray:
    """The point (n, 3) of each sphere whose normal bisects lamp and eye."""
    point = centre
    for _ in range(NORMAL_ROUNDS):
        point = centre + radius[:, None] * unit(light.toward(point) + unit(eye - point))
    return point


@dataclass(frozen=True)
class Rays:
    """Viewing rays of n pixels: ``along`` (n, 3) unit; ``across`` (n, 2, 3) turns mm at unit distance into pixels."""

    along: FloatArray
    across: FloatArray

    def take(self, index: IntArray) -> Rays:
        """The rays of some of the pixels."""
        return Rays(self.along[index], self.across[index])


def rays(camera: Camera, xy_px: FloatArray) -> Rays:
    """Rays of pixels (n, 2), with the pseudo-inverse of their derivative by the pixel (forward differences)."""
    n, step = len(xy_px), 0.1
    moved = np.concatenate([xy_px, xy_px + (step, 0), xy_px + (0, step)])
    d = unit(camera.rays(moved)).reshape(3, n, 3)
    jacobian = ((d[1:] - d[0]) / step).transpose(1, 0, 2)
    jacobian -= (jacobian * d[0][:, None]).sum(axis=2, keepdims=True) * d[0][:, None]  # a ray says nothing along itself
    return Rays(d[0], _inverse_2x2(jacobian @ jacobian.transpose(0, 2, 1)) @ jacobian)


def directions(found: Rays, calibration: Calibration) -> FloatArray:
    """Pixels (n, 2) from direct to mirror spot of a small seed at each ray's foot, per mm of radius.

    In the limit of small R both rays go to the foot F: P = F + R (z + n), and the mirrored P* = F - R (z + n* mirrored).
    NaN where a ray does not meet the panel.
    """
    eye = calibration.camera.centre_mm
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = np.where(found.along[:, 2] < 0, -eye[2] / found.along[:, 2], np.nan)
    foot = eye + reach[:, None] * found.along
    lamp = calibration.light.toward(foot)
    direct = unit(lamp - found.along) + UP
    mirror = (unit(lamp + unit(eye * MIRROR - foot)) + UP) * MIRROR
    return (found.across @ (mirror - direct)[:, :, None])[:, :, 0] / reach[:, None]


@dataclass(frozen=True)
class Seeds:
    """Seeds that explain n pairs of pixels best.

    ``x_mm``, ``y_mm``, ``radius_mm`` (n,); ``covariance`` (n, 3, 3) of the three; ``chi2`` (n,) of the one spare
    equation; ``direct_normal`` and ``mirror_normal`` (n, 3) of the surface at the spots.
    """

    x_mm: FloatArray
    y_mm: FloatArray
    radius_mm: FloatArray
    covariance: FloatArray
    chi2: FloatArray
    direct_normal: FloatArray
    mirror_normal: FloatArray


def solve(direct: Rays, mirror: Rays, direct_cov: FloatArray, mirror_cov: FloatArray, calibration: Calibration) -> Seeds:
    """The resting seeds that explain n pairs: rays of both spots and the covariance (n, 2, 2) px^2 of their pixels."""
    eye, light = calibration.camera.centre_mm, calibration.light
    eyes = np.stack([eye, eye * MIRROR])[:, None, :]
    along = np.stack([direct.along, mirror.along * MIRROR])
    across = np.stack([direct.across, mirror.across * MIRROR])
    weight = _inverse_2x2(np.stack([direct_cov, mirror_cov]))
    # mm at the spot become pixels by its distance; where the ray meets the panel is near enough, and sets weights only.
    reach = np.maximum(np.abs(eyes[..., 2]) / np.maximum(np.abs(along[..., 2]), 1e-9), 1e-3)
    across = across / reach[..., None, None]
    seen = (across @ eyes[..., None])[..., 0]
    for _ in range(LAMP_ROUNDS if light.position_mm is not None else 1):
        spot = eyes + reach[..., None] * along
        normal = unit(light.toward(spot) - along)
        rows = np.concatenate([across[..., :2], across @ (normal + UP)[..., None]], axis=-1)
        weighted = rows.swapaxes(-1, -2) @ weight
        covariance = _inverse_3x3((weighted @ rows).sum(axis=0))
        theta = (covariance @ (weighted @ seen[..., None]).sum(axis=0))[..., 0]
        reach = (((theta + theta[:, 2:] * normal - eyes) * along)).sum(axis=-1)
    residual = (rows @ theta[..., None])[..., 0] - seen
    chi2 = ((residual[..., None, :] @ weight)[..., 0, :] * residual).sum(axis=(0, -1))
    return Seeds(theta[:, 0], theta[:, 1], theta[:, 2], covariance, chi2, normal[0], normal[1])


def _inverse_2x2(m: FloatArray) -> FloatArray:
    """Inverse of symmetric matrices (..., 2, 2)."""
    a, b, d = m[..., 0, 0], m[..., 0, 1], m[..., 1, 1]
    out = np.empty_like(m)
    out[..., 0, 0], out[..., 1, 1] = d, a
    out[..., 0, 1] = out[..., 1, 0] = -b
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(out / (a * d - b * b)[..., None, None])


def _inverse_3x3(m: FloatArray) -> FloatArray:
    """Inverse of symmetric matrices (n, 3, 3) by cofactors; infinite or NaN, never an error, where there is none."""
    a, b, c = m[:, 0, 0], m[:, 0, 1], m[:, 0, 2]
    d, e, f = m[:, 1, 1], m[:, 1, 2], m[:, 2, 2]
    out = np.empty_like(m)
    out[:, 0, 0], out[:, 1, 1], out[:, 2, 2] = d * f - e * e, a * f - c * c, a * d - b * b
    out[:, 0, 1] = out[:, 1, 0] = c * e - b * f
    out[:, 0, 2] = out[:, 2, 0] = b * e - c * d
    out[:, 1, 2] = out[:, 2, 1] = b * c - a * e
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(out / (a * out[:, 0, 0] + b * out[:, 0, 1] + c * out[:, 0, 2])[:, None, None])
