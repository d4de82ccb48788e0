"""Lists of spots whose pairs are known: direct told from mirror for any camera, and nothing else paired."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from spot_lists import flagged, seen, shuffled, spots_at, together
from views import View, seeds_at, spread_px, views

from inspector.detect.pairs import pair
from inspector.estimate import heights
from inspector.model import Flag, FloatArray, HighlightPairs, Highlights
from inspector.optics import Calibration

SEEDS = st.integers(0, 2**32 - 1)
THESIS = View().calibration


def couples(pairs: HighlightPairs) -> set[tuple[int, int]]:
    return set(zip(pairs.direct.tolist(), pairs.mirror.tolist(), strict=True))


def resting(n: int) -> set[tuple[int, int]]:
    """The pairs of a list made by `seen`: n direct spots, then their mirror spots."""
    return {(k, k + n) for k in range(n)}


def apart(n: int, rng: np.random.Generator, gap_px: float = 50.0) -> FloatArray:
    """Pixels (n, 2) anywhere in the frame, none nearer to another than ``gap_px``."""
    chosen = spread_px(1, rng)
    while len(chosen) < n:
        new = spread_px(1, rng)
        if np.hypot(*(chosen - new).T).min() > gap_px:
            chosen = np.concatenate([chosen, new])
    return chosen


@given(view=views, n=st.integers(1, 8), seed=SEEDS)
def test_every_seed_is_paired_and_direct_told_from_mirror(view: View, n: int, seed: int) -> None:
    """Any camera, roll and lamp; the spots come in any order."""
    rng, calibration = np.random.default_rng(seed), view.calibration
    spots = seen(seeds_at(apart(n, rng), rng.uniform(6, 25, n), calibration), calibration, rng)
    order = rng.permutation(2 * n)
    pairs = pair(shuffled(spots, order), calibration)
    assert {(int(order[d]), int(order[m])) for d, m in couples(pairs)} == resting(n)
    assert len(pairs.unpaired) == 0


@given(
    roll_deg=st.floats(-180, 180),
    lamp_azimuth_deg=st.floats(172, 188),
    mirrored=st.booleans(),
    sunk=st.floats(0.45, 0.95),
    seed=SEEDS,
)
def test_seeds_sunk_in_the_paint_are_paired_too(
    roll_deg: float, lamp_azimuth_deg: float, mirrored: bool, sunk: float, seed: int
) -> None:
    """The thesis' angles, any roll: centres from 0.45 to 0.95 of the radius above the paint."""
    rng = np.random.default_rng(seed)
    calibration = View(roll_deg=roll_deg, lamp_azimuth_deg=lamp_azimuth_deg, mirrored=mirrored).calibration
    spots = seen(seeds_at(apart(4, rng), rng.uniform(6, 20, 4), calibration, sunk), calibration, rng)
    assert couples(pair(spots, calibration)) == resting(4)


@given(view=views, n=st.integers(0, 30), seed=SEEDS)
def test_every_highlight_is_somewhere_and_only_once(view: View, n: int, seed: int) -> None:
    """Spots anywhere, of any brightness and with any flags: the most tangled lists there are."""
    rng = np.random.default_rng(seed)
    spots = spots_at(rng.uniform([250, 180], [390, 300], (n, 2)), np.exp(rng.uniform(3, 9, n)))
    spots = replace(spots, flags=rng.choice([0, 0, 0, 1, 2, 4, 8, 16, 32], n).astype(np.intp))
    pairs = pair(spots, view.calibration)
    assert sorted([*pairs.direct, *pairs.mirror, *pairs.unpaired]) == list(range(n))
    assert len(pairs.flags) == len(pairs.direct)
    assert len(pairs.unpaired_flags) == len(pairs.unpaired)


def measured(spots: Highlights, calibration: Calibration) -> tuple[FloatArray, FloatArray]:
    """Heights and their deviations, um, in the order of the direct spots' indices."""
    pairs = pair(spots, calibration)
    defects, _ = heights.measure(spots, pairs, calibration, "exact")
    by_spot = sorted(defects, key=lambda d: spots.xy_px[:, 0].tolist().index(d.direct_px[0]))
    sigma = [d.height_sigma_um for d in by_spot if d.height_sigma_um is not None]
    return np.array([d.height_um for d in by_spot]), np.array(sigma)


