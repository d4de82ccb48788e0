"""Image -> highlights: lit components, split into spots, each with a sub-pixel centre and its covariance."""

from __future__ import annotations

import struct
from dataclasses import dataclass, replace

import numpy as np

from inspector.detect import bloom, kernel
from inspector.detect import fit as fitting
from inspector.detect import lit as lit_stage
from inspector.detect.fit import Fitted, Response
from inspector.detect.lit import Background
from inspector.detect.spots import COMPONENT_PX, COMPONENT_X, COMPONENT_Y, Spots, find_spots
from inspector.model import Flag, FloatArray, Highlights, Image, IntArray, Reason
from inspector.optics import Sensor
from inspector.recipe import Detection

OVERLIT_SHARE = 0.6
"""A panel whose median is above this share of full scale is lit all over."""
BLACK_SHARE = 0.008
"""A frame with nothing above this share of full scale (2 of 255 DN) is black: a live sensor shows more noise."""
HOT_SHARE = 0.25
"""A lens spreads every spot: four neighbours together under this share of the peak make it a hot pixel."""
SYSTEMATIC_PX2 = 0.006**2
"""Variance along each axis of what a perfect fit still misses: the profile is not quite a Gaussian (rendered spots)."""
UNSURE_FLUX = Flag.SATURATED | Flag.HOT_PIXEL
"""Where every spot has one of these flags, the frame does not show how much light a blur of its width holds."""
HOT_PIXEL = int(Flag.HOT_PIXEL)
HELD = UNSURE_FLUX | Flag.TOUCHING
"""A spot with one of these flags is held to the frame's usual blur."""
BLOOM_SIGMA_PX = 0.03
"""Standard deviation of a bloomed spot's charge centroid (found on rendered spots)."""
FLUX_SIGMA, CLIPPED_FLUX_SIGMA, BLOOM_FLUX_SIGMA = 0.1, 0.25, 1.2
"""Standard deviation of log flux: fitted whole, fitted on its flanks, and summed where charge was lost."""
HIDDEN_CHI2, HIDDEN_SIGMA, HIDDEN_GAIN = 12.0, 8.0, 0.5
"""A second spot is tried where a fit is this poor and one pixel off by so much; kept if chi2 falls to this share."""
MOST_LOOKED_THROUGH = 500
"""In a frame of more spots none is looked for behind others: each look fits those anew that share a component."""
HIDDEN_PEAK_SHARE, LEAST_APART_PX = 0.005, 1.7
"""A second spot fainter than this share of the first, or nearer to it, cannot be told from an unsharp one."""
LOST_PX = 2.5
"""A fit that ends further from where it started is not believed."""
LOST_SIGMA_PX = 0.5
"""Standard deviation given to a centre whose fit was not believed."""
FLAG_BITS = tuple(
    int(flag)
    for flag in (
        *(Flag.SATURATED, Flag.TOUCHING, Flag.TOO_SMALL, Flag.TOO_LARGE, Flag.AT_EDGE, Flag.HOT_PIXEL),
        Flag.CROWDED,
        *(UNSURE_FLUX, HELD),
    )
)
"""The bits that `_measure.c` sets and asks for, as it takes them."""
_STANDARDS = struct.Struct("8d9q")
_NOTHING = np.empty((0, kernel.FOUND_COLUMNS))


class FrameRefused(ValueError):
    """The frame cannot be judged; ``reason`` is the bit, the text says what is wrong and what to do."""

    def __init__(self, reason: Reason, text: str) -> None:
        super().__init__(text)
        self.reason = reason


@dataclass(frozen=True)
class View:
    """A frame before its spots are measured: pixels, what is lit, ground, response, threshold, what was asked."""

    pixels: kernel.Pixels
    lit: kernel.Detected
    ground: Background
    response: Response
    threshold_dn: float
    detection: Detection


def find(image: Image, detection: Detection, sensor: Sensor) -> Highlights:
    """Find all highlights of one frame: clipped ones, then the others, each in row-major order.

    ``image`` (H, W) uint8 or uint16 of any stride. Raises FrameRefused for a frame that is black or lit all over.
    """
    pixels = kernel.packed(image)
    ground = lit_stage.background(pixels)
    sensor = _full_scale(pixels.image, sensor)
    response = Response(sensor, ground.level_dn, ground.noise_dn, ground.black_dn)
    thresholds = _thresholds(detection, ground, sensor.saturation_dn)
    lit = _lit(pixels, thresholds, response, ground, detection)
    view = View(pixels, lit, ground, response, float(thresholds.max()), detection)
    return _measured(view, find_spots(pixels.image, lit, response.clipped_dn))


def _full_scale(image: Image, sensor: Sensor) -> Sensor:
    """The sensor with its full scale: a 16-bit frame under the 8-bit default is of the least depth that holds it."""
    if image.dtype.itemsize == 1 or sensor.saturation_dn > 255:
        return sensor
    largest = float(image.max(initial=0))
    return replace(sensor, saturation_dn=next(s for s in (255.0, 1023.0, 4095.0, 16383.0, 65535.0) if s >= largest))


