"""Spots drawn with exact centres: found, placed to the noise's own limit, with honest covariance, and flagged."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from drawn import Drawing, lattice, nearest
from hypothesis import given
from hypothesis import strategies as st

from inspector import imagefile
from inspector.detect import highlights, kernel
from inspector.detect.spots import Spots
from inspector.model import Flag, FloatArray, Highlights, IntArray, Reason
from inspector.optics import Sensor
from inspector.recipe import Detection

CROWDED = Path(__file__).parents[2] / "config" / "frames" / "B003.png"


def find(drawing: Drawing, xy_px: FloatArray, peak_dn: FloatArray | float, seed: int = 0) -> Highlights:
    return highlights.find(drawing.draw(xy_px, peak_dn, seed), Detection(), drawing.sensor)


def errors(found: Highlights, xy_px: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Errors (n, 2) px of the highlights nearest to true spots, and the same over their stated deviations."""
    index = nearest(found, xy_px)
    assert len(set(index.tolist())) == len(xy_px), "a spot was not found"
    off = found.xy_px[index] - xy_px
    whitener = np.linalg.inv(np.linalg.cholesky(found.covariance_px2[index]))
    return off, np.einsum("nij,nj->ni", whitener, off)


@pytest.mark.parametrize(
    ("drawing", "peak_dn", "rms_px", "least_z"),
    [
        pytest.param(Drawing(), 200, 0.010, 0.7, id="bright"),
        pytest.param(Drawing(), 60, 0.025, 0.7, id="medium"),
        pytest.param(Drawing(), 20, 0.070, 0.7, id="faint"),
        pytest.param(Drawing(noise_dn=3), 150, 0.025, 0.7, id="noisy"),
        pytest.param(Drawing(), 500, 0.008, 0.4, id="clipped twice"),
        pytest.param(Drawing(), 1200, 0.008, 0.4, id="clipped five times"),
        pytest.param(Drawing(), 5000, 0.010, 0.4, id="clipped twenty times"),
        pytest.param(Drawing(blur_px=0.5), 150, 0.015, 0.7, id="under-sampled"),
        pytest.param(Drawing(blur_px=0.4), 150, 0.028, 0.7, id="much under-sampled"),
        pytest.param(Drawing(blur_px=1.2), 150, 0.011, 0.6, id="soft"),
        pytest.param(Drawing(blur_px=2.0), 150, 0.012, 0.6, id="out of focus"),
        pytest.param(Drawing(gamma=0.5), 150, 0.013, 0.4, id="gamma 0.5"),
        pytest.param(Drawing(gamma=0.45), 800, 0.008, 0.3, id="gamma 0.45, clipped"),
        pytest.param(Drawing(gamma=2.0), 150, 0.032, 0.7, id="gamma 2"),
        pytest.param(Drawing(panel_dn=60, slope_dn=(60, -60)), 120, 0.018, 0.7, id="shaded panel"),
        pytest.param(Drawing(full_dn=1023), 600, 0.012, 0.6, id="10 bits"),
        pytest.param(Drawing(full_dn=4095), 2500, 0.012, 0.6, id="12 bits"),
        pytest.param(Drawing(full_dn=65535), 40_000, 0.012, 0.6, id="16 bits"),
        pytest.param(Drawing(full_dn=4095), 12_000, 0.008, 0.4, id="12 bits, clipped"),
    ],
)
def test_centres_at_a_stated_noise(drawing: Drawing, peak_dn: float, rms_px: float, least_z: float) -> None:
    """80 spots of one kind. A floor of 0.006 px for real spots' shapes keeps z below one where noise is small."""
    xy = lattice(10, 8, drawing.shape, np.random.default_rng(0))
    found = find(drawing, xy, peak_dn)
    off, z = errors(found, xy)
    assert len(found) == len(xy)
    assert np.sqrt(np.mean(off**2)) < rms_px
    assert np.abs(off).max() < 4 * rms_px
    assert least_z < z.std() < 1.4
    assert np.all((found.flags & Flag.SATURATED != 0) == (peak_dn > drawing.full_dn))


drawings = st.builds(
    Drawing,
    shape=st.just((160, 200)),
    blur_px=st.floats(0.45, 1.6),
    panel_dn=st.floats(12, 60),
    slope_dn=st.tuples(st.floats(-10, 10), st.floats(-10, 10)),
    black_dn=st.floats(0, 8),
    gamma=st.floats(0.6, 1.5),
    noise_dn=st.floats(0.5, 1.5),
    full_dn=st.sampled_from([255.0, 1023.0, 4095.0, 65535.0]),
)


