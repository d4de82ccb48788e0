"""Highlights -> pairs: which spot is a seed's direct one and which its mirror, for the whole frame at once.

Camera and lamp alone fix the direction from direct to mirror spot at every pixel. Each ordered couple of spots that
lies along it is a candidate; the exact model says how well it fits (one spare equation), Fresnel's equations and the
other seeds say how bright its spots should be. The best set of couples in which no spot serves twice is taken;
what fits nothing stays unpaired. A lone spot never becomes a height. Candidates are sieved and scored in `_pairs.c`.
"""

from __future__ import annotations

import struct
from collections import defaultdict
from dataclasses import dataclass, replace
from functools import cached_property
from math import log

import numpy as np
import numpy.typing as npt

from firmware_bridge import native
from firmware_bridge.native import out
from inspector import reflection
from inspector.detect.matching import best_matching
from inspector.model import Flag, FloatArray, HighlightPairs, Highlights, IntArray
from inspector.optics import Calibration

LARGEST_RADIUS_MM = 12.0
"""No candidate is larger: three times the largest seed of the thesis."""
BEND_SHARE, BEND_PX = 0.12, 1.5
"""First sieve: how far, as a share of the distance and in pixels, a mirror spot may lie beside the direction."""
MODEL_SHARE = 0.003
"""What the calibration may be off across the direction (lamp azimuth), as a share of the distance."""
SUNK_SHARE = 0.3
"""The share of seeds that are sunk in the paint, their centre anywhere from a radius high down to the surface."""
USUAL_RADIUS_MM, RADIUS_SCATTER = 0.7, 1.1
"""Seeds are so large, log-normally: from 0.2 to 2.1 mm within one scatter."""
CHANCE_RATIO_SIGMA = 1.2
"""Scatter of the log brightness ratio of two spots that have nothing to do with each other."""
LEAST_ODDS = 2.0
"""Log odds that a couple is a seed rather than chance, without which it is none."""
FEW = 4
"""Chance is reckoned with as many spots in the frame that are no seed's, or with those left over if they are more."""
WORTH = 9.0
"""What leaving two spots alone costs: a couple whose log odds are LEAST_ODDS costs the same."""
RATIO_SIGMA = 0.35
"""Scatter of the log brightness ratio of true pairs about Fresnel's beside the fluxes' own: the paint's index."""
SIZE_SIGMA = 0.4
"""Scatter of log(flux / radius^2) among the seeds of a frame: sunk seeds show more radius than height."""
SIZE_COST = 6.0
"""Limit of that term: a seed unlike its neighbours is rare, not impossible."""
POOL_SHARE = 0.7
"""A paint pool's spot lies at most this share of the way from the mirror to the direct spot."""
POOL_ODDS = 7.0
"""How much more the wider couple may cost."""
PAINT_INDEX = 1.5
"""Refractive index of clear coats: 1.47 to 1.55."""

NO_SEED = int(Flag.HOT_PIXEL | Flag.TOO_SMALL | Flag.TOO_LARGE)
"""What has one of these flags is no seed's spot."""
PROBE_RADIUS_MM = 0.5
"""A lone spot whose other one would lie outside the frame for a seed of this radius may be one that is cut off."""
DRAWN_OUT = 1.6
"""A lone spot longer than wide by this ratio of variances, the way a seed's two lie, is two that merged."""
POOL_BESIDE_PX = 1.0
"""How far beside a pair's line a paint pool's spot may lie, with BEND_SHARE of its length."""
NO_DUST = int(Flag.HOT_PIXEL | Flag.AT_EDGE)
"""What fits nothing and has one of these flags is not called dust."""
DUST, PARTNER_OUTSIDE, MERGED, AMBIGUOUS, POOL = map(
    int, (Flag.DUST, Flag.PARTNER_OUTSIDE_FRAME, Flag.MERGED, Flag.AMBIGUOUS, Flag.PAINT_POOL)
)
"""What a lone spot may be; each is said rather than those before it."""
COUPLES_A_SPOT = 16
"""Room for candidates, for each spot; more are counted and asked for again."""


def _rules(spots_a_px2: float) -> bytes:
    """`Rules` of `_pairs.c`."""
    plain = (LARGEST_RADIUS_MM, BEND_SHARE, BEND_PX, MODEL_SHARE, WORTH, RATIO_SIGMA, PAINT_INDEX)
    seeds = (SUNK_SHARE, USUAL_RADIUS_MM, RADIUS_SCATTER)
    return struct.pack("13d", *plain, *seeds, CHANCE_RATIO_SIGMA, LEAST_ODDS, spots_a_px2)


