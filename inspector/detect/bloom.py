"""Spots whose charge ran over, measured with the overflow in the model (`_bloom.c`).

A linear sensor without enough anti-blooming fills the pixels along a column once one is full. The light that fell is
then known only through where the charge went: each full pixel passes its excess half up, half down, and a share
``kept`` survives each step. That share is the sensor's; the frame's lone spots tell it for those that touch.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from inspector.detect import kernel
from inspector.detect.fit import BLUR2, FLUX, Fitted, Response
from inspector.detect.kernel import Detected
from inspector.detect.spots import SATURATED_PX, Spots
from inspector.model import FloatArray, Image, IntArray

CHARGE_SHARE = 0.15
"""Only pixels above this share of full scale count as charge: fainter light is halo, uneven on lit and dark ground."""
MARGIN_PX = 3
"""Dark border of a patch around a cluster's lit pixels."""
KEPT, KEPT_SIGMA, SAME_KEPT_SIGMA = 0.75, 0.25, 0.02
"""Share of the overflow that survives a step: expected before the frame is seen, and once its lone spots told."""
BLUR_SIGMA = 0.08
"""Standard deviation of log blur variance among the spots of a frame."""
FLUX_SIGMA = 1.5
"""Standard deviation of log flux about the first guess, which counts clipped charge only."""
PLACE_SIGMA_PX = 1.5
"""Standard deviation of the first guess of a centre."""
END_SHARE = 0.08
"""How well the level of the last pixel that charge reached is known, as a share of full scale."""
POOR_CHI2, POOR_RATIO, HIDDEN_GAIN, MOST_HIDDEN = 25.0, 2.0, 0.5, 2
"""A cluster's fit is poor past this chi2 and this multiple of the frame's best; an added spot must halve it."""
FLUX_STARTS = (0.0, 1.5)
"""First guesses of log flux, over what the clipped pixels hold: of a spot far over full scale most charge is lost."""
LENS_QUANTILE = 0.25
"""Of the lone spots' blurs this quantile is the lens': halos make the brightest ones wider."""
HIDDEN_PLACES = 3
"""So many places are tried for each added spot."""
BRIGHT_SHARE = 0.5
"""No spot hides in pixels under this share of full scale: what is too much there is a brighter one's halo."""
MOST_SPOTS, MOST_PIXELS = 12, 6000
"""Larger tangles are left as the plain fit found them."""
MOST_CLUSTERS = 100
"""In a frame with more clipped components none is solved: it is over-exposed beyond what the time is worth."""
ROUNDS = 30
SHARED = 5
"""Shared parameters of a patch: level, two slopes, log blur variance, kept."""


@dataclass(frozen=True)
class Cluster:
    """One fit: its ``members`` (k,) among the spots, patch corner (x, y), light and weight (h, w), first guess."""

    members: IntArray
    corner: IntArray
    light: FloatArray
    weight: FloatArray
    start: FloatArray


@dataclass(frozen=True)
class Solved:
    """A cluster's parameters (3 k + 5,), their covariance, and chi2 per degree of freedom."""

    cluster: Cluster
    theta: FloatArray
    covariance: FloatArray
    chi2: float
    deviation: FloatArray

    @property
    def places(self) -> FloatArray:
        """Centres (k, 2) px in the frame."""
        return np.asarray(self.theta[:-SHARED].reshape(-1, 3)[:, :2] + self.cluster.corner)

    @property
    def fluxes(self) -> FloatArray:
        """Flux (k,) DN px."""
        return np.asarray(np.exp(self.theta[:-SHARED].reshape(-1, 3)[:, 2]))

    @property
    def place_covariance(self) -> FloatArray:
        """Covariance (k, 2, 2) of the centres, px^2, scaled by what did not fit."""
        blocks = [self.covariance[n : n + 2, n : n + 2] for n in range(0, len(self.theta) - SHARED, 3)]
        return np.stack(blocks) * max(self.chi2, 1.0)

    @property
    def blur_px2(self) -> float:
        """Variance of the blur, px^2."""
        return float(np.exp(self.theta[-2]))

    @property
    def kept(self) -> float:
        """The share of overflow that survived each step."""
        return float(self.theta[-1])


def charge(lit: Detected, spots: Spots, ground_light: FloatArray, response: Response) -> tuple[FloatArray, FloatArray]:
    """Centroids (n, 2) of the lit pixels nearest to each spot, weighted by light over its ground (n,), and their sum.

    Charge runs both ways alike and clipping is even on both sides, so what is left of a lone spot's keeps its centre.
    """
    n, owner = len(spots), _owners(lit, spots)
    at = np.column_stack([lit.columns, lit.rows]).astype(np.float64)
    ground = ground_light[owner]
    weight = response.light(lit.grey_dn) - ground
    weight[weight < CHARGE_SHARE * (response.sensor.saturation_dn - ground)] = 0.0
    total = np.maximum(np.bincount(owner, weight, n), 1.0)
    moments = np.column_stack([np.bincount(owner, weight * at[:, k], n) for k in (0, 1)])
    return np.where(total[:, None] > 1, moments / total[:, None], spots.centre_px), total


