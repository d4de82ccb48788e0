"""Image -> highlights: lit components, split into spots, each with a sub-pixel centre and its covariance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from inspector.detect import bloom, kernel
from inspector.detect import fit as fitting
from inspector.detect import lit as lit_stage
from inspector.detect.fit import Response
from inspector.detect.lit import Background, Lit
from inspector.detect.spots import Spots, find_spots
from inspector.model import Flag, FloatArray, Highlights, Image, IntArray, Reason
from inspector.optics import Sensor
from inspector.recipe import Detection

Bools = npt.NDArray[np.bool_]

OVERLIT_SHARE = 0.6
"""A panel whose median is above this share of full scale is lit all over."""
BLACK_SHARE = 0.008
"""A frame with nothing above this share of full scale (2 of 255 DN) is black: a live sensor shows more noise."""
HOT_SHARE = 0.25
"""A lens spreads every spot: four neighbours together under this share of the peak make it a hot pixel."""
WINDOW_RADIUS_PX = (4, 12)
"""Radius of the fit's windows, least and most: the spot and two pixels of background around it."""
SYSTEMATIC_PX = 0.006
"""What a perfect fit still misses: the profile is not quite a Gaussian (found on rendered spots)."""
BLOOM_SIGMA_PX, MERGED_BLOOM_SIGMA_PX = 0.03, 0.1
"""Standard deviation of a bloomed spot's charge centroid, and of a fit to the flanks of one that touches another
(found on rendered spots)."""
CHARGE_SHARE = 0.15
"""Only pixels above this share of full scale count as charge: fainter light is halo, uneven on lit and dark ground."""
FLUX_SIGMA, CLIPPED_FLUX_SIGMA, BLOOM_FLUX_SIGMA = 0.1, 0.25, 1.2
"""Standard deviation of log flux: fitted whole, fitted on its flanks, and summed where charge was lost."""
HIDDEN_CHI2, HIDDEN_SIGMA, HIDDEN_GAIN = 12.0, 8.0, 0.4
"""A second spot is tried where a fit is this poor and one pixel off by so much; kept if chi2 falls to this share."""
HIDDEN_PEAK_SHARE, LEAST_APART_PX = 0.02, 1.2
"""A second spot fainter than this share of the first, or nearer to it, cannot be told from an unsharp one."""
LOST_PX = 2.5
"""A fit that ends further from where it started is not believed."""
LOST_SIGMA_PX = 0.5
"""Standard deviation given to a centre whose fit was not believed."""


class FrameRefused(ValueError):
    """The frame cannot be judged; ``reason`` is the bit, the text says what is wrong and what to do."""

    def __init__(self, reason: Reason, text: str) -> None:
        super().__init__(text)
        self.reason = reason


def find(image: Image, detection: Detection, sensor: Sensor) -> Highlights:
    """Find all highlights of one frame, in row-major order of their first lit pixel.

    ``image`` (H, W) uint8 or uint16 of any stride. Raises FrameRefused for a frame that is black or lit all over.
    """
    image = kernel.packed(image)
    ground = lit_stage.background(image)
    sensor = _full_scale(image, sensor)
    lit = _lit(image, detection, sensor, ground)
    response = Response(sensor, ground.level_dn, ground.noise_dn, ground.black_dn)
    spots = find_spots(image, lit, response.clipped_dn)
    return _measured(image, lit, spots, ground, detection, response)


def _full_scale(image: Image, sensor: Sensor) -> Sensor:
    """The sensor with its full scale: a 16-bit frame under the 8-bit default is of the least depth that holds it."""
    if image.dtype.itemsize == 1 or sensor.saturation_dn > 255:
        return sensor
    largest = float(image.max(initial=0))
    return replace(sensor, saturation_dn=next(s for s in (255.0, 1023.0, 4095.0, 16383.0, 65535.0) if s >= largest))


