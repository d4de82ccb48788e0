"""Pairs -> defects: height, position and their uncertainty, by the exact model or by the thesis' formula."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from inspector import reflection
from inspector.estimate.field_sigma import field_sigma
from inspector.estimate.sunk import heights_mm as sunk_heights_mm
from inspector.estimate.thesis import thesis_height_mm
from inspector.model import Defect, Flag, FloatArray, HighlightPairs, Highlights, IntArray, Unpaired
from inspector.optics import Calibration

UM_PER_MM = 1000.0
INCONSISTENT_SIGMA = 5.0
"""A pair whose spare equation is off by more is flagged: a chance pair, a sunk seed, or a poor calibration."""
INCONSISTENT = int(Flag.INCONSISTENT)
SUNK = int(Flag.SUNK)
SUNK_SIGMA, LEAST_SHARE = 2.5, 0.05
"""A pair whose spare equation is off by more is tried as a sunk seed; its centre is then so many radii high or more."""


def measure(
    spots: Highlights, pairs: HighlightPairs, calibration: Calibration, method: Literal["exact", "thesis"]
) -> tuple[tuple[Defect, ...], tuple[Unpaired, ...]]:
    """Defects of one frame, highest first, and its unpaired highlights."""
    defects = _exact(spots, pairs, calibration) if method == "exact" else _thesis(spots, pairs, calibration)
    unpaired = tuple(
        Unpaired(x, y, Flag(f))
        for (x, y), f in zip(spots.xy_px[pairs.unpaired].tolist(), pairs.unpaired_flags.tolist(), strict=True)
    )
    return tuple(sorted(defects, key=lambda d: -d.height_um)), unpaired


@dataclass(frozen=True)
class Measured:
    """Heights (n,) of n pairs by the exact model, and what their standard deviation comes from, all um.

    ``seeds`` are as they were solved at rest; ``sunk`` has SUNK where the height is that of a sunk one. The spots' part
    of the sigma and the calibration's (None: not known) add in squares.
    """

    seeds: reflection.Seeds
    sunk: IntArray
    height_um: FloatArray
    spots_sigma_um: FloatArray
    calibration_sigma_um: FloatArray | None
    sigma_um: FloatArray


def exact(spots: Highlights, pairs: HighlightPairs, calibration: Calibration) -> Measured:
    """Heights 2 R of resting seeds, or c + R of sunk ones, with their standard deviation."""
    d, m = pairs.direct, pairs.mirror
    seeds = reflection.solve(pairs.rays, spots.covariance_px2, d, m, calibration)
    um_a_radius = 2 * calibration.height_gain * UM_PER_MM
    with np.errstate(invalid="ignore"):  # a pair that no seed explains has no number, and FAILs for it
        sigma_um = um_a_radius * np.sqrt(seeds.covariance[:, 2, 2])
    height_um = um_a_radius * seeds.radius_mm
    sunk = _sunk(spots, pairs, seeds, calibration, height_um, sigma_um)
    field = field_sigma(calibration)
    if field is None:
        return Measured(seeds, sunk, height_um, sigma_um, None, sigma_um)
    of_calibration = field.at(spots.xy_px[d]) * height_um
    return Measured(seeds, sunk, height_um, sigma_um, of_calibration, np.hypot(sigma_um, of_calibration))


def _exact(spots: Highlights, pairs: HighlightPairs, calibration: Calibration) -> list[Defect]:
    """Defects with the heights of :func:`exact`, and their flags."""
    d, m = pairs.direct, pairs.mirror
    if len(d) == 0:
        return []
    measured = exact(spots, pairs, calibration)
    seeds, sunk, height_um, sigma_um = measured.seeds, measured.sunk, measured.height_um, measured.sigma_um
    with np.errstate(invalid="ignore"):
        residual = np.sqrt(seeds.chi2)
        place_sigma_mm = np.sqrt(np.maximum(seeds.covariance[:, 0, 0], seeds.covariance[:, 1, 1]))
    sunk_bias_um = np.where(sunk, 0.0, np.abs(seeds.sunk_share) * height_um)
    flags = pairs.flags | sunk
    columns = (seeds.x_mm, seeds.y_mm, height_um, sigma_um, residual, flags, sunk_bias_um, place_sigma_mm)
    places = zip(spots.xy_px[d].tolist(), spots.xy_px[m].tolist(), strict=True)
    return [
        Defect(
            x_mm=x_mm,
            y_mm=y_mm,
            height_um=height_um,
            height_sigma_um=sigma_um,
            direct_px=(direct[0], direct[1]),
            mirror_px=(mirror[0], mirror[1]),
            flags=Flag(flag | INCONSISTENT if residual > INCONSISTENT_SIGMA and not flag & SUNK else flag),
            residual_sigma=residual,
            sunk_bias_um=bias_um,
            place_sigma_mm=place_sigma_mm,
        )
        for x_mm, y_mm, height_um, sigma_um, residual, flag, bias_um, place_sigma_mm, (direct, mirror) in zip(
            *(c.tolist() for c in columns), places, strict=True
        )
    ]


def _sunk(
    spots: Highlights,
    pairs: HighlightPairs,
    seeds: reflection.Seeds,
    calibration: Calibration,
    height_um: FloatArray,
    sigma_um: FloatArray,
) -> IntArray:
    """SUNK (n,) where a pair's spare equation says that its seed does not rest on the panel, with 0 elsewhere.

    There ``height_um`` and ``sigma_um`` (n,) are set anew: a sunk seed read as a resting one is up to 4 % too low.
    """
    flags = np.zeros(len(height_um), np.intp)
    apart = ((seeds.chi2 > SUNK_SIGMA**2) & (seeds.radius_mm > 0)).nonzero()[0]
    if len(apart) == 0:
        return flags
    d, m = pairs.direct[apart], pairs.mirror[apart]
    some = reflection.Seeds(
        *(a[apart] for a in (seeds.x_mm, seeds.y_mm, seeds.radius_mm, seeds.covariance, seeds.chi2, seeds.sunk_share))
    )
    ends = ((pairs.rays[d], pairs.rays[m]), (spots.covariance_px2[d], spots.covariance_px2[m]))
    height_mm, sigma_mm, share = sunk_heights_mm(*ends, some, calibration)
    # Radius and centre may both come out below zero, in a share that looks right: that is no seed.
    taken = (share > LEAST_SHARE) & (share < 1) & np.isfinite(sigma_mm) & (height_mm > 0)
    height_um[apart[taken]] = height_mm[taken] * calibration.height_gain * UM_PER_MM
    sigma_um[apart[taken]] = sigma_mm[taken] * calibration.height_gain * UM_PER_MM
    flags[apart[taken]] = SUNK
    return flags


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