_candidates = native.function("inspector.detect._pairs", "pairs_candidates", "ppippppppippp")


@dataclass(frozen=True)
class Candidates:
    """Ordered couples of spots that fit the model: m of each; lower ``cost`` is likelier.

    Lists, since what is asked of them goes couple by couple.
    """

    direct: list[int]
    mirror: list[int]
    cost: list[float]
    radius_mm: list[float]
    size: list[float]
    """log(direct flux / radius^2): alike for all seeds of a frame."""

    @cached_property
    def of_direct(self) -> dict[int, list[int]]:
        """The candidates of each direct spot."""
        return _grouped(self.direct)

    @cached_property
    def of_mirror(self) -> dict[int, list[int]]:
        """The candidates of each mirror spot."""
        return _grouped(self.mirror)


def _grouped(keys: list[int]) -> dict[int, list[int]]:
    groups: dict[int, list[int]] = defaultdict(list)
    for k, key in enumerate(keys):
        groups[key].append(k)
    return groups


@dataclass(frozen=True)
class Pairing:
    """How the spots of a frame were paired: the couples considered at what they cost in the end, and which of them are
    the pairs, in the pairs' order."""

    pairs: HighlightPairs
    considered: Candidates
    chosen: list[int]

    def log_odds(self, couple: int) -> float:
        """Log odds that a couple considered is a seed rather than chance; below LEAST_ODDS it is none."""
        return LEAST_ODDS + WORTH - self.considered.cost[couple]


def pair(spots: Highlights, calibration: Calibration) -> HighlightPairs:
    """Pair the spots of one frame. Every spot is in ``direct``, ``mirror`` or ``unpaired``, and only once."""
    return pairing(spots, calibration).pairs


def pairing(spots: Highlights, calibration: Calibration) -> Pairing:
    """As :func:`pair`, with how it came to that."""
    rays = reflection.rays(calibration.camera, spots.xy_px)
    found = candidates(spots, rays, calibration)
    chosen = best_matching(found.direct, found.mirror, found.cost, WORTH)
    if len(chosen) >= 3:
        found = _alike(found, chosen, spots.flux_sigma)
        chosen = best_matching(found.direct, found.mirror, found.cost, WORTH)
    lone = len(spots) - 2 * len(chosen)
    if lone > FEW:
        found = replace(found, cost=[c + log(lone / FEW) for c in found.cost])
        chosen = best_matching(found.direct, found.mirror, found.cost, WORTH)
    chosen = _outermost(found, chosen)
    couples = np.array([[ends[k] for k in chosen] for ends in (found.direct, found.mirror)], np.intp)
    flags = spots.flags[couples]
    left = np.ones(len(spots), np.bool_)
    left[couples] = False
    unpaired = left.nonzero()[0]
    why = _unpaired_flags(spots, rays, unpaired, found, chosen, calibration)
    pairs = HighlightPairs(couples[0], couples[1], unpaired, flags[0] | flags[1], why, rays)
    return Pairing(pairs, found, chosen)


def candidates(spots: Highlights, rays: FloatArray, calibration: Calibration) -> Candidates:
    """All couples that lie along the direction from direct to mirror spot and fit the model at all.

    ``rays`` (n, 9) are the spots' (:func:`inspector.reflection.rays`).
    """
    able = (spots.flags & NO_SEED == 0).nonzero()[0]
    given = (able, spots.xy_px, spots.covariance_px2, spots.flux_dn, spots.flux_sigma, rays)
    camera = calibration.camera
    rules = _rules(FEW / (camera.width_px * camera.height_px))
    arguments = (reflection.scene(calibration), rules, len(able), *(a.tobytes() for a in given))
    room, count = 0, COUPLES_A_SPOT * len(able) + 1
    while count > room:
        room = count
        couples, scores = np.empty((2, room), np.intp), np.empty((room, 3))
        count = _candidates(*arguments, room, out(couples[0]), out(couples[1]), out(scores))
    direct, mirror = couples[:, :count].tolist()
    cost, radius_mm, size = scores[:count].T.tolist()
    return Candidates(direct, mirror, cost, radius_mm, size)