def carried(calibration: Calibration, turn: FloatArray, shift_mm: FloatArray) -> Calibration:
    """The whole station moved: world points p become turn p + shift; a mirroring turn mirrors the image's x too."""
    flip = np.diag([np.linalg.det(turn), 1.0, 1.0])
    camera, light = calibration.camera, calibration.light
    rotation = flip @ camera.rotation @ turn.T
    translation = flip @ camera.translation_mm - rotation @ shift_mm
    direction = None if light.direction is None else turn @ light.direction
    position = None if light.position_mm is None else turn @ light.position_mm + shift_mm
    return replace(
        calibration,
        camera=replace(camera, rotation=rotation, translation_mm=translation),
        light=replace(light, direction=direction, position_mm=position),
    )


@given(
    view=views,
    angle_deg=st.floats(-180, 180),
    mirror=st.booleans(),
    shift_mm=st.tuples(st.floats(-300, 300), st.floats(-300, 300)),
    seed=SEEDS,
)
def test_a_station_turned_mirrored_and_shifted_measures_the_same(
    view: View, angle_deg: float, mirror: bool, shift_mm: tuple[float, float], seed: int
) -> None:
    """Camera, lamp and seeds together: the image stays, or is mirrored, and so do the heights."""
    rng, calibration = np.random.default_rng(seed), view.calibration
    spots = seen(seeds_at(apart(4, rng), rng.uniform(6, 25, 4), calibration), calibration, rng)
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ np.diag([1.0, -1.0 if mirror else 1.0, 1.0])
    moved = carried(calibration, turn, np.array([*shift_mm, 0.0]))
    image = replace(spots, xy_px=spots.xy_px * [-1, 1] + [640, 0]) if mirror else spots
    expected, sigma = measured(spots, calibration)
    assert len(expected) == 4
    found, found_sigma = measured(image, moved)
    assert found == pytest.approx(expected, abs=1e-3 * sigma.min())
    assert found_sigma == pytest.approx(sigma, rel=1e-2)


@given(view=views, roll_deg=st.floats(-180, 180), seed=SEEDS)
def test_a_rolled_camera_measures_the_same_to_its_noise(view: View, roll_deg: float, seed: int) -> None:
    """Other pixels, other noise: heights change by no more than both noises explain."""
    rng = np.random.default_rng(seed)
    calibration, rolled = view.calibration, replace(view, roll_deg=view.roll_deg + roll_deg).calibration
    seeds = seeds_at(apart(4, rng) * 0.5 + [160, 120], rng.uniform(8, 25, 4), calibration)
    (first, first_sigma), (second, second_sigma) = (measured(seen(seeds, c, rng), c) for c in (calibration, rolled))
    assert len(first) == len(second) == 4
    assert np.abs(first - second).max() < 5 * np.hypot(first_sigma, second_sigma).max()


def along_one_line(starts_px: list[float], spacings_px: list[float], calibration: Calibration) -> FloatArray:
    """Seeds (n, 4) whose spots all lie on one line: direct spots at ``starts_px`` along it, mirror spots further on."""
    middle = np.array([[320.0, 240.0]])
    pixels = seen(seeds_at(middle, 1.0, calibration), calibration, np.random.default_rng(0), 0.0).xy_px
    toward = (pixels[1] - pixels[0]) / np.hypot(*(pixels[1] - pixels[0]))
    return seeds_at(middle + np.outer(starts_px, toward), np.array(spacings_px), calibration)


@pytest.mark.parametrize(
    ("starts_px", "spacings_px"),
    [
        pytest.param([-30.0, -24.0], [20.0, 20.0], id="interleaved, alike"),
        pytest.param([-30.0, -22.0], [24.0, 10.0], id="one within the other"),
        pytest.param([-30.0, -14.0], [20.0, 12.0], id="interleaved, unlike"),
        pytest.param([-40.0, -32.0, -24.0], [20.0, 20.0, 20.0], id="three interleaved"),
        pytest.param([-40.0, -15.0, 10.0], [15.0, 15.0, 15.0], id="one behind the other"),
    ],
)
def test_seeds_whose_spots_interleave_on_one_line(starts_px: list[float], spacings_px: list[float]) -> None:
    """Position alone cannot tell them: brightness and the frame's other seeds do. Twenty draws of noise."""
    line = along_one_line(starts_px, spacings_px, THESIS)
    others = seeds_at(np.array([[150.0, 100.0], [500.0, 120.0], [140.0, 400.0], [480.0, 390.0]]), 15.0, THESIS)
    seeds = np.concatenate([line, others])
    right = [
        couples(pair(seen(seeds, THESIS, np.random.default_rng(k)), THESIS)) == resting(len(seeds)) for k in range(20)
    ]
    assert np.mean(right) >= 0.9