def _owners(lit: Detected, spots: Spots) -> IntArray:
    """Which spot each lit pixel belongs to: of those of its component the nearest."""
    first = np.zeros(lit.components, np.intp)
    first[spots.component] = np.arange(len(spots))
    owner = first[lit.component]
    for home in np.flatnonzero(np.bincount(spots.component, minlength=lit.components) > 1):
        pixels, members = np.flatnonzero(lit.component == home), np.flatnonzero(spots.component == home)
        at = np.column_stack([lit.columns[pixels], lit.rows[pixels]])
        owner[pixels] = members[np.abs(at[:, None] - spots.centre_px[members]).sum(axis=2).argmin(axis=1)]
    return owner


def refine(image: Image, lit: Detected, spots: Spots, fitted: Fitted, response: Response) -> tuple[Spots, list[Solved]]:
    """The clusters of a blooming frame's clipped spots, solved; and the spots with those found hidden in them."""
    blur2 = max(float(np.median(fitted.table[:, BLUR2])) - 1 / 12, 0.1)
    clusters = [c for c in _clusters(image, lit, spots, fitted, response) if c is not None]
    first = [_solve(c, spots, response, blur2, KEPT, KEPT_SIGMA) for c in clusters]
    alone = [s for s in first if len(s.cluster.members) == 1]
    kept, sigma = (float(np.median([s.kept for s in alone])), SAME_KEPT_SIGMA) if alone else (KEPT, KEPT_SIGMA)
    if len(alone) >= 3:
        blur2 = float(np.quantile([s.blur_px2 for s in alone], LENS_QUANTILE))
    least = min((s.chi2 for s in first), default=0.0)
    solved = []
    for found in first:
        if len(found.cluster.members) > 1 or found.chi2 > POOR_CHI2 + POOR_RATIO * least:
            found = _solve(found.cluster, spots, response, blur2, kept, sigma)
            found, spots = _with_hidden(found, spots, response, blur2, kept, sigma, least)
        solved.append(found)
    return spots, solved


def _with_hidden(
    found: Solved, spots: Spots, response: Response, blur2: float, kept: float, sigma: float, least: float
) -> tuple[Solved, Spots]:
    """The cluster with spots added where it shows too much light, as long as each halves what does not fit."""
    for _ in range(MOST_HIDDEN):
        if found.chi2 <= POOR_CHI2 + POOR_RATIO * least or len(found.cluster.members) == MOST_SPOTS:
            break
        trials = [_with_one_at(place, found, spots, response, blur2, kept, sigma) for place in _excess(found, response)]
        trial, crowd = min(trials, key=lambda t: t[0].chi2)
        if trial.chi2 > HIDDEN_GAIN * found.chi2:
            break
        found, spots = trial, crowd
    return found, spots


def _with_one_at(
    place: FloatArray, found: Solved, spots: Spots, response: Response, blur2: float, kept: float, sigma: float
) -> tuple[Solved, Spots]:
    """The cluster with one spot more, which begins at ``place`` (x, y) of the patch."""
    c = found.cluster
    own = found.theta[: 3 * len(c.members)]
    crowd = spots.with_more(c.members[:1], (place + c.corner)[None])
    start = np.concatenate([own, place, [own[2::3].min() - 0.7], found.theta[-5:-2]])
    wider = replace(c, members=np.append(c.members, len(crowd) - 1), start=start)
    return _solve(wider, crowd, response, blur2, kept, sigma), crowd


def _excess(found: Solved, response: Response) -> FloatArray:
    """The bright places (k, 2), x and y, of a cluster's patch where there is most light too much, largest first."""
    smooth, places = _smooth(found.deviation), []
    smooth[found.cluster.light < BRIGHT_SHARE * response.sensor.saturation_dn] = -np.inf
    for _ in range(HIDDEN_PLACES):
        row, column = np.unravel_index(smooth.argmax(), smooth.shape)
        places.append((column, row))
        smooth[max(row - 2, 0) : row + 3, max(column - 2, 0) : column + 3] = -np.inf
    return np.array(places, np.float64)


def _smooth(deviation: FloatArray) -> FloatArray:
    """Deviations summed over 3 x 3 pixels: a hidden spot is as wide."""
    wide, (height, width) = np.pad(deviation, 1), deviation.shape
    return np.asarray(np.sum([wide[r : r + height, c : c + width] for r in range(3) for c in range(3)], axis=0))


