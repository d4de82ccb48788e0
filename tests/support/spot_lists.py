"""Lists of highlights as detection gives them, made from seeds by the forward model, noise and Fresnel."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np

from inspector import reflection
from inspector.model import Flag, FloatArray, Highlights, IntArray
from inspector.optics import Calibration

DN_PER_MM2 = 4000.0
"""Flux of a direct spot of reflectance one and a seed of 1 mm radius."""


def spots_at(xy_px: FloatArray, flux_dn: FloatArray | float, sigma_px: float = 0.03) -> Highlights:
    """Highlights at pixels (n, 2), known to ``sigma_px``."""
    n = len(xy_px)
    flux = np.broadcast_to(flux_dn, n).astype(np.float64)
    return Highlights(
        xy_px=xy_px.astype(np.float64),
        covariance_px2=np.repeat(sigma_px**2 * np.eye(2)[None], n, axis=0),
        flux_dn=flux,
        flux_sigma=np.full(n, 0.1),
        peak_dn=flux / 3,
        area_px=np.full(n, 9, np.intp),
        flags=np.zeros(n, np.intp),
        binary_px=xy_px.astype(np.float64),
        blur_px2=np.tile([0.5, 0.0, 0.5], (n, 1)),
    )


def together(*lists: Highlights) -> Highlights:
    """One list of all spots."""
    arrays = [f.name for f in fields(Highlights) if isinstance(getattr(lists[0], f.name), np.ndarray)]
    return replace(lists[0], **{name: np.concatenate([getattr(spots, name) for spots in lists]) for name in arrays})


def shuffled(spots: Highlights, order: IntArray) -> Highlights:
    """The same spots in another order."""
    arrays = [f.name for f in fields(Highlights) if isinstance(getattr(spots, f.name), np.ndarray)]
    return replace(spots, **{name: getattr(spots, name)[order] for name in arrays})


def flagged(spots: Highlights, flag: Flag) -> Highlights:
    """The same spots, all with one more flag."""
    return replace(spots, flags=spots.flags | int(flag))


def seen(seeds: FloatArray, calibration: Calibration, rng: np.random.Generator, sigma_px: float = 0.03) -> Highlights:
    """All direct spots of seeds (n, 4), then all mirror spots: place, noise and brightness as a camera sees them."""
    direct, mirror = reflection.highlights(seeds, calibration)
    xy = np.concatenate([direct, mirror])
    flux = DN_PER_MM2 * np.tile(seeds[:, 2] ** 2, 2) * _reflectance(seeds, direct, mirror, calibration)
    spots = spots_at(xy + rng.normal(0, sigma_px, xy.shape), flux, sigma_px)
    return replace(spots, flux_dn=flux * np.exp(rng.normal(0, 0.1, len(flux))))


def _reflectance(seeds: FloatArray, direct: FloatArray, mirror: FloatArray, calibration: Calibration) -> FloatArray:
    """Share of the lamp's light (2 n,) that each spot keeps: the lamp's ray turns by twice the angle of incidence."""
    foot = np.column_stack([seeds[:, :2], np.zeros(len(seeds))])
    lamp = calibration.light.toward(foot)
    away, down = (reflection.unit(-calibration.camera.rays(pixels)) for pixels in (direct, mirror))
    once = fresnel(half_angle(lamp, away))
    twice = fresnel(half_angle(lamp, down * reflection.MIRROR)) * fresnel(np.arccos(down[:, 2]))
    return np.concatenate([once, twice])


def half_angle(a: FloatArray, b: FloatArray) -> FloatArray:
    """Half the angle (n,) between unit vectors (n, 3), radians."""
    return np.arccos(np.clip((a * b).sum(axis=1), -1, 1)) / 2


def fresnel(incidence: FloatArray, index: float = 1.5) -> FloatArray:
    """Reflectance of a dielectric for unpolarised light, in the form with sines and tangents."""
    i = np.maximum(incidence, 1e-6)
    t = np.arcsin(np.sin(i) / index)
    return np.asarray((np.sin(i - t) / np.sin(i + t)) ** 2 + (np.tan(i - t) / np.tan(i + t)) ** 2) / 2