@given(drawing=drawings, seed=st.integers(0, 2**32 - 1))
def test_any_lens_sensor_panel_and_brightness(drawing: Drawing, seed: int) -> None:
    """Brightness from 0.4 of full scale to tenfold clipped: each found once, within five of its own sigmas."""
    rng = np.random.default_rng(seed)
    xy = lattice(4, 3, drawing.shape, rng)
    peak = drawing.full_dn * np.exp(rng.uniform(np.log(0.4), np.log(10), len(xy)))
    found = find(drawing, xy, peak, seed)
    off, z = errors(found, xy)
    assert len(found) == len(xy)
    assert np.abs(z).max() < 5
    assert np.abs(off).max() < 0.15


def test_flux_is_the_light_of_the_spot() -> None:
    drawing = Drawing()
    xy = lattice(10, 8, drawing.shape, np.random.default_rng(1))
    peak = np.linspace(40, 2000, len(xy))
    found = find(drawing, xy, peak)
    ratio = found.flux_dn[nearest(found, xy)] / (2 * np.pi * drawing.blur_px**2 * peak)
    assert np.abs(np.log(ratio)).max() < 0.3


@pytest.mark.parametrize("columns", [False, True], ids=["down", "across"])
@pytest.mark.parametrize("peak_dn", [1500, 6000])
@pytest.mark.parametrize("bloom", [0.5, 0.75, 1.0])
def test_charge_that_runs_over_leaves_the_centre(bloom: float, peak_dn: float, columns: bool) -> None:
    """Along columns, and, with the frame transposed, along rows."""
    drawing = Drawing(shape=(300, 360), bloom=bloom)
    xy = lattice(6, 5, drawing.shape, np.random.default_rng(2))
    image = drawing.draw(xy, peak_dn)
    image, xy = (image.T, xy[:, ::-1]) if columns else (image, xy)
    found = highlights.find(image, Detection(), drawing.sensor)
    off, z = errors(found, xy)
    assert np.sqrt(np.mean(off**2)) < 0.04
    assert np.abs(off).max() < 0.12
    assert z.std() < 1.4


@pytest.mark.parametrize("angle_deg", [0, 30, 45, 90])
@pytest.mark.parametrize(
    ("peaks_dn", "apart_px"),
    [((150, 150), 2.5), ((200, 60), 2.5), ((150, 150), 4.0), ((1000, 400), 4.0)],
    ids=["alike", "unlike", "apart", "clipped"],
)
def test_merged_spots_are_split_where_the_image_supports_it(
    peaks_dn: tuple[float, float], apart_px: float, angle_deg: float
) -> None:
    drawing = Drawing()
    first = lattice(7, 6, drawing.shape, np.random.default_rng(3))
    second = first + apart_px * np.array([np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))])
    xy, peaks = np.concatenate([first, second]), np.repeat(peaks_dn, len(first)).astype(np.float64)
    found = find(drawing, xy, peaks)
    off, z = errors(found, xy)
    assert len(found) == len(xy)
    assert np.sqrt(np.mean(off**2)) < 0.025
    assert z.std() < 1.4


def test_hot_pixels_are_told_from_spots() -> None:
    drawing = Drawing()
    xy = lattice(6, 5, drawing.shape, np.random.default_rng(4))
    image = drawing.draw(xy, 150)
    hot = np.array([[101, 203], [350, 77], [600, 440]])
    image[hot[:, 1], hot[:, 0]] = [255, 180, 90]
    found = highlights.find(image, Detection(), drawing.sensor)
    flagged = found.flags & Flag.HOT_PIXEL != 0
    assert sorted(map(tuple, np.rint(found.xy_px[flagged]).astype(int).tolist())) == sorted(map(tuple, hot.tolist()))
    assert len(found) == len(xy) + len(hot)


@pytest.mark.parametrize("at", [(0.0, 100.0), (639.0, 100.0), (300.0, 0.0), (300.0, 479.0), (0.0, 0.0), (639.3, 479.4)])
def test_a_spot_cut_by_the_edge_is_flagged(at: tuple[float, float]) -> None:
    xy = np.array([at, [320.2, 240.3]])
    found = find(Drawing(), xy, 150)
    index = nearest(found, xy)
    assert (found.flags[index] & Flag.AT_EDGE != 0).tolist() == [True, False]
    assert np.abs(found.xy_px[index[0]] - at).max() < 0.5