def _lit(image: Image, detection: Detection, sensor: Sensor, ground: Background) -> Lit:
    """The lit pixels, or FrameRefused where the frame shows that it is no dark panel with a few highlights."""
    full = sensor.saturation_dn
    if ground.level_dn > OVERLIT_SHARE * full:
        raise FrameRefused(
            Reason.FRAME_OVERLIT,
            f"the frame is lit all over (median {ground.level_dn:.0f} of {full:.0f} DN): shield it or lower the exposure",
        )
    if detection.threshold_dn is not None:
        thresholds = np.array([[detection.threshold_dn]])
    else:
        tiles = ground.tiles_dn.max(keepdims=True) if ground.flat() else ground.tiles_dn
        thresholds = tiles + detection.threshold_sigma * ground.noise_dn
    lit = lit_stage.find(image, thresholds, detection.max_lit_fraction)
    if lit is None:
        raise FrameRefused(
            Reason.FRAME_OVERLIT,
            f"more than {100 * detection.max_lit_fraction:g} % of the frame is above the threshold"
            f" ({thresholds.max():.0f} DN, background {ground.level_dn:.0f} DN): shield it, lower the exposure or raise the threshold",
        )
    if lit.count == 0 and image.max(initial=0) <= BLACK_SHARE * full:
        raise FrameRefused(
            Reason.FRAME_BLACK,
            f"the frame is black (nothing above {BLACK_SHARE * full:.0f} DN): check lamp, lens cap and exposure",
        )
    if lit.count > detection.max_highlights:
        raise FrameRefused(
            Reason.TOO_MANY_HIGHLIGHTS,
            f"{lit.count} highlights, more than max_highlights ({detection.max_highlights}): clean or shield the panel",
        )
    return lit


def _measured(
    image: Image, lit: Lit, spots: Spots, ground: Background, detection: Detection, response: Response
) -> Highlights:
    """Centres, their covariance, flux, peak, area and flags of all spots."""
    if len(spots.centre_px) == 0:
        return none(lit.threshold_dn, ground)
    fitted, start, area, flags = _fitted(image, lit, spots, ground, detection, response)
    more = _hidden(spots, fitted, flags)
    if len(more):
        crowd = spots.with_more(*more)
        again = _fitted(image, lit, crowd, ground, detection, response)
        proven = _proven(fitted, again[0], more[0])
        if len(proven):
            spots = spots.with_more(more[0][proven], more[1][proven])
            fitted, start, area, flags = _fitted(image, lit, spots, ground, detection, response)
    solved: list[bloom.Solved] = []
    if any(spots.bloom):
        spots, solved = bloom.refine(image, lit, spots, fitted, response)
        if len(spots.centre_px) > len(fitted.chi2):
            fitted, start, area, flags = _fitted(image, lit, spots, ground, detection, response)
    covariance, xy, flux = _believed(fitted, spots)
    flux_sigma = np.where(spots.saturated_px > 0, CLIPPED_FLUX_SIGMA, FLUX_SIGMA)
    if any(spots.bloom):
        centroid, charge = _charge(lit, spots, start, response)
        clipped = spots.saturated_px > 0
        xy[clipped], covariance[clipped] = centroid[clipped], BLOOM_SIGMA_PX**2 * np.eye(2)
        flux[clipped], flux_sigma[clipped] = charge[clipped], BLOOM_FLUX_SIGMA
        for found in solved:
            _place(found, xy, covariance, flux, flux_sigma)
    return Highlights(
        xy_px=xy,
        covariance_px2=covariance,
        flux_dn=flux,
        flux_sigma=flux_sigma,
        peak_dn=fitted.peak_dn,
        area_px=np.rint(area).astype(np.intp),
        flags=flags,
        binary_px=_binary_centroids(lit)[spots.component],
        threshold_dn=lit.threshold_dn,
        background_dn=ground.level_dn,
        noise_dn=ground.noise_dn,
    )


def _fitted(
    image: Image, lit: Lit, spots: Spots, ground: Background, detection: Detection, response: Response
) -> tuple[fitting.Fitted, FloatArray, FloatArray, IntArray]:
    """Fit all spots; also the first guess, each spot's share (n,) of its component's area, and its flags (n,)."""
    share = np.bincount(lit.component, minlength=lit.count) / np.maximum(
        np.bincount(spots.component, minlength=lit.count), 1
    )
    area = share[spots.component]
    centre = np.rint(spots.centre_px).astype(np.intp)
    start = _start(image, spots, area, centre, lit.threshold_dn, ground, response)
    radius = np.clip(np.ceil(np.sqrt(area / np.pi)) + 2, *WINDOW_RADIUS_PX)
    flags = _flags(image, lit, spots, area, detection)
    typical = (flags & (Flag.SATURATED | Flag.HOT_PIXEL | Flag.MERGED)) == 0
    if not typical.any():
        typical = (flags & (Flag.SATURATED | Flag.HOT_PIXEL)) == 0
    return fitting.fit(image, response, spots.bloom, centre, radius, typical, start), start, area, flags


