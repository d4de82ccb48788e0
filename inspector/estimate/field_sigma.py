"""What the calibration's own uncertainty does to heights: a share of the height that changes over the field.

The camera's parameters are moved one by one, and the heights of small seeds all over the frame measured anew from the
same pixels; the parameters' covariance carries the differences through. Once for a calibration, on a coarse grid: what
a camera's error does to heights varies over the field as slowly as the view does.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from inspector import reflection
from inspector.model import CAMERA_PARAMETERS, FloatArray
from inspector.optics import Calibration

ROWS, COLUMNS = 13, 17
"""The grid of probes: fine enough but where the paint mirrors the lamp right into the camera."""
PROBE_RADIUS_MM = 1.0
STEP_SIGMAS = 0.1
"""Parameters are moved by this many of their standard deviations, both ways."""


@dataclass(frozen=True)
class FieldSigma:
    """Standard deviation of height as a share of the height, at a grid (rows, columns) from corner to corner."""

    share: FloatArray
    width_px: int
    height_px: int

    def at(self, xy_px: FloatArray) -> FloatArray:
        """The share (n,) at pixels (n, 2): bilinear; beyond the frame as at its edge."""
        rows, columns = self.share.shape
        place = xy_px[:, ::-1] * [(rows - 1) / (self.height_px - 1), (columns - 1) / (self.width_px - 1)]
        place = np.clip(place, 0, [rows - 1, columns - 1])
        low = np.minimum(place.astype(np.intp), [rows - 2, columns - 2])
        (r, c), (down, right) = low.T, (place - low).T
        upper = self.share[r, c] * (1 - right) + self.share[r, c + 1] * right
        lower = self.share[r + 1, c] * (1 - right) + self.share[r + 1, c + 1] * right
        return np.asarray(upper * (1 - down) + lower * down)


@lru_cache(maxsize=4)
def field_sigma(calibration: Calibration) -> FieldSigma | None:
    """The share of a calibration; None where it says nothing of its own uncertainty. Kept for the latest few."""
    if calibration.covariance is None:
        return None
    camera = calibration.camera
    x, y = np.meshgrid(np.linspace(0, camera.width_px - 1, COLUMNS), np.linspace(0, camera.height_px - 1, ROWS))
    slopes = _slopes(np.column_stack([x.ravel(), y.ravel()]), calibration)
    variance = np.einsum("ni,ij,nj->n", slopes, calibration.covariance, slopes)
    share = np.sqrt(np.maximum(variance, 0)).reshape(ROWS, COLUMNS)
    known = share[np.isfinite(share)]  # not where the frame looks past the panel: the worst of the rest stands there
    share = np.where(np.isfinite(share), share, max(known.tolist(), default=np.inf))
    return FieldSigma(share, camera.width_px, camera.height_px)


def _slopes(feet_px: FloatArray, calibration: Calibration) -> FloatArray:
    """Relative change of height (n, p) by each of the covariance's p parameters, of seeds whose feet are at pixels."""
    assert calibration.covariance is not None
    feet = calibration.camera.back_project(feet_px)
    radius = np.full((len(feet), 2), PROBE_RADIUS_MM)
    pixels = np.concatenate(reflection.highlights(np.column_stack([feet, radius]), calibration))
    sigma = np.sqrt(np.diag(calibration.covariance))
    slopes = np.zeros((len(feet), len(sigma)))
    for k, name in enumerate(calibration.covariance_of):
        if sigma[k] > 0:
            step = STEP_SIGMAS * sigma[k]
            up, down = (_radius_mm(pixels, _moved(calibration, name, s)) for s in (step, -step))
            slopes[:, k] = (up - down) / (2 * step * PROBE_RADIUS_MM)
    return slopes


def _moved(calibration: Calibration, name: str, by: float) -> Calibration:
    """The calibration with one of the camera's parameters moved."""
    step = np.zeros(len(CAMERA_PARAMETERS))
    step[CAMERA_PARAMETERS.index(name)] = by
    return replace(calibration, camera=calibration.camera.perturbed(step))


def _radius_mm(pixels: FloatArray, calibration: Calibration) -> FloatArray:
    """Radii (n,) of the seeds whose direct spots, then mirror spots, are at pixels (2 n, 2)."""
    direct = np.arange(len(pixels) // 2)
    even = np.tile(np.eye(2), (len(pixels), 1, 1))
    rays = reflection.rays(calibration.camera, pixels)
    return reflection.solve(rays, even, direct, direct + len(direct), calibration).radius_mm
