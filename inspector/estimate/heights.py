"""Pairs -> defects: height, position and their uncertainty, by the exact model or by the thesis' formula."""

from __future__ import annotations

from typing import Literal

import numpy as np

from inspector import reflection
from inspector.estimate.thesis import thesis_height_mm
from inspector.model import Defect, Flag, FloatArray, HighlightPairs, Highlights, Unpaired
from inspector.optics import Calibration

UM_PER_MM = 1000.0
INCONSISTENT_SIGMA = 5.0
"""A pair whose spare equation is off by more is flagged: a chance pair, a sunk seed, or a poor calibration."""
SUNK_SHARE = 0.009
"""A seed sunk in the paint reads low by 0.7 to 1.2 % (centre at 0.7 to 0.5 of the radius): the mean of the two."""


def measure(
    spots: Highlights, pairs: HighlightPairs, calibration: Calibration, method: Literal["exact", "thesis"]
) -> tuple[tuple[Defect, ...], tuple[Unpaired, ...]]:
    """Defects of one frame, highest first, and its unpaired highlights."""
    defects = _exact(spots, pairs, calibration) if method == "exact" else _thesis(spots, pairs, calibration)
    unpaired = tuple(
        Unpaired(float(x), float(y), Flag(int(f)))
        for (x, y), f in zip(spots.xy_px[pairs.unpaired], pairs.unpaired_flags, strict=True)
    )
    return tuple(sorted(defects, key=lambda d: -d.height_um)), unpaired


def _exact(spots: Highlights, pairs: HighlightPairs, calibration: Calibration) -> list[Defect]:
    """Heights 2 R of resting seeds, with their standard deviation from the spots' covariance."""
    d, m = pairs.direct, pairs.mirror
    if len(d) == 0:
        return []
    rays = reflection.rays(calibration.camera, spots.xy_px)
    seeds = reflection.solve(rays, spots.covariance_px2, d, m, calibration)
    height_um = 2 * seeds.radius_mm * calibration.height_gain * UM_PER_MM
    sigma_um = 2 * np.sqrt(seeds.covariance[:, 2, 2]) * calibration.height_gain * UM_PER_MM
    residual = np.sqrt(seeds.chi2)
    flags = pairs.flags | np.where(residual > INCONSISTENT_SIGMA, int(Flag.INCONSISTENT), 0)
    return [
        Defect(
            x_mm=float(seeds.x_mm[n]),
            y_mm=float(seeds.y_mm[n]),
            height_um=float(height_um[n]),
            height_sigma_um=float(sigma_um[n]),
            direct_px=_pixel(spots.xy_px[d[n]]),
            mirror_px=_pixel(spots.xy_px[m[n]]),
            flags=Flag(int(flags[n])),
            residual_sigma=float(residual[n]),
            sunk_bias_um=float(SUNK_SHARE * height_um[n]),
        )
        for n in range(len(d))
    ]


def _pixel(xy: FloatArray) -> tuple[float, float]:
    return float(xy[0]), float(xy[1])


def _thesis(spots: Highlights, pairs: HighlightPairs, calibration: Calibration) -> list[Defect]:
    """The thesis' chain on binary centroids carried back to the panel; it knows no uncertainty.

    The position is that of the direct spot on z = 0. Two spots in one component have one centroid: height 0, MERGED.
    """
    direct_px, mirror_px = spots.binary_px[pairs.direct], spots.binary_px[pairs.mirror]
    direct_mm, mirror_mm = (calibration.camera.back_project(p) for p in (direct_px, mirror_px))
    height_mm = thesis_height_mm(direct_mm, mirror_mm, calibration.lamp_angle_deg, calibration.view_angle_deg)
    return [
        Defect(
            x_mm=float(direct_mm[n, 0]),
            y_mm=float(direct_mm[n, 1]),
            height_um=float(height_mm[n] * calibration.height_gain * UM_PER_MM),
            height_sigma_um=None,
            direct_px=_pixel(direct_px[n]),
            mirror_px=_pixel(mirror_px[n]),
            flags=Flag(int(pairs.flags[n])),
        )
        for n in range(len(pairs.direct))
    ]
