"""Where a spot's centre is, to a hundredth of a pixel: a Gaussian on a sloping background, by least squares.

A seed's highlight is 0.04 to 0.2 px wide for a 1 mm seed, so what the sensor shows is the lens' blur, near enough a
Gaussian (J. Anderson, I. King, PASP 112, 2000, say why a fitted profile beats a centroid on under-sampled spots).
A clipped pixel asks only that the model be at least as bright: the flanks carry the position. Where charge blooms,
clipped pixels and the ends of their runs tell nothing. Neighbours are subtracted with their own latest model, and
spots that touch are solved together. The blur of a spot is held near what the frame's spots show, each by how well it
knows its own: flanks tell position well but blur badly, and faint spots both. The loops are in `_fit.c`,
`_equations.c` and `_tangles.c`; this file sets what they go by.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from inspector.model import FloatArray
from inspector.optics import Sensor

X, Y, VARIANCE_X, COVARIANCE_XY, VARIANCE_Y, PEAK, FLUX, BLUR2, CHI2 = range(9)
MISFIT_X, MISFIT_Y, MISFIT_SIGMA, GROUND, BLUR_XX, BLUR_XY, BLUR_YY = range(9, 16)
"""Columns of what the fit found, as `_kernel.h` numbers them."""
WINDOW_RADIUS_PX = (4.0, 12.0)
"""Radius of the fit's windows, least and most: the spot and two pixels of background around it."""
ROUNDS, SETTLED_PX = 40, 0.002
"""Gauss-Newton rounds at most, and the move under which a fit has settled; isolated spots take four or five."""
MOST_WORK = 750_000.0
"""Work that a round is worth, in pixels at which a Gaussian is evaluated; a frame of 200 spots takes a tenth.
Tangles past it, the largest first, are solved spot by spot, or, if that is too much as well, not at all."""
HELD_SHARE, FREE_SHARE = 0.1, 0.15
"""How far the blur's variance may be from the usual, as a share of it: clipped or touching spots, free ones."""
SCATTER_SHARE = 0.1
"""How much the blur's variance scatters among the spots of a frame, as a share of it: no spot tells it better."""
SHARPER = 30.0
"""How much more a spot is held that would be sharper than the frame's usual: no spot is sharper than the lens."""
KEPT_SHARE = 0.01
"""Spots are held near the same usual blur until the frame's is this share off it."""
STEEP_SHARE = 0.1
"""A background slope of this share of the peak a pixel is already unlikely."""
TANGLED_PX, DAMPING = 6.0, 0.1
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

    @property
    def read_dn(self) -> float:
        """Standard deviation of a dark pixel, DN."""
        return max(self.noise_dn, 0.5 * self.sensor.saturation_dn / 255)

    @property
    def shot_per_dn(self) -> float:
        """Variance that a DN of light over the background adds, DN^2."""
        return self.sensor.saturation_dn / 255 / ELECTRONS_PER_DN_8BIT

    @cached_property
    def level(self) -> float:
        """The background in linear light, DN."""
        return float(self.light(np.array([self.level_dn]))[0])

    def variance(self, light: FloatArray) -> FloatArray:
        """Variance of linear light, DN^2: read noise, shot noise over the background, pattern."""
        shot = np.maximum(light - self.level, 0.0) * self.shot_per_dn
        return np.asarray(self.read_dn**2 + shot + (PATTERN_SHARE * light) ** 2)

    def rules(self, bloom: tuple[int, int], threshold_dn: float) -> bytes:
        """What the fit goes by: `Rules` of `_fit.h`. ``bloom``: from a clipped pixel to where its charge runs."""
        light = (self.black_dn, self.sensor.gamma, self.clipped_dn, self.sensor.saturation_dn, self.level)
        noise = (self.read_dn, self.shot_per_dn, PATTERN_SHARE)
        shares = (HELD_SHARE, FREE_SHARE, STEEP_SHARE, SCATTER_SHARE, SHARPER, KEPT_SHARE)
        windows = (threshold_dn, *WINDOW_RADIUS_PX, TANGLED_PX, DAMPING, SETTLED_PX)
        return struct.pack("21d3q", *light, *noise, *windows, *shares, MOST_WORK, *bloom, ROUNDS)


@dataclass(frozen=True)
class Fitted:
    """What the fit found of n spots, ``table`` (n, 16): the columns above, lengths in px, light in DN."""

    table: FloatArray

    def __len__(self) -> int:
        return len(self.table)

    @property
    def xy_px(self) -> FloatArray:
        """Centres (n, 2)."""
        return self.table[:, : Y + 1]

    @property
    def covariance_px2(self) -> FloatArray:
        """Covariance (n, 2, 2) of the centres, from the noise alone; NaN where the fit has no one answer."""
        xx, xy, yy = range(VARIANCE_X, VARIANCE_Y + 1)
        return self.table[:, (xx, xy, xy, yy)].reshape(-1, 2, 2)

    @property
    def chi2(self) -> FloatArray:
        """Misfit (n,) per degree of freedom: 1 where the noise is as assumed and the profile fits."""
        return self.table[:, CHI2]

    @property
    def misfit_px(self) -> FloatArray:
        """The pixel (n, 2) where the data exceed the model most."""
        return self.table[:, MISFIT_X : MISFIT_Y + 1]