def test_small_and_large_spots_are_flagged_not_dropped() -> None:
    drawing, xy = Drawing(blur_px=1.5), np.array([[100.0, 100.0], [300.0, 300.0]])
    image = drawing.draw(xy, np.array([150.0, 20.0]))
    sizes = highlights.find(image, Detection(), drawing.sensor).area_px
    found = highlights.find(
        image, Detection(min_area_px=int(sizes.min()) + 1, max_area_px=int(sizes.max()) - 1), drawing.sensor
    )
    flags = found.flags[nearest(found, xy)]
    assert flags[0] & Flag.TOO_LARGE
    assert flags[1] & Flag.TOO_SMALL


def test_a_fixed_threshold_is_the_one_used() -> None:
    drawing = Drawing()
    xy = lattice(6, 5, drawing.shape, np.random.default_rng(5))
    image = drawing.draw(xy, np.repeat([40.0, 200.0], 15))
    found = highlights.find(image, Detection(threshold_dn=70.0), drawing.sensor)
    assert found.threshold_dn == 70
    assert len(found) == 15
    errors(found, xy[15:])
    assert len(highlights.find(image, Detection(threshold_dn=250.0), drawing.sensor)) == 0


@pytest.mark.parametrize("noise_dn", [0.5, 1.0, 2.0, 4.0])
def test_the_automatic_threshold_follows_the_noise(noise_dn: float) -> None:
    drawing = Drawing(panel_dn=40, noise_dn=noise_dn)
    found = find(drawing, np.array([[100.0, 200.0]]), 150)
    assert len(found) == 1
    total = np.hypot(noise_dn, np.sqrt(40 / 60))
    assert found.noise_dn == pytest.approx(np.hypot(total, 0.29), rel=0.15)
    assert found.background_dn == pytest.approx(43, abs=1)
    assert found.threshold_dn == pytest.approx(43 + 8 * found.noise_dn, abs=2)


def test_a_panel_without_highlights_has_none() -> None:
    found = find(Drawing(panel_dn=30, slope_dn=(40, 20)), np.empty((0, 2)), np.empty(0))
    assert len(found) == 0
    assert found.xy_px.shape == found.binary_px.shape == (0, 2)
    assert found.covariance_px2.shape == (0, 2, 2)


def test_a_tangle_too_large_to_fit_keeps_its_centroids_known_badly_and_says_so() -> None:
    """Beside it, a spot of its own is fitted as ever."""
    side = 4.0 * np.arange(44) + 20.2
    tangle = np.column_stack([axis.ravel() for axis in np.meshgrid(side, side)])
    alone = np.array([[230.3, 220.6]])
    most_lit = Detection(max_lit_fraction=1.0, threshold_dn=60.0)
    found = highlights.find(
        Drawing(shape=(240, 260)).draw(np.concatenate([tangle, alone]), 150), most_lit, Drawing().sensor
    )
    crowded = found.flags & Flag.CROWDED != 0
    index = nearest(found, alone)[0]
    assert crowded.sum() > 0.95 * len(tangle)
    assert not crowded[index]
    assert np.abs(found.xy_px[index] - alone[0]).max() < 0.03
    assert np.abs(found.xy_px[nearest(found, tangle)] - tangle).max() < 1.5
    assert found.covariance_px2[crowded][:, [0, 1], [0, 1]].min() >= 0.25


def test_more_spots_than_highlights_may_be_are_refused_though_they_are_one_component() -> None:
    """A bright, structured patch: one component of thousands of local maxima, with shallow ground between them."""
    drawing = Drawing(panel_dn=10)
    image = drawing.draw(np.empty((0, 2)), np.empty(0))
    rows, columns = np.mgrid[100:220, 100:220]
    image[100:220, 100:220] = 120 + 40 * ((rows % 2 == 0) & (columns % 2 == 0))
    with pytest.raises(highlights.FrameRefused) as refused:
        highlights.find(image, Detection(threshold_dn=60.0), drawing.sensor)
    assert refused.value.reason is Reason.TOO_MANY_HIGHLIGHTS


def test_spots_far_from_hidden_ones_are_where_a_fit_from_the_start_puts_them(monkeypatch: pytest.MonkeyPatch) -> None:
    image, go_on, gone_on = imagefile.read(CROWDED), highlights._start, []
    found = highlights.find(image, Detection(), Sensor())

    def start_anew(spots: Spots, measured: kernel.Measured, hosts: IntArray) -> FloatArray:
        start = go_on(spots, measured, hosts)
        gone_on.append(np.isfinite(start).all(axis=1).sum())
        return np.full_like(start, np.nan)

    monkeypatch.setattr(highlights, "_start", start_anew)
    anew = highlights.find(image, Detection(), Sensor())
    assert max(gone_on) > len(found) / 2
    assert np.abs(found.xy_px - anew.xy_px).max() < 0.005