def _hidden(spots: Spots, fitted: fitting.Fitted, flags: IntArray) -> tuple[IntArray, FloatArray] | tuple[()]:
    """Where badly fitted spots may hide another: their indices (m,) and the place (m, 2) of the largest misfit."""
    bloomed = (spots.saturated_px > 0) & any(spots.bloom)
    poor = np.flatnonzero(
        (fitted.chi2 > HIDDEN_CHI2) & (fitted.misfit_sigma > HIDDEN_SIGMA) & ~bloomed & ((flags & Flag.HOT_PIXEL) == 0)
    )
    return (poor, fitted.misfit_px[poor]) if len(poor) else ()


def _proven(before: fitting.Fitted, after: fitting.Fitted, hosts: IntArray) -> IntArray:
    """Which of the added spots (indices into ``hosts``) earn their place: the host's misfit falls by half or more."""
    added = np.arange(len(before.chi2), len(after.chi2))
    apart = np.hypot(*(after.xy_px[added] - after.xy_px[hosts]).T)
    bright = after.peak_dn[added] > HIDDEN_PEAK_SHARE * after.peak_dn[hosts]
    stayed = np.abs(after.xy_px[added] - before.misfit_px[hosts]).max(axis=1) < LOST_PX
    better = after.chi2[hosts] < HIDDEN_GAIN * before.chi2[hosts]
    return np.flatnonzero(better & stayed & bright & (apart > LEAST_APART_PX))


def _start(
    image: Image,
    spots: Spots,
    area: FloatArray,
    centre: IntArray,
    threshold_dn: float,
    ground: Background,
    response: Response,
) -> FloatArray:
    """First guess (n, 9) for the fit. A Gaussian of peak P covers 2 pi s^2 ln(P/T) pixels above a threshold T."""
    rows, columns = centre[:, 1], centre[:, 0]
    grey = image[rows, columns].astype(np.float64)
    level = ground.at(rows, columns, image.shape)
    light, base, threshold = response.light(np.stack([grey, level, np.maximum(threshold_dn, level + 1)]))
    saturated = spots.saturated_px > 0
    peak = np.maximum(np.where(saturated, response.sensor.saturation_dn, light) - base, 1.0)
    ring = np.where(saturated, np.maximum(area - spots.saturated_px, 4), area)
    blur = np.clip(ring / (2 * np.pi * np.log(np.maximum(peak / (threshold - base), 1.3))), 0.25, 16.0)
    plateau = np.exp(np.minimum(spots.narrow_px**2 / (8 * blur), 5.0))
    start = np.zeros((len(centre), fitting.PARAMETERS))
    start[:, fitting.X : fitting.Y + 1] = spots.centre_px - centre
    start[:, fitting.LOG_PEAK] = np.log(peak * plateau)
    start[:, fitting.SXX] = start[:, fitting.SYY] = blur
    start[:, fitting.BACKGROUND] = base
    return start


def _flags(image: Image, lit: Lit, spots: Spots, area: FloatArray, detection: Detection) -> IntArray:
    """Flags (n,) of each spot."""
    flags = np.zeros(len(area), np.intp)
    flags[spots.saturated_px > 0] |= Flag.SATURATED
    flags[np.bincount(spots.component, minlength=lit.count)[spots.component] > 1] |= Flag.MERGED
    flags[area < detection.min_area_px] |= Flag.TOO_SMALL
    flags[area > detection.max_area_px] |= Flag.TOO_LARGE
    height, width = image.shape
    border = (lit.rows == 0) | (lit.rows == height - 1) | (lit.columns == 0) | (lit.columns == width - 1)
    flags[np.isin(spots.component, lit.component[border])] |= Flag.AT_EDGE
    flags[_hot(image, spots)] |= Flag.HOT_PIXEL
    return flags


