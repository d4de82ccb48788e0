"""Where a spot's centre is, to a hundredth of a pixel: an elliptical Gaussian on a sloping background, by least squares.

A seed's highlight is 0.04 to 0.2 px wide for a 1 mm seed, so what the sensor shows is the lens' blur, near enough a
Gaussian (J. Anderson, I. King, PASP 112, 2000, say why a fitted profile beats a centroid on under-sampled spots).
Saturated pixels, and those that bloomed charge ran into, are left out: the flanks carry the position. Neighbours are
subtracted with their own latest model, so that interleaved and touching spots settle together.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from inspector.detect.lit import least_labels
from inspector.model import FloatArray, IntArray

ROUNDS = 40
"""Gauss-Newton rounds at most; isolated spots settle in four or five."""
SETTLED_PX = 0.002
"""A round that moves no spot by more ends the fit."""
HELD_BLUR_SHARE = 0.1
"""How far a clipped spot's blur may be from the frame's usual, as a share of the variance."""
FREE_BLUR_SHARE = 1.0
"""The same for typical spots, from their own first guess."""
STEEP_SHARE = 0.1
"""A background slope of this share of the peak a pixel is already unlikely."""
TANGLED_PX = 6
"""Spots nearer than this along both axes are solved together; others settle by taking turns."""
TANGLE_DAMPING = 0.1
"""Levenberg's damping of a tangle's steps, as a share of the diagonal."""
BLUR_TURNS = (1, 3, 6)
"""Rounds at which the usual blur is taken from the typical spots as they stand."""
PARAMETERS, SHAPE = 9, 6
X, Y, LOG_PEAK, SXX, SXY, SYY, BACKGROUND, SLOPE_X, SLOPE_Y = range(PARAMETERS)


@dataclass
class Windows:
    """Round cut-outs around n spots: linear light (n, p), its variance (n, p), offsets dx, dy (p,) from the centres.

    ``usable`` (n, p) is False outside the image and where a pixel tells nothing (bloomed into). Of a ``clipped`` (n, p)
    pixel only that its light is at least the value given is known.
    """

    light: FloatArray
    variance: FloatArray
    usable: npt.NDArray[np.bool_]
    clipped: npt.NDArray[np.bool_]
    dx: FloatArray
    dy: FloatArray
    centre_px: FloatArray

    @cached_property
    def plane(self) -> FloatArray:
        """Derivatives (3, p) of the background by its level and slopes."""
        return np.stack([np.ones_like(self.dx), self.dx, self.dy])

    @cached_property
    def clips(self) -> bool:
        """Whether any pixel is clipped."""
        return bool(self.clipped.any())


@dataclass(frozen=True)
class Fitted:
    """Centres (n, 2) px with covariance (n, 2, 2), peak (n,) DN, blur covariance (n, 3) px^2, chi2 (n,) per freedom.

    ``misfit_px`` (n, 2) is the pixel where the data exceed the model most, by ``misfit_sigma`` (n,) deviations.
    """

    xy_px: FloatArray
    covariance_px2: FloatArray
    peak_dn: FloatArray
    blur_px2: FloatArray
    chi2: FloatArray
    background_dn: FloatArray
    misfit_px: FloatArray
    misfit_sigma: FloatArray


def profile(theta: FloatArray, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The spots' Gaussians at offsets x, y (n, p): values (n, p) DN, and Sigma^-1 d as two (n, p) arrays."""
    sxx, sxy, syy = theta[:, SXX, None], theta[:, SXY, None], theta[:, SYY, None]
    det = sxx * syy - sxy * sxy
    a, b, d = syy / det, sxy / det, sxx / det
    ex, ey = x - theta[:, X, None], y - theta[:, Y, None]
    ux, uy = a * ex - b * ey, d * ey - b * ex
    exponent = theta[:, LOG_PEAK, None] - 0.5 * (ux * ex + uy * ey)
    return np.exp(np.minimum(exponent, 40.0, out=exponent), out=exponent), ux, uy


