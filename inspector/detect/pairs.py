"""Highlights -> pairs: which spot is a seed's direct one and which its mirror, for the whole frame at once.

Camera and lamp alone fix the direction from direct to mirror spot at every pixel. Each ordered couple of spots that
lies along it is a candidate; the exact model says how well it fits (one spare equation), Fresnel's equations and the
other seeds say how bright its spots should be. The best set of couples in which no spot serves twice is taken;
what fits nothing stays unpaired. A lone spot never becomes a height.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from inspector import reflection
from inspector.detect.matching import best_matching
from inspector.model import Flag, FloatArray, HighlightPairs, Highlights, IntArray
from inspector.optics import Calibration

LARGEST_RADIUS_MM = 12.0
"""No candidate is larger: three times the largest seed of the thesis."""
BEND_SHARE, BEND_PX = 0.12, 1.5
"""First sieve: how far, as a share of the distance and in pixels, a mirror spot may lie beside the direction."""
MODEL_SHARE = 0.008
"""What the model itself may be off across the direction (sunk seeds, lamp azimuth), as a share of the distance."""
WORTH = 9.0
"""Log odds by which a couple that fits perfectly beats two spots that only chance put there."""
RATIO_SIGMA = 0.35
"""Scatter of the log brightness ratio of true pairs about Fresnel's beside the fluxes' own: the paint's index."""
SIZE_SIGMA = 0.4
"""Scatter of log(flux / radius^2) among the seeds of a frame: sunk seeds show more radius than height."""
SIZE_COST = 6.0
"""Limit of that term: a seed unlike its neighbours is rare, not impossible."""
POOL_SHARE = 0.7
"""A paint pool's spot lies at most this share of the way from the mirror to the direct spot."""
POOL_ODDS = 5.0
"""How much more the wider couple may cost."""
PAINT_INDEX = 1.5
"""Refractive index of clear coats: 1.47 to 1.55."""


@dataclass(frozen=True)
class Candidates:
    """Ordered couples of spots: indices ``direct`` and ``mirror`` (m,), and ``cost`` (m,); lower is likelier."""

    direct: IntArray
    mirror: IntArray
    cost: FloatArray
    radius_mm: FloatArray
    size: FloatArray
    """log(direct flux / radius^2): alike for all seeds of a frame."""

    def take(self, index: IntArray) -> Candidates:
        """Some of the candidates."""
        return Candidates(self.direct[index], self.mirror[index], self.cost[index], self.radius_mm[index], self.size[index])


def pair(spots: Highlights, calibration: Calibration) -> HighlightPairs:
    """Pair the spots of one frame. Every spot is in ``direct``, ``mirror`` or ``unpaired``, and only once."""
    able = np.flatnonzero((spots.flags & (Flag.HOT_PIXEL | Flag.TOO_SMALL | Flag.TOO_LARGE)) == 0)
    found = _candidates(spots, able, calibration)
    chosen = best_matching(found.direct, found.mirror, found.cost - WORTH)
    if len(chosen) >= 3:
        unlike = (found.size - np.median(found.size[chosen])) ** 2 / (SIZE_SIGMA**2 + spots.flux_sigma[found.direct] ** 2)
        found = replace(found, cost=found.cost + np.minimum(unlike / 2, SIZE_COST))
        chosen = best_matching(found.direct, found.mirror, found.cost - WORTH)
    chosen = _outermost(found, chosen)
    direct, mirror = found.direct[chosen], found.mirror[chosen]
    flags = spots.flags[direct] | spots.flags[mirror]
    unpaired = np.setdiff1d(np.arange(len(spots)), np.concatenate([direct, mirror]))
    return HighlightPairs(direct, mirror, unpaired, flags, _unpaired_flags(spots, unpaired, found, chosen))


def _candidates(spots: Highlights, able: IntArray, calibration: Calibration) -> Candidates:
    """All couples that lie along the direction from direct to mirror spot and fit the model at all."""
    xy = spots.xy_px[able]
    rays = reflection.rays(calibration.camera, xy)
    toward = reflection.directions(rays, calibration)
    scale = np.hypot(toward[:, 0], toward[:, 1])
    toward = toward / scale[:, None]
    d = xy[None] - xy[:, None]
    along = d[..., 0] * toward[:, :1] + d[..., 1] * toward[:, 1:]
    beside = np.abs(d[..., 1] * toward[:, :1] - d[..., 0] * toward[:, 1:])
    near = (along > 0.5) & (along < LARGEST_RADIUS_MM * scale[:, None]) & (beside < BEND_PX + BEND_SHARE * along)
    i, j = np.nonzero(near)
    model = (MODEL_SHARE * along[i, j]) ** 2
    return _scored(spots, able[i], able[j], rays.take(i), rays.take(j), model, calibration)