def _thresholds(detection: Detection, ground: Background, full_dn: float) -> FloatArray:
    """Grey values at tile centres above which a pixel is lit. Raises FrameRefused where none could stand out."""
    if ground.level_dn > OVERLIT_SHARE * full_dn:
        raise FrameRefused(
            Reason.FRAME_OVERLIT,
            f"the frame is lit all over (median {ground.level_dn:.0f} of {full_dn:.0f} DN): shield it, expose less",
        )
    if detection.threshold_dn is not None:
        return np.array([[float(detection.threshold_dn)]])
    tiles = np.array([[ground.brightest_dn]]) if ground.flat() else ground.tiles_dn + _bend(ground.tiles_dn)
    thresholds = tiles + detection.threshold_sigma * ground.noise_dn
    if thresholds.max() >= full_dn:
        raise FrameRefused(
            Reason.FRAME_OVERLIT,
            f"no highlight could stand out everywhere: background up to {ground.brightest_dn:.0f} DN, noise"
            f" {ground.noise_dn:.0f} DN, full scale {full_dn:.0f} DN: shield the panel, check the camera's link",
        )
    return np.asarray(thresholds)


def _bend(tiles_dn: FloatArray) -> FloatArray:
    """How far (rows, columns) the ground may lie off a straight line between tile centres, DN: part of its bend."""
    bend = np.zeros_like(tiles_dn)
    for axis in (0, 1):
        if tiles_dn.shape[axis] > 2:
            second = np.abs(np.diff(tiles_dn, 2, axis)).max(axis=1 - axis, keepdims=True)
            first, last = second.take([0], axis), second.take([-1], axis)  # the outermost tiles' own are not known
            bend = np.maximum(bend, np.concatenate([first, second, last], axis))
    return np.asarray(bend / 2)


def _lit(
    pixels: kernel.Pixels, thresholds: FloatArray, response: Response, ground: Background, detection: Detection
) -> kernel.Detected:
    """The lit pixels, or FrameRefused where the frame shows that it is no dark panel with a few highlights."""
    most = int(detection.max_lit_fraction * pixels.image.size) + 1
    lit = kernel.detect(pixels, thresholds, most, response.clipped_dn, HOT_SHARE)
    if lit is None:
        raise FrameRefused(
            Reason.FRAME_OVERLIT,
            f"more than {100 * detection.max_lit_fraction:g} % of the frame is above the threshold"
            f" ({thresholds.max():.0f} DN, background {ground.level_dn:.0f} DN): shield it or lower the exposure",
        )
    if lit.largest <= BLACK_SHARE * response.sensor.saturation_dn:
        raise FrameRefused(
            Reason.FRAME_BLACK,
            f"the frame is black (nothing above {lit.largest:.0f} DN): check lamp, lens cap and exposure",
        )
    if len(lit.spots) > detection.max_highlights:
        raise FrameRefused(
            Reason.TOO_MANY_HIGHLIGHTS,
            f"{len(lit.spots)} highlights, more than max_highlights ({detection.max_highlights}): clean or shield the"
            " panel",
        )
    return lit


def _measured(view: View, spots: Spots) -> Highlights:
    """Centres, their covariance, flux, peak, area and flags of all spots."""
    if len(spots) == 0:
        return none(view)
    spots, measured, solved = _explained(view, spots)
    if any(spots.bloom):
        _place_bloomed(view, spots, measured, solved)
    return Highlights(
        xy_px=measured.xy_px,
        covariance_px2=measured.covariance_px2,
        flux_dn=measured.flux_dn,
        flux_sigma=measured.flux_sigma,
        peak_dn=measured.found[:, fitting.PEAK],
        area_px=spots.table[:, COMPONENT_PX].astype(np.intp),
        flags=measured.flags,
        binary_px=spots.table[:, COMPONENT_X : COMPONENT_Y + 1],
        blur_px2=measured.found[:, fitting.BLUR_XX : fitting.BLUR_YY + 1],
        threshold_dn=view.threshold_dn,
        background_dn=view.ground.level_dn,
        noise_dn=view.ground.noise_dn,
        full_scale_dn=view.response.sensor.saturation_dn,
    )


def _explained(view: View, seen: Spots) -> tuple[Spots, kernel.Measured, list[bloom.Solved]]:
    """The spots, with hidden ones, their fit, and the bloomed clusters: whichever explains the frame.

    Plateaus drawn out along columns or rows are charge that ran over, or spots that touch: the better fit decides.
    """
    spots, measured = _with_hidden(view, replace(seen, bloom=(0, 0)))
    if not any(seen.bloom) or len(set(seen.component[seen.clipped].tolist())) > bloom.MOST_CLUSTERS:
        return spots, measured, []
    bloomed, fit = _with_hidden(view, seen)
    crowd, solved = bloom.refine(view.pixels.image, view.lit, bloomed, Fitted(fit.found), view.response)
    if not solved or max(s.chi2 for s in solved) > Fitted(measured.found).chi2[spots.clipped].max():
        return spots, measured, []
    return crowd, fit if crowd is bloomed else _measure(view, crowd), solved


