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

from inspector.model import FloatArray
from inspector.optics import Calibration, Camera, Light

MIRROR = np.array([1.0, 1.0, -1.0])
LAMP_ROUNDS = 6
"""A lamp at a finite distance is seen from the spot, which moves with the seed: each round wins two digits."""
NORMAL_ROUNDS = 8
"""Fixed-point rounds of the forward model; each wins three digits."""


def unit(v: FloatArray) -> FloatArray:
    """Vectors (n, 3) scaled to length one."""
    return v / np.sqrt(np.einsum("nk,nk->n", v, v))[:, None]


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

    def take(self, index: FloatArray) -> Rays:
        """The rays of some of the pixels."""
        return Rays(self.along[index], self.across[index])


def rays(camera: Camera, xy_px: FloatArray) -> Rays:
    """Rays of pixels (n, 2), with the pseudo-inverse of their derivative by the pixel (central differences)."""
    n, step = len(xy_px), 0.5
    moved = np.concatenate([xy_px, xy_px + [step, 0], xy_px - [step, 0], xy_px + [0, step], xy_px - [0, step]])
    d = unit(camera.rays(moved)).reshape(5, n, 3)
    jacobian = np.stack([d[1] - d[2], d[3] - d[4]], axis=2) / (2 * step)
    gram = np.einsum("nki,nkj->nij", jacobian, jacobian)
    det = gram[:, 0, 0] * gram[:, 1, 1] - gram[:, 0, 1] ** 2
    inverse = np.empty_like(gram)
    inverse[:, 0, 0], inverse[:, 1, 1] = gram[:, 1, 1] / det, gram[:, 0, 0] / det
    inverse[:, 0, 1] = inverse[:, 1, 0] = -gram[:, 0, 1] / det
    return Rays(d[0], np.einsum("nij,nkj->nik", inverse, jacobian))


@dataclass(frozen=True)
class Seeds:
    """Seeds that explain n pairs of pixels best.

    ``x_mm``, ``y_mm``, ``radius_mm`` (n,); ``covariance`` (n, 3, 3) of the three; ``chi2`` (n,) of the one spare
    equation; ``gain`` (n, 3, 4) derivatives of the three by the four pixel coordinates; ``direct_normal`` and
    ``mirror_normal`` (n, 3) of the surface at the spots.
    """

    x_mm: FloatArray
    y_mm: FloatArray
    radius_mm: FloatArray
    covariance: FloatArray
    chi2: FloatArray
    gain: FloatArray
    direct_normal: FloatArray
    mirror_normal: FloatArray


def solve(direct: Rays, mirror: Rays, direct_cov: FloatArray, mirror_cov: FloatArray, calibration: Calibration) -> Seeds:
    """The resting seeds that explain n pairs: rays of both spots and the covariance (n, 2, 2) px^2 of their pixels."""
    eye = calibration.camera.centre_mm
    eyes = (eye, eye * MIRROR)
    along = (direct.along, mirror.along * MIRROR)
    across = (direct.across, mirror.across * MIRROR)
    # Distance to the spot scales mm to pixels: first to where the ray meets the panel, then to the spot itself.
    reach = [eye[2] / np.maximum(-r.along[:, 2], 1e-9) for r in (direct, mirror)]
    weight = (_inverse_2x2(direct_cov), _inverse_2x2(mirror_cov))
    light = calibration.light
    near = light.position_mm is not None
    for _ in range(LAMP_ROUNDS if near else 2):
        points = [e + t[:, None] * a for e, t, a in zip(eyes, reach, along, strict=True)]
        normals = [unit(light.toward(p) - a) for p, a in zip(points, along, strict=True)]
        normal_matrix, right, rows = 0.0, 0.0, []
        for e, b, t, w, n in zip(eyes, across, reach, weight, normals, strict=True):
            b = b / t[:, None, None]
            a = np.concatenate([b[:, :, :2], np.einsum("nij,nj->ni", b, n + (0.0, 0.0, 1.0))[:, :, None]], axis=2)
            y = b @ e
            aw = np.einsum("nij,nik->njk", a, w)
            normal_matrix, right = normal_matrix + aw @ a, right + np.einsum("njk,nk->nj", aw, y)
            rows.append((a, y, w, aw))
        covariance = _inverse_3x3(normal_matrix)
        theta = np.einsum("njk,nk->nj", covariance, right)
        centre = theta.copy()
        reach = [
            np.einsum("nk,nk->n", centre + theta[:, 2:] * n - e, a)
            for e, a, n in zip(eyes, along, normals, strict=True)
        ]
        reach = [np.maximum(t, 1e-3) for t in reach]
    chi2 = sum(np.einsum("ni,nij,nj->n", r, w, r) for a, y, w, _ in rows for r in (np.einsum("nij,nj->ni", a, theta) - y,))
    gain = np.concatenate([covariance @ aw for _, _, _, aw in rows], axis=2)
    return Seeds(theta[:, 0], theta[:, 1], theta[:, 2], covariance, chi2, gain, normals[0], normals[1])


def _inverse_2x2(m: FloatArray) -> FloatArray:
    """Inverse of symmetric matrices (n, 2, 2)."""
    det = m[:, 0, 0] * m[:, 1, 1] - m[:, 0, 1] * m[:, 1, 0]
    out = np.empty_like(m)
    out[:, 0, 0], out[:, 1, 1] = m[:, 1, 1] / det, m[:, 0, 0] / det
    out[:, 0, 1] = out[:, 1, 0] = -m[:, 0, 1] / det
    return out


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
        return out / (a * out[:, 0, 0] + b * out[:, 0, 1] + c * out[:, 0, 2])[:, None, None]