def _hot(image: Image, spots: Spots) -> Bools:
    """Which spots are a single pixel that no lens can have made, (n,)."""
    x, y = np.rint(spots.centre_px).astype(np.intp).T
    height, width = image.shape
    inside = (x >= 1) & (x < width - 1) & (y >= 1) & (y < height - 1)
    x, y = np.clip(x, 1, max(width - 2, 1)), np.clip(y, 1, max(height - 2, 1))
    if width < 3 or height < 3:
        return np.zeros(len(x), np.bool_)
    cross = np.stack([image[y, x - 1], image[y, x + 1], image[y - 1, x], image[y + 1, x]]).astype(np.float64)
    ring = np.stack([image[y - 1, x - 1], image[y - 1, x + 1], image[y + 1, x - 1], image[y + 1, x + 1]])
    ground = np.minimum(np.median(ring, axis=0), cross.min(axis=0))
    return inside & ((cross - ground).sum(axis=0) < HOT_SHARE * (image[y, x] - ground))


def _believed(fitted: fitting.Fitted, spots: Spots) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Covariance (n, 2, 2), centres (n, 2), flux (n,): where a fit ran away, the plain centre, known badly."""
    covariance = fitted.covariance_px2 * np.maximum(fitted.chi2, 1.0)[:, None, None]
    covariance = covariance + SYSTEMATIC_PX**2 * np.eye(2)
    away = np.abs(fitted.xy_px - spots.centre_px).max(axis=1)
    flux = fitted.flux_dn.copy()
    lost = ~((away < LOST_PX) & np.isfinite(covariance).all(axis=(1, 2)) & (flux > 0) & np.isfinite(flux))
    covariance[lost] = LOST_SIGMA_PX**2 * np.eye(2)
    flux[lost] = np.maximum(fitted.peak_dn[lost], 1.0)
    return covariance, np.where(lost[:, None], spots.centre_px, fitted.xy_px), flux


def _charge(lit: Lit, spots: Spots, start: FloatArray, response: Response) -> tuple[FloatArray, FloatArray]:
    """Centroids (n, 2) of the lit pixels nearest to each spot, weighted by light over the background, and its sum.

    Where charge blooms the flanks are spoilt, but it runs both ways alike and clipping is even on both sides: what is
    left of the spot's charge keeps its centre.
    """
    n = len(spots.centre_px)
    at = np.column_stack([lit.columns, lit.rows]).astype(np.float64)
    distance = np.abs(at[:, None] - spots.centre_px).sum(axis=2)
    distance[lit.component[:, None] != spots.component] = np.inf
    owner = distance.argmin(axis=1)
    ground = start[owner, fitting.BACKGROUND]
    weight = response.light(lit.grey_dn) - ground
    weight[weight < CHARGE_SHARE * (response.sensor.saturation_dn - ground)] = 0.0
    total = np.bincount(owner, weight, n)
    moments = np.column_stack([np.bincount(owner, weight * at[:, k], n) for k in (0, 1)])
    total = np.maximum(total, 1.0)
    return np.where(total[:, None] > 1, moments / total[:, None], spots.centre_px), total


def _place(
    found: bloom.Solved, xy: FloatArray, covariance: FloatArray, flux: FloatArray, flux_sigma: FloatArray
) -> None:
    """Write a solved cluster's centres, covariance and flux over what the plain fit said of its members.

    A lone spot keeps its charge's centroid, which uneven ground under it moves less than the fit.
    """
    members = found.cluster.members
    if len(members) == 1:
        return
    xy[members], flux[members] = found.places, found.fluxes
    covariance[members] = found.place_covariance + BLOOM_SIGMA_PX**2 * np.eye(2)
    flux_sigma[members] = CLIPPED_FLUX_SIGMA


def _binary_centroids(lit: Lit) -> FloatArray:
    """Centroids (components, 2) of lit pixels, all of one weight."""
    size = np.bincount(lit.component, minlength=lit.count)
    return np.column_stack([np.bincount(lit.component, v, lit.count) / size for v in (lit.columns, lit.rows)])


def none(threshold_dn: float, ground: Background) -> Highlights:
    """A frame without highlights."""
    empty = np.empty(0)
    return Highlights(
        np.empty((0, 2)),
        np.empty((0, 2, 2)),
        empty,
        empty,
        empty,
        empty.astype(np.intp),
        empty.astype(np.intp),
        np.empty((0, 2)),
        threshold_dn,
        ground.level_dn,
        ground.noise_dn,
    )
