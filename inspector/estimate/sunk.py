"""Seeds sunk in the paint: where a pair's spare equation says so, the sphere's centre need not be a radius high.

A resting seed has three unknowns (X, Y, R) for four pixel coordinates. Where these disagree by more than their noise,
the centre's height c over the panel is the fourth unknown, and the four equations of :mod:`inspector.reflection`,
linear in all of them, give it. How well depends on the view: with lamp, seed and camera in one plane the four are
three, so what is usual of sunk seeds joins in as a fifth.
"""

from __future__ import annotations

import numpy as np

from inspector.model import FloatArray
from inspector.optics import Calibration
from inspector.reflection import MIRROR, Seeds, unit

USUAL_SHARE, SHARE_SIGMA = 0.6, 0.25
"""Centre's height over radius of sunk seeds: the middle of 0.3 to 0.9, and its standard deviation."""
ALONG, ACROSS = slice(0, 3), slice(3, 9)
"""Columns of a ray: its direction, and what turns mm across it at unit distance into pixels."""


def heights_mm(
    rays: tuple[FloatArray, FloatArray],
    covariances: tuple[FloatArray, FloatArray],
    seeds: Seeds,
    calibration: Calibration,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Height c + R (k,) mm, its standard deviation (k,) and c / R (k,) of k seeds that may be sunk.

    ``rays`` and ``covariances``: direct and mirror spots', (k, 9) and (k, 2, 2) px^2; ``seeds`` as solved at rest.
    """
    k = len(seeds.radius_mm)
    lamp = calibration.light.toward(np.column_stack([seeds.x_mm, seeds.y_mm, seeds.radius_mm]))
    normal_matrix, right = np.zeros((k, 4, 4)), np.zeros((k, 4))
    for ray, covariance, side in zip(rays, covariances, (np.ones(3), MIRROR), strict=True):
        eye = calibration.camera.centre_mm * side
        normal = unit(lamp - ray[:, ALONG] * side)
        reach = np.abs(eye[2]) / np.maximum(np.abs(ray[:, 2]), 1e-9)
        across = ray[:, ACROSS].reshape(k, 2, 3) * side / reach[:, None, None]
        rows = np.concatenate([across[:, :, :2], across @ normal[:, :, None], across[:, :, 2:]], axis=2)
        weighted = rows.transpose(0, 2, 1) @ np.linalg.inv(covariance)
        normal_matrix += weighted @ rows
        right += (weighted @ (across @ eye)[:, :, None])[:, :, 0]
    usual = np.array([0.0, 0.0, -USUAL_SHARE, 1.0]) / (SHARE_SIGMA * seeds.radius_mm[:, None])
    normal_matrix += usual[:, :, None] * usual[:, None, :]
    spread = np.linalg.inv(normal_matrix)
    theta = (spread @ right[:, :, None])[:, :, 0]
    variance = spread[:, 2, 2] + spread[:, 3, 3] + 2 * spread[:, 2, 3]
    return theta[:, 2] + theta[:, 3], np.sqrt(variance), theta[:, 3] / theta[:, 2]