def _measure(view: View, spots: Spots, start: FloatArray = _NOTHING) -> kernel.Measured:
    """Flag and fit all spots: `kernel_measure` of `_measure.c`; the first k go on from ``start`` (k, 16), if not NaN.

    Where a fit ran away the plain centre is taken, known badly. The flux of a clipped spot hangs on its blur: in a
    frame that shows none unclipped it is little more than a guess.
    """
    rules = view.response.rules(spots.bloom, view.threshold_dn)
    standards = _standards(view.detection)
    return kernel.measure(view.pixels, view.ground.tiles_dn, rules, standards, view.lit.components, spots.table, start)


def _standards(detection: Detection) -> bytes:
    """`Standards` of `_measure.c`."""
    areas = (detection.min_area_px, detection.max_area_px)
    fluxes = (FLUX_SIGMA, CLIPPED_FLUX_SIGMA, BLOOM_FLUX_SIGMA)
    return _STANDARDS.pack(*areas, LOST_PX, LOST_SIGMA_PX**2, SYSTEMATIC_PX2, *fluxes, *FLAG_BITS)


def _with_hidden(view: View, spots: Spots) -> tuple[Spots, kernel.Measured]:
    """The spots, fitted, with those that hid in poor fits, as far as each earns its place."""
    measured = _measure(view, spots)
    hosts = _hidden(spots, measured)
    if len(hosts) == 0 or len(spots) > MOST_LOOKED_THROUGH:
        return spots, measured
    places = Fitted(measured.found).misfit_px[hosts]
    start = _start(spots, measured, hosts)
    trial = _measure(view, spots.with_more(hosts, places), start)
    proven = _proven(Fitted(measured.found), Fitted(trial.found), hosts)
    if len(proven) == 0:
        return spots, measured
    spots = spots.with_more(hosts[proven], places[proven])
    return spots, trial if len(proven) == len(hosts) else _measure(view, spots, start)


def _start(spots: Spots, measured: kernel.Measured, hosts: IntArray) -> FloatArray:
    """What was found (n, 16) of spots that a fit with more in the hosts' components may go on from; the others NaN."""
    believed = (measured.xy_px == Fitted(measured.found).xy_px).all(axis=1)
    apart = ~np.isin(spots.component, spots.component[hosts])
    return np.where((believed & apart)[:, None], measured.found, np.nan)


def _hidden(spots: Spots, measured: kernel.Measured) -> IntArray:
    """Spots (m,) whose poor fit may hide another, at their largest misfit."""
    found = measured.found
    poor = (found[:, fitting.CHI2] > HIDDEN_CHI2) & (found[:, fitting.MISFIT_SIGMA] > HIDDEN_SIGMA)
    if any(spots.bloom):
        poor &= ~spots.clipped
    return np.asarray((poor & (measured.flags & HOT_PIXEL == 0)).nonzero()[0])


def _proven(before: Fitted, after: Fitted, hosts: IntArray) -> IntArray:
    """Which of the added spots (indices into ``hosts``) earn their place: the host's misfit falls by half or more."""
    added = np.arange(len(before), len(after))
    apart = np.hypot(*(after.xy_px[added] - after.xy_px[hosts]).T)
    bright = after.table[added, fitting.PEAK] > HIDDEN_PEAK_SHARE * after.table[hosts, fitting.PEAK]
    stayed = np.abs(after.xy_px[added] - before.misfit_px[hosts]).max(axis=1) < LOST_PX
    better = after.chi2[hosts] < HIDDEN_GAIN * before.chi2[hosts]
    return np.flatnonzero(better & stayed & bright & (apart > LEAST_APART_PX))


def _place_bloomed(view: View, spots: Spots, measured: kernel.Measured, solved: list[bloom.Solved]) -> None:
    """Clipped spots of a blooming frame: lone ones by their charge, those that touch by the fit of their cluster.

    A lone spot's charge is moved less by uneven ground under it than a fit is. ``measured`` is set anew in place.
    """
    xy, covariance = measured.xy_px, measured.covariance_px2
    flux, flux_sigma = measured.flux_dn, measured.flux_sigma
    centroid, charge = bloom.charge(view.lit, spots, measured.found[:, fitting.GROUND], view.response)
    clipped = spots.clipped
    xy[clipped], covariance[clipped] = centroid[clipped], BLOOM_SIGMA_PX**2 * np.eye(2)
    flux[clipped], flux_sigma[clipped] = charge[clipped], BLOOM_FLUX_SIGMA
    for cluster in solved:
        members = cluster.cluster.members
        if len(members) > 1:
            xy[members], flux[members] = cluster.places, cluster.fluxes
            covariance[members] = cluster.place_covariance + BLOOM_SIGMA_PX**2 * np.eye(2)
            flux_sigma[members] = CLIPPED_FLUX_SIGMA


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
        blur_px2=np.empty((0, 3)),
        threshold_dn=view.threshold_dn,
        background_dn=view.ground.level_dn,
        noise_dn=view.ground.noise_dn,
        full_scale_dn=view.response.sensor.saturation_dn,
    )