def _clusters(image: Image, lit: Detected, spots: Spots, fitted: Fitted, response: Response) -> list[Cluster | None]:
    """The components that hold a clipped spot, each with all its spots; None for one too large to solve."""
    homes = np.unique(spots.component[spots.clipped])
    return [_cluster(image, lit, spots, fitted, response, int(home)) for home in homes]


def _cluster(
    image: Image, lit: Detected, spots: Spots, fitted: Fitted, response: Response, home: int
) -> Cluster | None:
    """One component's patch. Light of other components, and next to it, has no weight."""
    members = np.flatnonzero(spots.component == home)
    rows, columns = lit.rows[lit.component == home], lit.columns[lit.component == home]
    top, left = max(int(rows.min()) - MARGIN_PX, 0), max(int(columns.min()) - MARGIN_PX, 0)
    grey = image[top : int(rows.max()) + MARGIN_PX + 1, left : int(columns.max()) + MARGIN_PX + 1].astype(np.float64)
    if len(members) > MOST_SPOTS or grey.size > MOST_PIXELS:
        return None
    light = response.light(grey)
    clipped = grey >= response.clipped_dn
    light[clipped] = response.sensor.saturation_dn
    level = float(np.median(light[0])) if light.shape[0] else 0.0
    weight = 1 / response.variance(light)
    weight[_foreign(lit, home, top, left, grey.shape)] = 0.0
    corner = np.array([left, top])
    place = spots.centre_px[members] - corner
    flux = np.log(np.maximum(fitted.table[members, FLUX], _clipped_charge(spots, members, response)))
    start = np.concatenate([np.column_stack([place, np.minimum(flux, _most_flux(spots, members, response))]).ravel()])
    return Cluster(members, corner, light, weight, np.append(start, [level, 0.0, 0.0]))


def _clipped_charge(spots: Spots, members: IntArray, response: Response) -> FloatArray:
    """Charge (k,) DN px that the clipped pixels hold at the least."""
    return np.asarray(np.maximum(spots.table[members, SATURATED_PX], 0.5) * response.sensor.saturation_dn)


def _most_flux(spots: Spots, members: IntArray, response: Response) -> FloatArray:
    """Log of a flux (k,) that no spot of so many clipped pixels has: a runaway first guess starts here."""
    return np.log(_clipped_charge(spots, members, response) * 8)


def _foreign(lit: Detected, home: int, top: int, left: int, shape: tuple[int, ...]) -> npt.NDArray[np.bool_]:
    """Where (h, w) of a patch the light of other components lies, one pixel around it included."""
    mask = np.zeros((shape[0] + 2, shape[1] + 2), np.bool_)
    rows, columns = lit.rows - top + 1, lit.columns - left + 1
    other = (lit.component != home) & (rows >= 0) & (rows < mask.shape[0]) & (columns >= 0) & (columns < mask.shape[1])
    mask[rows[other], columns[other]] = True
    wide = mask.copy()
    for dr in (-1, 0, 1):
        for dc in (-1, 0, 1):
            wide |= np.roll(mask, (dr, dc), (0, 1))
    return wide[1:-1, 1:-1]


def _solve(cluster: Cluster, spots: Spots, response: Response, blur2: float, kept: float, kept_sigma: float) -> Solved:
    """Fit one cluster, with the overflow's share expected at ``kept`` +/- ``kept_sigma``."""
    k = len(cluster.members)
    start = np.append(cluster.start, [np.log(max(blur2, 0.1)), kept])
    sigma = np.concatenate(
        [np.tile([PLACE_SIGMA_PX, PLACE_SIGMA_PX, FLUX_SIGMA], k), [1e6, 5.0, 5.0, BLUR_SIGMA, kept_sigma]]
    )
    prior = sigma**-2.0
    done = min((_tried(cluster, spots, response, start, prior, up) for up in FLUX_STARTS), key=lambda d: d.cost)
    freedom = max(int((cluster.weight > 0).sum()) - len(start), 1)
    return Solved(cluster, done.theta, done.covariance, done.cost / freedom, done.deviation)


def _tried(
    cluster: Cluster, spots: Spots, response: Response, start: FloatArray, prior: FloatArray, brighter: float
) -> kernel.BloomFit:
    """One fit, from a first guess with all fluxes raised by a factor e to the ``brighter``."""
    guess = start.copy()
    guess[2 : 3 * len(cluster.members) : 3] += brighter
    full = response.sensor.saturation_dn
    return kernel.bloom_fit(
        cluster.light,
        cluster.weight,
        along_rows=spots.bloom[0] != 0,
        full_dn=full,
        end_variance=(END_SHARE * full) ** 2,
        start=guess,
        prior=prior,
        rounds=ROUNDS,
    )