@pytest.mark.parametrize("brightness", [0.3, 1.0, 5.0, 20.0])
@pytest.mark.parametrize("share", [0.15, 0.3, 0.45])
def test_a_paint_pools_spot_is_neither_seed_nor_mirror(share: float, brightness: float) -> None:
    """The third spot, from the foot of the seed: between the two, nearer to the mirror spot, dim or very bright."""
    rng = np.random.default_rng(0)
    seeds = seeds_at(apart(5, rng), rng.uniform(10, 25, 5), THESIS)
    spots = seen(seeds, THESIS, rng)
    direct, mirror = spots.xy_px[:5], spots.xy_px[5:]
    pool = spots_at(mirror + share * (direct - mirror), brightness * spots.flux_dn[5:])
    pairs = pair(together(spots, pool), THESIS)
    assert couples(pairs) == resting(5)
    assert pairs.unpaired.tolist() == [10, 11, 12, 13, 14]
    assert np.all(pairs.unpaired_flags & Flag.PAINT_POOL)


def test_a_lone_spot_never_becomes_a_height() -> None:
    for xy in spread_px(20, np.random.default_rng(0)):
        spots = spots_at(xy[None], 500.0)
        pairs = pair(spots, THESIS)
        defects, unpaired = heights.measure(spots, pairs, THESIS, "exact")
        assert defects == ()
        assert len(unpaired) == 1


def test_dust_that_does_not_lie_as_a_seeds_spots_do_never_pairs() -> None:
    """Beside and behind each other: every couple is 45 degrees or more off the direction from direct to mirror."""
    along = np.diff(along_one_line([0.0, 1.0], [1.0, 1.0], THESIS)[:, :2], axis=0)
    foot = THESIS.camera.back_project(np.array([[320.0, 240.0]]))
    across = np.array([[-along[0, 1], along[0, 0]]]) / np.hypot(*along[0])
    world = foot + np.linspace(-12, 12, 9)[:, None] * across
    xy = THESIS.camera.project(np.column_stack([world, np.zeros(9)]))
    pairs = pair(spots_at(xy, 500.0), THESIS)
    assert couples(pairs) == set()
    assert np.all(pairs.unpaired_flags & Flag.DUST)


def test_dust_anywhere_rarely_lies_like_a_seed() -> None:
    """200 panels with six specks each: chance alone makes a pair that no camera could tell from a seed."""
    count = 0
    for seed in range(200):
        rng = np.random.default_rng(seed)
        count += len(pair(spots_at(spread_px(6, rng), np.exp(rng.uniform(5, 8, 6))), THESIS).direct)
    assert count <= 20


def test_dust_beside_seeds_changes_no_pair() -> None:
    rng = np.random.default_rng(1)
    seeds = seeds_at(apart(5, rng), rng.uniform(8, 20, 5), THESIS)
    right = 0
    for seed in range(50):
        noise = np.random.default_rng(seed)
        spots = together(seen(seeds, THESIS, noise), spots_at(spread_px(5, noise), np.exp(noise.uniform(5, 8, 5))))
        right += resting(5) <= couples(pair(spots, THESIS))
    assert right >= 48


@pytest.mark.parametrize("flag", [Flag.HOT_PIXEL, Flag.TOO_SMALL, Flag.TOO_LARGE])
def test_what_is_no_spot_is_not_paired(flag: Flag) -> None:
    rng = np.random.default_rng(2)
    spots = flagged(seen(seeds_at(apart(3, rng), 12.0, THESIS), THESIS, rng), flag)
    pairs = pair(spots, THESIS)
    assert couples(pairs) == set()
    assert np.all(pairs.unpaired_flags & flag)


def test_a_seed_whose_mirror_spot_is_missing_is_no_height() -> None:
    """Cut off by the frame, or hidden: of four seeds the first shows its direct spot only."""
    rng = np.random.default_rng(3)
    spots = seen(seeds_at(apart(4, rng), 14.0, THESIS), THESIS, rng)
    pairs = pair(shuffled(spots, np.delete(np.arange(8), 4)), THESIS)
    assert couples(pairs) == {(1, 4), (2, 5), (3, 6)}
    assert pairs.unpaired.tolist() == [0]


def test_flags_of_both_spots_are_the_pairs() -> None:
    rng = np.random.default_rng(4)
    spots = seen(seeds_at(apart(2, rng), 14.0, THESIS), THESIS, rng)
    flags = np.array([Flag.SATURATED, 0, Flag.AT_EDGE, 0], np.intp)
    pairs = pair(replace(spots, flags=flags), THESIS)
    by_direct = dict(zip(pairs.direct.tolist(), pairs.flags.tolist(), strict=True))
    assert by_direct == {0: Flag.SATURATED | Flag.AT_EDGE, 1: 0}