def _alike(found: Candidates, chosen: list[int], flux_sigma: FloatArray) -> Candidates:
    """The candidates, dearer where the seed would be unlike those ``chosen``: too bright or dark for its radius."""
    sizes = sorted(found.size[k] for k in chosen)
    usual = (sizes[(len(sizes) - 1) // 2] + sizes[len(sizes) // 2]) / 2
    sigma = flux_sigma.tolist()
    cost = [
        c + min((size - usual) ** 2 / (SIZE_SIGMA**2 + sigma[d] ** 2) / 2, SIZE_COST)
        for c, size, d in zip(found.cost, found.size, found.direct, strict=True)
    ]
    return replace(found, cost=cost)


def _outermost(found: Candidates, chosen: list[int]) -> list[int]:
    """Where a couple could as well reach further to a spot that is left over, it does: the spot between is paint.

    The pool at a seed's foot throws a third spot between the two, on the mirror's side; nothing throws one beyond.
    """
    of_direct, of_mirror = {found.direct[k]: k for k in chosen}, {found.mirror[k]: k for k in chosen}
    wider: dict[int, list[int]] = defaultdict(list)
    for c in set(range(len(found.cost))).difference(chosen):
        k, radius = of_mirror.get(found.mirror[c]), found.radius_mm[c]
        if k is not None and found.radius_mm[k] < POOL_SHARE * radius:
            wider[k].append(c)
        k = of_direct.get(found.direct[c])
        if k is not None and (1 - POOL_SHARE) * radius < found.radius_mm[k] < radius:
            wider[k].append(c)
    taken = {*of_direct, *of_mirror}
    best = {k: k for k in chosen}
    for k in sorted(wider):
        ends = {found.direct[k], found.mirror[k]}
        free = [c for c in wider[k] if not ({found.direct[c], found.mirror[c]} - ends) & taken]
        fair = [c for c in free if found.cost[c] < found.cost[k] + POOL_ODDS]
        best[k] = min(fair, key=found.cost.__getitem__, default=k)
        taken |= {found.direct[best[k]], found.mirror[best[k]]}
    return list(best.values())


def _unpaired_flags(
    spots: Highlights,
    rays: FloatArray,
    unpaired: IntArray,
    found: Candidates,
    chosen: list[int],
    calibration: Calibration,
) -> IntArray:
    """What each spot (m,) that is left over may be: a paint pool, a seed whose other spot is used or unseen, dust."""
    flags = spots.flags[unpaired]
    if len(unpaired) == 0:
        return flags
    fits = np.array([k in found.of_mirror or k in found.of_direct for k in unpaired.tolist()])
    with np.errstate(invalid="ignore", divide="ignore"):  # a ray that misses the panel has no direction, and says no
        pool = _between(spots.xy_px, unpaired, found, chosen)
        drawn_out, leaves = _alone(spots.xy_px[unpaired], spots.blur_px2[unpaired], rays[unpaired], calibration)
    seed, dust = flags & NO_SEED == 0, flags & NO_DUST == 0
    what = np.where(dust, DUST, 0)
    for rule, flag in ((seed & leaves, PARTNER_OUTSIDE), (seed & drawn_out, MERGED), (fits, AMBIGUOUS), (pool, POOL)):
        what[rule] = flag
    return np.asarray(flags | what)


def _between(xy_px: FloatArray, unpaired: IntArray, found: Candidates, chosen: list[int]) -> npt.NDArray[np.bool_]:
    """Which spots (m,) lie between the two of a pair, and nearly in line with them."""
    if not chosen:
        return np.zeros(len(unpaired), np.bool_)
    direct, mirror = (xy_px[[ends[k] for k in chosen]] for ends in (found.direct, found.mirror))
    span = mirror - direct
    length = np.hypot(span[:, 0], span[:, 1])
    off = xy_px[unpaired][:, None] - direct
    along = (off * span).sum(axis=2) / length**2
    beside = np.abs(off[:, :, 0] * span[:, 1] - off[:, :, 1] * span[:, 0]) / length
    return np.asarray(((along > 0.1) & (along < 1.2) & (beside < POOL_BESIDE_PX + BEND_SHARE * length)).any(axis=1))


def _alone(
    xy_px: FloatArray, blur_px2: FloatArray, rays: FloatArray, calibration: Calibration
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
    """Which spots (m,) are drawn out the way a seed's two lie, and which have no room beside them for the other."""
    step = PROBE_RADIUS_MM * reflection.directions(rays, calibration)
    x, y = (step / np.hypot(step[:, 0], step[:, 1])[:, None]).T
    xx, xy, yy = blur_px2.T
    along = x * x * xx + 2 * x * y * xy + y * y * yy
    ends = np.stack([xy_px + step, xy_px - step])
    frame = np.array([calibration.camera.width_px, calibration.camera.height_px]) - 0.5
    leaves = ((ends < -0.5) | (ends > frame)).any(axis=(0, 2))
    return np.asarray(along > DRAWN_OUT * (xx + yy - along)), np.asarray(leaves)
