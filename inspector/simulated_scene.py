"""Where the highlights of seeds on the panel are, and how bright: what a simulated camera is to draw. Pure.

A small convex mirror sends the same light whatever the angle, in proportion to its section; what is left of it is
Fresnel's share of each reflection: one on the seed for the direct spot, one more on the paint for the mirror spot.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from inspector import reflection
from inspector.model import FloatArray
from inspector.optics import Calibration

COAT_INDEX = 1.5
"""Refractive index of the paint's clear coat, on panel and seed."""
NOMINAL_HEIGHT_UM, UM_PER_RADIUS_MM = 2000.0, 2000.0


def highlights(
    seeds: Sequence[tuple[float, float, float]], nominal_share: float, calibration: Calibration
) -> tuple[tuple[float, float, float], ...]:
    """Spots (x_px, y_px, peak) of resting seeds (x_mm, y_mm, height_um); those out of view are left out.

    The direct spot of a seed 2 mm high peaks at ``nominal_share``; the others are as bright as they are beside it.
    """
    x_mm, y_mm, height_um = np.array(seeds, np.float64).T
    radius_mm = height_um / UM_PER_RADIUS_MM
    whole = np.column_stack([x_mm, y_mm, radius_mm, radius_mm])
    direct, mirror = _reflectances(whole, calibration)
    section = nominal_share * (height_um / NOMINAL_HEIGHT_UM) ** 2
    peaks = section * direct / direct.max(), section * mirror / direct.max()
    xy_px = np.concatenate(reflection.highlights(whole, calibration))
    spots = np.column_stack([xy_px, np.concatenate(peaks)])
    camera = calibration.camera
    within = np.all((xy_px >= 0) & (xy_px < (camera.width_px, camera.height_px)), axis=1)
    return tuple((x, y, peak) for x, y, peak in spots[within].tolist())


def _reflectances(seeds: FloatArray, calibration: Calibration) -> tuple[FloatArray, FloatArray]:
    """Share of the light that each seed's direct and mirror spot keep, (n,) both."""
    centre, radius, eye = seeds[:, (0, 1, 3)], seeds[:, 2], calibration.camera.centre_mm
    shares = []
    for seen_from in (eye, eye * reflection.MIRROR):
        point = reflection.surface_point(centre, radius, calibration.light, seen_from)
        away = reflection.unit(seen_from - point)
        normal = reflection.unit(point - centre)
        shares.append(_fresnel((away * normal).sum(axis=-1)))
        paint = _fresnel(np.abs(away[:, 2]))
    return shares[0], shares[1] * paint


def _fresnel(cosine: FloatArray) -> FloatArray:
    """Reflectance of the coat for unpolarised light, from the cosine of the angle of incidence."""
    inside = np.sqrt(1 - (1 - cosine**2) / COAT_INDEX**2)
    s = (cosine - COAT_INDEX * inside) / (cosine + COAT_INDEX * inside)
    p = (inside - COAT_INDEX * cosine) / (inside + COAT_INDEX * cosine)
    return np.asarray((s**2 + p**2) / 2)
