"""Where a spot's centre is, to a hundredth of a pixel: a Gaussian on a sloping background, by least squares.

A seed's highlight is 0.04 to 0.2 px wide for a 1 mm seed, so what the sensor shows is the lens' blur, near enough a
Gaussian (J. Anderson, I. King, PASP 112, 2000, say why a fitted profile beats a centroid on under-sampled spots).
A clipped pixel asks only that the model be at least as bright: the flanks carry the position. Where charge blooms,
clipped pixels and the ends of their runs tell nothing. Neighbours are subtracted with their own latest model, and
spots that touch are solved together. The loops are in `_kernel.c`; this file sets what they go by.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from inspector.detect import kernel
from inspector.model import FloatArray, Image, IntArray
from inspector.optics import Sensor

PARAMETERS = 9
X, Y, LOG_PEAK, SXX, SXY, SYY, BACKGROUND, SLOPE_X, SLOPE_Y = range(PARAMETERS)
"""A spot's parameters: centre, log of its peak, blur covariance, background with slopes."""
ROUNDS, SETTLED_PX = 40, 0.002
"""Gauss-Newton rounds at most, and the move under which a fit has settled; isolated spots take four or five."""
HELD_SHARE, FREE_SHARE = 0.1, 1.0
"""How far the blur's variance may be from the usual, as a share of it: clipped or touching spots, typical ones."""
STEEP_SHARE = 0.1
"""A background slope of this share of the peak a pixel is already unlikely."""
TANGLED_PX, DAMPING = 6, 0.1
"""Spots nearer than this along both axes are solved together; Levenberg's damping of such steps."""
SATURATED_SHARE = 0.98
"""Pixels at this share of full scale are taken as clipped: pattern noise comes after the clip on many sensors."""
ELECTRONS_PER_DN_8BIT = 60.0
"""Shot noise of a common 15,000 electron well on 255 DN; each fit's own residual corrects it."""
PATTERN_SHARE = 0.006
"""Photo-response non-uniformity as a share of the signal (EMVA 1288 data sheets: 0.3 to 1 %)."""


@dataclass(frozen=True)
class Response:
    """Grey values to linear light on a scale on which full scale stays where it is, and the noise of that light."""

    sensor: Sensor
    level_dn: float
    noise_dn: float
    darkest_dn: float

    @property
    def black_dn(self) -> float:
        """The sensor's black, DN: from the calibration, or the darkest that the frame shows."""
        return self.darkest_dn if self.sensor.black_dn is None else self.sensor.black_dn

    @property
    def clipped_dn(self) -> float:
        """Grey values from here on are clipped, DN."""
        return SATURATED_SHARE * self.sensor.saturation_dn

    def light(self, grey_dn: FloatArray) -> FloatArray:
        """Linear light of grey values, in DN of a linear sensor: grey = black + span (light / span) ** gamma."""
        if self.sensor.gamma == 1:
            return grey_dn
        span = self.sensor.saturation_dn - self.black_dn
        return np.asarray(
            np.maximum((grey_dn - self.black_dn) / span, 0.0) ** (1 / self.sensor.gamma) * span + self.black_dn
        )

    def variance(self, light: FloatArray) -> FloatArray:
        """Variance of linear light, DN^2: read noise, shot noise over the background, pattern."""
        rules = self.rules((0, 0), 0.0)
        signal = np.maximum(light - rules.level, 0.0)
        return np.asarray(rules.read_dn**2 + signal * rules.shot_per_dn + (rules.pattern * light) ** 2)

    def rules(self, bloom: tuple[int, int], reach_px: float) -> kernel.Rules:
        """What the fit goes by. ``bloom``: rows and columns from a clipped pixel to where its charge runs."""
        scale = self.sensor.saturation_dn / 255
        return kernel.Rules(
            black=self.black_dn,
            gamma=self.sensor.gamma,
            clipped=self.clipped_dn,
            full=self.sensor.saturation_dn,
            level=float(self.light(np.array([self.level_dn]))[0]),
            read_dn=max(self.noise_dn, 0.5 * scale),
            shot_per_dn=scale / ELECTRONS_PER_DN_8BIT,
            pattern=PATTERN_SHARE,
            reach_px=reach_px,
            tangled_px=TANGLED_PX,
            damping=DAMPING,
            settled_px=SETTLED_PX,
            held_share=HELD_SHARE,
            free_share=FREE_SHARE,
            steep_share=STEEP_SHARE,
            bloom_rows=bloom[0],
            bloom_columns=bloom[1],
            rounds=ROUNDS,
        )


@dataclass(frozen=True)
class Fitted:
    """Centres (n, 2) px with covariance (n, 2, 2), peak (n,) DN, flux (n,) DN px, blur variance (n,) px^2, chi2 (n,).

    ``misfit_px`` (n, 2) is the pixel where the data exceed the model most, by ``misfit_sigma`` (n,) deviations.
    """

    xy_px: FloatArray
    covariance_px2: FloatArray
    peak_dn: FloatArray
    flux_dn: FloatArray
    blur_px2: FloatArray
    chi2: FloatArray
    misfit_px: FloatArray
    misfit_sigma: FloatArray


def fit(
    image: Image,
    response: Response,
    bloom: tuple[int, int],
    centre: IntArray,
    radius: FloatArray,
    typical: npt.NDArray[np.bool_],
    start: FloatArray,
) -> Fitted:
    """Fit n spots at once in round windows around integer ``centre`` (n, 2) x, y of ``radius`` (n,) px.

    ``start`` (n, 9): first guesses, positions as offsets from the centres. The blur of spots that are not ``typical``
    (n,), the clipped ones above all, is held near that of those that are: flanks tell position well but blur badly.
    """
    done = kernel.fit(image, response.rules(bloom, 2 * float(radius.max())), centre, radius, typical, start)
    theta = done.theta
    peak = np.exp(theta[:, LOG_PEAK])
    blur2 = np.sqrt(np.maximum(theta[:, SXX] * theta[:, SYY] - theta[:, SXY] ** 2, 1e-6))
    return Fitted(
        xy_px=centre + theta[:, :2],
        covariance_px2=done.covariance,
        peak_dn=peak,
        flux_dn=2 * np.pi * blur2 * peak,
        blur_px2=blur2,
        chi2=done.chi2,
        misfit_px=(centre + done.misfit).astype(np.float64),
        misfit_sigma=done.misfit_sigma,
    )