def neighbours(centres: FloatArray, reach_px: float) -> tuple[IntArray, IntArray]:
    """Index pairs (i, j), i != j, nearer than ``reach_px`` in x and in y."""
    near = np.abs(centres[:, None] - centres[None]).max(axis=2) <= reach_px
    np.fill_diagonal(near, False)
    return tuple(np.nonzero(near))  # type: ignore[return-value]  # two arrays for a matrix


def fit(windows: Windows, start: FloatArray, typical: npt.NDArray[np.bool_], reach_px: float) -> Fitted:
    """Fit n spots at once. ``start`` (n, 9) parameters, positions as offsets from the window centres.

    The blur of spots that are not ``typical`` (n,), the clipped ones above all, is held near that of those that are:
    flanks tell position well but blur badly. ``reach_px``: spots nearer to each other see each other's light.
    """
    theta, w = start.copy(), windows
    expected = start.copy()
    expected[:, (SLOPE_X, SLOPE_Y)] = 0.0
    prior = _prior(start, typical)
    weight = np.where(w.usable, 1 / w.variance, 0.0)
    i, j = neighbours(w.centre_px, reach_px)
    between = w.centre_px[i] - w.centre_px[j]
    tangles = _tangles(w.centre_px, i, j)
    for turn in range(ROUNDS):
        if turn in BLUR_TURNS and typical.any() and not typical.all():
            expected[~typical, SXX : SYY + 1] = np.median(theta[typical, SXX : SYY + 1], axis=0)
        residual, jacobian = _linearise(theta, w, i, j, between)
        weighted = jacobian * weight[:, None, :]
        normal = weighted @ jacobian.transpose(0, 2, 1)
        diagonal = np.einsum("nkk->nk", normal)
        diagonal += prior + 1e-9 * diagonal
        gradient = (weighted @ residual[:, :, None])[:, :, 0] - prior * (theta - expected)
        step = np.linalg.solve(normal, gradient[:, :, None])[:, :, 0]
        for tangle in tangles:
            step[tangle] = _joint_step(theta, w, weighted, normal, gradient, tangle)
        theta += _limited(step, theta)
        if np.abs(step[:, :2]).max(initial=0.0) < SETTLED_PX:
            break
    return _report(theta, w, weight, normal, *_linearise(theta, w, i, j, between))


def _report(
    theta: FloatArray,
    w: Windows,
    weight: FloatArray,
    normal: FloatArray,
    residual: FloatArray,
    jacobian: FloatArray,
) -> Fitted:
    """What the fit found, with each spot's misfit."""
    deviations = residual * np.sqrt(weight)
    worst = deviations.argmax(axis=1)
    freedom = np.maximum((w.usable & ~w.clipped).sum(axis=1) - PARAMETERS, 1)
    return Fitted(
        xy_px=w.centre_px + theta[:, :2],
        covariance_px2=np.linalg.inv(normal)[:, :2, :2],
        peak_dn=np.exp(theta[:, LOG_PEAK]),
        blur_px2=theta[:, SXX : SYY + 1],
        chi2=(deviations * deviations).sum(axis=1) / freedom,
        background_dn=theta[:, BACKGROUND],
        misfit_px=w.centre_px + np.column_stack([w.dx[worst], w.dy[worst]]),
        misfit_sigma=deviations[np.arange(len(theta)), worst],
    )


def _tangles(centres: FloatArray, i: IntArray, j: IntArray) -> list[IntArray]:
    """Groups of spots so near to each other that they must be solved together: index arrays."""
    close = np.abs(centres[i] - centres[j]).max(axis=1) <= TANGLED_PX
    if not close.any():
        return []
    label = least_labels(len(centres), i[close], j[close])
    size = np.bincount(label)
    return [np.flatnonzero(label == k) for k in np.flatnonzero(size > 1)]