def _scored(
    spots: Highlights,
    a: IntArray,
    b: IntArray,
    direct: reflection.Rays,
    mirror: reflection.Rays,
    model_px2: FloatArray,
    calibration: Calibration,
) -> Candidates:
    """Solve all couples (m,) at once and score them; what cannot pay for itself is dropped."""
    model = model_px2[:, None, None] * np.eye(2)
    covariance = spots.covariance_px2
    seeds = reflection.solve(direct, mirror, covariance[a] + model, covariance[b] + model, calibration)
    with np.errstate(invalid="ignore", divide="ignore"):
        size = np.log(spots.flux_dn[a] / seeds.radius_mm**2)
        ratio = np.log(spots.flux_dn[a] / spots.flux_dn[b] / expected_ratio(direct.along, mirror.along, seeds))
    spread2 = RATIO_SIGMA**2 + spots.flux_sigma[a] ** 2 + spots.flux_sigma[b] ** 2
    cost = seeds.chi2 / 2 + ratio**2 / (2 * spread2)
    good = np.flatnonzero((seeds.radius_mm > 0) & (seeds.radius_mm < LARGEST_RADIUS_MM) & (cost < WORTH))
    return Candidates(a, b, cost, seeds.radius_mm, size).take(good)


def expected_ratio(direct_along: FloatArray, mirror_along: FloatArray, seeds: reflection.Seeds) -> FloatArray:
    """Flux of the direct spot over that of the mirror spot, (n,): one reflection against two (Fresnel, unpolarised).

    A small convex mirror sends the same flux whatever the angle, so only the reflectances differ.
    """
    cosines = np.stack(
        [
            (direct_along * seeds.direct_normal).sum(axis=1),
            (mirror_along * reflection.MIRROR * seeds.mirror_normal).sum(axis=1),
            mirror_along[:, 2],
        ]
    )
    direct, sphere, paint = fresnel(np.abs(cosines))
    return np.asarray(direct / (sphere * paint))


def fresnel(cosine: FloatArray) -> FloatArray:
    """Reflectance of the clear coat for unpolarised light at angles of incidence of these cosines, same shape."""
    inside = np.sqrt(1 - (1 - cosine**2) / PAINT_INDEX**2)
    s = (cosine - PAINT_INDEX * inside) / (cosine + PAINT_INDEX * inside)
    p = (inside - PAINT_INDEX * cosine) / (inside + PAINT_INDEX * cosine)
    return np.asarray((s * s + p * p) / 2)


def _outermost(found: Candidates, chosen: IntArray) -> IntArray:
    """Where a couple could as well reach further to a spot that is left over, it does: the spot between is paint.

    The pool at a seed's foot throws a third spot between the two, on the mirror's side; nothing throws one beyond.
    """
    taken = set(np.concatenate([found.direct[chosen], found.mirror[chosen]]).tolist())
    result = []
    for k in chosen:
        d, m, r = found.direct[k], found.mirror[k], found.radius_mm[k]
        wider = (found.radius_mm > r) & (found.cost < found.cost[k] + POOL_ODDS)
        outer = np.flatnonzero(wider & (found.mirror == m) & (r < POOL_SHARE * found.radius_mm))
        outer = np.append(outer, np.flatnonzero(wider & (found.direct == d) & (r > (1 - POOL_SHARE) * found.radius_mm)))
        free = [c for c in outer if not ({int(found.direct[c]), int(found.mirror[c])} - {int(d), int(m)}) & taken]
        best = min(free, key=lambda c: float(found.cost[c]), default=k)
        taken |= {int(found.direct[best]), int(found.mirror[best])}
        result.append(best)
    return np.array(result, np.intp)


def _unpaired_flags(spots: Highlights, unpaired: IntArray, found: Candidates, chosen: IntArray) -> IntArray:
    """What each spot (m,) that is left over may be: a paint pool, a seed whose other spot is used or unseen, dust."""
    flags = spots.flags[unpaired]
    pairs = set(zip(found.direct[chosen].tolist(), found.mirror[chosen].tolist(), strict=True))
    for n, spot in enumerate(unpaired):
        before = set(found.direct[found.mirror == spot].tolist())
        after = set(found.mirror[found.direct == spot].tolist())
        if any(d in before and m in after for d, m in pairs):
            flags[n] |= Flag.PAINT_POOL
        elif before or after:
            flags[n] |= Flag.AMBIGUOUS
        elif not flags[n] & (Flag.HOT_PIXEL | Flag.AT_EDGE):
            flags[n] |= Flag.DUST
    return flags
