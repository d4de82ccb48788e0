"""Image -> highlights: lit components, split into spots, each with a sub-pixel centre and its covariance."""

from __future__ import annotations

from dataclasses import dataclass, replace

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
BLOOM_SIGMA_PX = 0.03
"""Standard deviation of a bloomed spot's charge centroid (found on rendered spots)."""
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


@dataclass(frozen=True)
class View:
    """A frame before its spots are measured: packed image, lit pixels, ground, response, and what was asked for."""

    image: Image
    lit: Lit
    ground: Background
    response: Response
    detection: Detection


def find(image: Image, detection: Detection, sensor: Sensor) -> Highlights:
    """Find all highlights of one frame, in row-major order of their first lit pixel, clipped ones first.

    ``image`` (H, W) uint8 or uint16 of any stride. Raises FrameRefused for a frame that is black or lit all over.
    """
    image = kernel.packed(image)
    ground = lit_stage.background(image)
    sensor = _full_scale(image, sensor)
    response = Response(sensor, ground.level_dn, ground.noise_dn, ground.black_dn)
    view = View(image, _lit(image, detection, sensor, ground), ground, response, detection)
    return _measured(view, find_spots(image, view.lit, response.clipped_dn))


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
            f"the frame is lit all over (median {ground.level_dn:.0f} of {full:.0f} DN): shield it, lower the exposure",
        )
    if detection.threshold_dn is not None:
        thresholds = np.array([[detection.threshold_dn]])
    else:
        tiles = ground.tiles_dn.max(keepdims=True) if ground.flat() else ground.tiles_dn
        thresholds = tiles + detection.threshold_sigma * ground.noise_dn
    if thresholds.min() >= full:
        raise FrameRefused(
            Reason.FRAME_OVERLIT,
            f"no highlight could stand out: background {ground.level_dn:.0f} DN, noise {ground.noise_dn:.0f} DN, full"
            f" scale {full:.0f} DN: shield the panel, check the camera's link",
        )
    lit = lit_stage.find(image, thresholds, detection.max_lit_fraction)
    if lit is None:
        raise FrameRefused(
            Reason.FRAME_OVERLIT,
            f"more than {100 * detection.max_lit_fraction:g} % of the frame is above the threshold"
            f" ({thresholds.max():.0f} DN, background {ground.level_dn:.0f} DN): shield it or lower the exposure",
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


def _measured(view: View, spots: Spots) -> Highlights:
    """Centres, their covariance, flux, peak, area and flags of all spots."""
    if len(spots.centre_px) == 0:
        return none(view)
    spots, measured = _with_hidden(view, spots, _measure(view, spots))
    solved: list[bloom.Solved] = []
    if any(spots.bloom):
        crowd, solved = bloom.refine(view.image, view.lit, spots, measured.fitted, view.response)
        if crowd is not spots:
            spots, measured = crowd, _measure(view, crowd)
    found = _believed(measured.fitted, spots)
    if any(spots.bloom):
        _place_bloomed(view, spots, measured, solved, found)
    return Highlights(
        xy_px=found.xy_px,
        covariance_px2=found.covariance_px2,
        flux_dn=found.flux_dn,
        flux_sigma=found.flux_sigma,
        peak_dn=measured.fitted.peak_dn,
        area_px=np.rint(measured.area_px).astype(np.intp),
        flags=measured.flags,
        binary_px=_binary_centroids(view.lit)[spots.component],
        threshold_dn=view.lit.threshold_dn,
        background_dn=view.ground.level_dn,
        noise_dn=view.ground.noise_dn,
        full_scale_dn=view.response.sensor.saturation_dn,
    )


@dataclass(frozen=True)
class Measured:
    """The fit of n spots, the light (n,) of the ground, each one's share (n,) of its component's area, flags (n,)."""

    fitted: fitting.Fitted
    ground_light: FloatArray
    area_px: FloatArray
    flags: IntArray


def _measure(view: View, spots: Spots) -> Measured:
    """Fit all spots."""
    lit = view.lit
    crowd = np.bincount(spots.component, minlength=lit.count)
    area = (np.bincount(lit.component, minlength=lit.count) / np.maximum(crowd, 1))[spots.component]
    centre = np.rint(spots.centre_px).astype(np.intp)
    flags = _flags(view, spots, centre, crowd, area)
    start = _start(view, spots, area, centre)
    radius = np.minimum(np.maximum(np.ceil(np.sqrt(area / np.pi)) + 2, WINDOW_RADIUS_PX[0]), WINDOW_RADIUS_PX[1])
    typical = (flags & (Flag.SATURATED | Flag.HOT_PIXEL | Flag.TOUCHING)) == 0
    if not typical.any():
        typical = (flags & (Flag.SATURATED | Flag.HOT_PIXEL)) == 0
    fitted = fitting.fit(view.image, view.response, spots.bloom, centre, radius, typical, start)
    return Measured(fitted, start[:, fitting.BACKGROUND], area, flags)


def _with_hidden(view: View, spots: Spots, measured: Measured) -> tuple[Spots, Measured]:
    """The spots with those that hid in poor fits, as far as each earns its place."""
    hosts, places = _hidden(spots, measured.fitted, measured.flags)
    if len(hosts) == 0:
        return spots, measured
    trial = _measure(view, spots.with_more(hosts, places))
    proven = _proven(measured.fitted, trial.fitted, hosts)
    if len(proven) == 0:
        return spots, measured
    spots = spots.with_more(hosts[proven], places[proven])
    return spots, trial if len(proven) == len(hosts) else _measure(view, spots)


def _hidden(spots: Spots, fitted: fitting.Fitted, flags: IntArray) -> tuple[IntArray, FloatArray]:
    """Where badly fitted spots may hide another: their indices (m,) and the place (m, 2) of the largest misfit."""
    bloomed = (spots.saturated_px > 0) & any(spots.bloom)
    poor = np.flatnonzero(
        (fitted.chi2 > HIDDEN_CHI2) & (fitted.misfit_sigma > HIDDEN_SIGMA) & ~bloomed & ((flags & Flag.HOT_PIXEL) == 0)
    )
    return poor, fitted.misfit_px[poor]


def _proven(before: fitting.Fitted, after: fitting.Fitted, hosts: IntArray) -> IntArray:
    """Which of the added spots (indices into ``hosts``) earn their place: the host's misfit falls by half or more."""
    added = np.arange(len(before.chi2), len(after.chi2))
    apart = np.hypot(*(after.xy_px[added] - after.xy_px[hosts]).T)
    bright = after.peak_dn[added] > HIDDEN_PEAK_SHARE * after.peak_dn[hosts]
    stayed = np.abs(after.xy_px[added] - before.misfit_px[hosts]).max(axis=1) < LOST_PX
    better = after.chi2[hosts] < HIDDEN_GAIN * before.chi2[hosts]
    return np.flatnonzero(better & stayed & bright & (apart > LEAST_APART_PX))


def _start(view: View, spots: Spots, area: FloatArray, centre: IntArray) -> FloatArray:
    """First guess (n, 9) for the fit. A Gaussian of peak P covers 2 pi s^2 ln(P/T) pixels above a threshold T."""
    response, rows, columns = view.response, centre[:, 1], centre[:, 0]
    grey = view.image[rows, columns].astype(np.float64)
    level = view.ground.at(rows, columns, view.image.shape)
    threshold_dn = np.maximum(view.lit.threshold_dn, level + 1)
    light, base, threshold = response.light(np.stack([grey, level, threshold_dn]))
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


def _flags(view: View, spots: Spots, centre: IntArray, crowd: IntArray, area: FloatArray) -> IntArray:
    """Flags (n,) of each spot; ``crowd`` (components,) counts the spots of each component."""
    lit, (height, width) = view.lit, view.image.shape
    flags: IntArray = np.where(spots.saturated_px > 0, int(Flag.SATURATED), 0)
    flags |= np.where(crowd[spots.component] > 1, int(Flag.TOUCHING), 0)
    flags |= np.where(area < view.detection.min_area_px, int(Flag.TOO_SMALL), 0)
    flags |= np.where(area > view.detection.max_area_px, int(Flag.TOO_LARGE), 0)
    border = (lit.rows == 0) | (lit.rows == height - 1) | (lit.columns == 0) | (lit.columns == width - 1)
    if border.any():
        flags |= np.where(np.isin(spots.component, lit.component[border]), int(Flag.AT_EDGE), 0)
    flags |= np.where(kernel.hot(view.image, centre, HOT_SHARE), int(Flag.HOT_PIXEL), 0)
    return flags


@dataclass(frozen=True)
class Believed:
    """Centres (n, 2), covariance (n, 2, 2), flux (n,) and the deviation (n,) of its logarithm; filled in place."""

    xy_px: FloatArray
    covariance_px2: FloatArray
    flux_dn: FloatArray
    flux_sigma: FloatArray


def _believed(fitted: fitting.Fitted, spots: Spots) -> Believed:
    """What the fit is taken to say: where it ran away, the plain centre, known badly."""
    covariance = fitted.covariance_px2 * np.maximum(fitted.chi2, 1.0)[:, None, None]
    covariance += SYSTEMATIC_PX**2 * np.eye(2)
    away = np.abs(fitted.xy_px - spots.centre_px).max(axis=1)
    flux, xy = fitted.flux_dn.copy(), fitted.xy_px.copy()
    lost = ~((away < LOST_PX) & np.isfinite(covariance).all(axis=(1, 2)) & (flux > 0) & np.isfinite(flux))
    covariance[lost], xy[lost] = LOST_SIGMA_PX**2 * np.eye(2), spots.centre_px[lost]
    flux[lost] = np.where(np.isfinite(fitted.peak_dn[lost]), np.maximum(fitted.peak_dn[lost], 1.0), 1.0)
    return Believed(xy, covariance, flux, np.where(spots.saturated_px > 0, CLIPPED_FLUX_SIGMA, FLUX_SIGMA))


def _place_bloomed(view: View, spots: Spots, measured: Measured, solved: list[bloom.Solved], found: Believed) -> None:
    """Clipped spots of a blooming frame: lone ones by their charge, those that touch by the fit of their cluster.

    A lone spot's charge is moved less by uneven ground under it than a fit is.
    """
    centroid, charge = bloom.charge(view.lit, spots, measured.ground_light, view.response)
    clipped = spots.saturated_px > 0
    found.xy_px[clipped], found.covariance_px2[clipped] = centroid[clipped], BLOOM_SIGMA_PX**2 * np.eye(2)
    found.flux_dn[clipped], found.flux_sigma[clipped] = charge[clipped], BLOOM_FLUX_SIGMA
    for cluster in solved:
        members = cluster.cluster.members
        if len(members) > 1:
            found.xy_px[members], found.flux_dn[members] = cluster.places, cluster.fluxes
            found.covariance_px2[members] = cluster.place_covariance + BLOOM_SIGMA_PX**2 * np.eye(2)
            found.flux_sigma[members] = CLIPPED_FLUX_SIGMA


def _binary_centroids(lit: Lit) -> FloatArray:
    """Centroids (components, 2) of lit pixels, all of one weight."""
    size = np.bincount(lit.component, minlength=lit.count)
    return np.column_stack([np.bincount(lit.component, v, lit.count) / size for v in (lit.columns, lit.rows)])


def none(view: View) -> Highlights:
    """A frame without highlights."""
    empty, whole = np.empty(0), np.empty(0, np.intp)
    return Highlights(
        xy_px=np.empty((0, 2)),
        covariance_px2=np.empty((0, 2, 2)),
        flux_dn=empty,
        flux_sigma=empty,
        peak_dn=empty,
        area_px=whole,
        flags=whole,
        binary_px=np.empty((0, 2)),
        threshold_dn=view.lit.threshold_dn,
        background_dn=view.ground.level_dn,
        noise_dn=view.ground.noise_dn,
        full_scale_dn=view.response.sensor.saturation_dn,
    )