def _joint_step(
    theta: FloatArray, w: Windows, weighted: FloatArray, normal: FloatArray, gradient: FloatArray, tangle: IntArray
) -> FloatArray:
    """Newton step (k, 9) of a tangle: each spot's own equations, with what its neighbours' parameters do to them."""
    k = len(tangle)
    system = np.zeros((k, PARAMETERS, k, PARAMETERS))
    for a, i in enumerate(tangle):
        system[a, :, a] = normal[i] + TANGLE_DAMPING * np.diag(np.diag(normal[i]))
        others = np.delete(np.arange(k), a)
        between = w.centre_px[i] - w.centre_px[tangle[others]]
        spot, ux, uy = profile(theta[tangle[others]], w.dx + between[:, :1], w.dy + between[:, 1:])
        derivatives = np.empty((k - 1, SHAPE, len(w.dx)))
        _derivatives(spot, ux, uy, derivatives)
        system[a][:, others, :SHAPE] = (derivatives @ weighted[i].T).transpose(2, 0, 1)
    step = np.linalg.lstsq(
        system.reshape(k * PARAMETERS, -1), gradient[tangle].reshape(-1), rcond=1e-12
    )[0]
    return step.reshape(k, PARAMETERS)


def _derivatives(spot: FloatArray, ux: FloatArray, uy: FloatArray, out: FloatArray) -> None:
    """Derivatives of the spots' Gaussians by position, log peak and blur, into ``out`` (n, 6 or more, p)."""
    sx, sy = spot * ux, spot * uy
    out[:, X], out[:, Y], out[:, LOG_PEAK] = sx, sy, spot
    np.multiply(sx, ux, out=out[:, SXX])
    np.multiply(sx, uy, out=out[:, SXY])
    np.multiply(sy, uy, out=out[:, SYY])
    out[:, SXX] *= 0.5
    out[:, SYY] *= 0.5


def _linearise(
    theta: FloatArray, w: Windows, i: IntArray, j: IntArray, between: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Residual (n, p) and the model's derivatives (n, 9, p)."""
    jacobian = np.empty((len(theta), PARAMETERS, w.light.shape[1]))
    spot, ux, uy = profile(theta, w.dx, w.dy)
    _derivatives(spot, ux, uy, jacobian)
    jacobian[:, BACKGROUND:] = w.plane
    residual = w.light - spot - theta[:, BACKGROUND:] @ w.plane
    if len(i):
        other, _, _ = profile(theta[j], w.dx + between[:, :1], w.dy + between[:, 1:])
        np.subtract.at(residual, i, other)
    if w.clips:
        met = w.clipped & (residual < 0)
        residual[met] = 0.0
        jacobian.transpose(0, 2, 1)[met] = 0.0
    return residual, jacobian


def _prior(start: FloatArray, typical: npt.NDArray[np.bool_]) -> FloatArray:
    """Inverse variances (n, 9) of what is expected beforehand: a blur near the usual, a slope that is not steep."""
    prior = np.zeros((len(start), PARAMETERS))
    spread = np.where(typical, FREE_BLUR_SHARE, HELD_BLUR_SHARE) * start[:, SXX]
    prior[:, SXX : SYY + 1] = (1 / spread[:, None]) ** 2
    steep = STEEP_SHARE * np.exp(np.minimum(start[:, LOG_PEAK], 6.0)) + 2.0
    prior[:, SLOPE_X : SLOPE_Y + 1] = (1 / steep[:, None]) ** 2
    return prior


def _limited(step: FloatArray, theta: FloatArray) -> FloatArray:
    """Keep a round's step where the linear model can be believed: half a pixel, a factor e, a third of the blur."""
    bound = np.empty((len(step), SHAPE))
    bound[:, :LOG_PEAK] = 0.5
    bound[:, LOG_PEAK] = 1.0
    bound[:, SXX:] = 0.3 * np.minimum(theta[:, SXX], theta[:, SYY])[:, None]
    step[:, :SHAPE] = np.minimum(np.maximum(step[:, :SHAPE], -bound), bound)
    return step
