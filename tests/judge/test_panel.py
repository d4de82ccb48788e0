"""Frames into one panel: each seed once, in panel coordinates; and what was not seen whole is never a PASS."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from views import View

from inspector import reflection
from inspector.judge.panel import PanelStation, judge_panel
from inspector.model import Defect, Flag, FrameResult, PanelFrame, PanelFrames, PanelResult, Reason, Unpaired, Verdict
from inspector.panel_settings import PanelSettings
from inspector.recipe import Limits

CALIBRATION = View().calibration
WINDOW_MM = 60.0
"""Tests' frames see so much along the travel, from -WINDOW_MM / 2 on, which lies in the view."""


def station(direction_deg: float = 0.0, limits: dict[str, Any] | None = None, **panel: Any) -> PanelStation:
    said = {
        "frames": {"kind": "plc"},
        "travel": {"by": {"kind": "pitch", "mm_per_frame": 40.0}, "direction_deg": direction_deg},
    }
    return PanelStation(
        CALIBRATION,
        Limits.model_validate(limits or {"max_height_um": None}),
        PanelSettings.model_validate_json(json.dumps(said | panel)),
    )


def seed(x_mm: float, y_mm: float, height_um: float = 1000.0, sigma_um: float | None = 5.0, **more: Any) -> Defect:
    return Defect(x_mm, y_mm, height_um, sigma_um, (0.0, 0.0), (1.0, 1.0), place_sigma_mm=0.02, **more)


def moved(defect: Defect, travel_mm: float, at: PanelStation) -> Defect:
    """A seed of the panel as a frame shows it."""
    x, y = at.direction * travel_mm
    return replace(defect, x_mm=defect.x_mm + x, y_mm=defect.y_mm + y)


def frame(*defects: Defect, travel_mm: float = 0.0, unpaired: tuple[Unpaired, ...] = (), **more: Any) -> PanelFrame:
    return PanelFrame(FrameResult("f", Verdict.PASS, defects=defects, unpaired=unpaired, **more), travel_mm)


def judged(*frames: PanelFrame, at: PanelStation | None = None, missing: tuple[str, ...] = ()) -> PanelResult:
    return judge_panel(PanelFrames(7, frames, missing), at or station())


def cut(scene: list[Defect], travels: list[float], at: PanelStation) -> list[PanelFrame]:
    """The scene as frames at these travels show it: what lies in a window along the travel."""

    def in_view(defect: Defect) -> bool:
        along = float(at.direction @ (defect.x_mm, defect.y_mm))
        return -WINDOW_MM / 2 <= along <= WINDOW_MM / 2

    shown = [[m for d in scene if in_view(m := moved(d, travel, at))] for travel in travels]
    return [frame(*some, travel_mm=travel) for some, travel in zip(shown, travels, strict=True)]


LATTICE = st.integers(-160, 160)
SCENES = st.lists(
    st.tuples(LATTICE, LATTICE, st.floats(50, 4000), st.sampled_from([None, 2.0, 20.0])),
    max_size=12,
    unique_by=lambda s: s[:2],
)
TRAVELS = st.lists(st.floats(-60, 60), min_size=1, max_size=5)


def scene_of(drawn: list[tuple[int, int, float, float | None]]) -> list[Defect]:
    """Seeds that may be half a millimetre from each other, nearer than the travel is known."""
    return [seed(x / 2, y / 2, height, sigma) for x, y, height, sigma in drawn]


def places(defects: Any) -> list[tuple[float, float, float]]:
    return sorted((round(d.x_mm, 6) + 0.0, round(d.y_mm, 6) + 0.0, d.height_um) for d in defects)


@given(SCENES, TRAVELS, st.floats(-180, 180))
def test_a_scene_cut_into_any_overlapping_frames_is_what_one_large_frame_shows(
    drawn: list[Any], travels: list[float], direction_deg: float
) -> None:
    at = station(direction_deg)
    scene = scene_of(drawn)
    frames = cut(scene, travels, at)
    seen = {
        (d.x_mm, d.y_mm)
        for d in scene
        for t in travels
        if abs(float(at.direction @ (d.x_mm, d.y_mm)) + t) <= WINDOW_MM / 2
    }
    assert places(judged(*frames, at=at).defects) == places(d for d in scene if (d.x_mm, d.y_mm) in seen)


@given(SCENES, TRAVELS, st.randoms(use_true_random=False))
def test_the_order_of_frames_and_seeds_does_not_matter(drawn: list[Any], travels: list[float], random: Any) -> None:
    frames = cut(scene_of(drawn), sorted(set(travels)), station())
    lone = tuple(
        Unpaired(random.uniform(50, 600), random.uniform(50, 400), random.choice(list(Flag))) for _ in range(3)
    )
    frames = [replace(f, result=replace(f.result, unpaired=lone[: i % 4])) for i, f in enumerate(frames)]
    first = judged(*frames)
    random.shuffle(frames)
    shuffled = []
    for f in frames:
        defects = list(f.result.defects)
        random.shuffle(defects)
        shuffled.append(replace(f, result=replace(f.result, defects=tuple(defects))))
    assert judged(*shuffled) == first


LIKE_HEIGHT = st.sampled_from([500.0, 510.0, 2000.0, math.nan])
SIGHTING = st.builds(seed, st.floats(-1, 1), st.floats(-1, 1), LIKE_HEIGHT | st.floats(50, 2000))
FRAMES = st.lists(st.lists(SIGHTING, max_size=4), min_size=1, max_size=4)


@given(FRAMES)
def test_what_one_frame_tells_apart_is_never_counted_as_one(shown: list[list[Defect]]) -> None:
    counted = len(judged(*(frame(*defects, travel_mm=float(n)) for n, defects in enumerate(shown))).defects)
    assert max(map(len, shown)) <= counted <= sum(map(len, shown))


def test_one_seed_between_two_of_another_frame_joins_one_of_them() -> None:
    two, between = frame(seed(0, 0), seed(0.8, 0)), frame(seed(40.3, 0), travel_mm=40.0)
    assert [d.x_mm for d in judged(two, between).defects] in ([0.0, 0.8], [pytest.approx(0.3), 0.8])


@given(st.lists(SIGHTING, max_size=5), st.lists(SIGHTING, max_size=5))
def test_seeds_are_joined_only_where_frames_overlap(one: list[Defect], other: list[Defect]) -> None:
    alone = judged(frame(*one))
    assert len(alone.defects) == len(one)
    apart = judged(frame(*one), frame(*other, travel_mm=50.0))
    assert len(apart.defects) == len(one) + len(other)


@given(st.integers(0, 10**6), st.sampled_from([0.0, 0.01, 0.02]))
@settings(max_examples=40)
def test_seeds_well_apart_are_counted_once_however_the_travel_errs(number: int, share: float) -> None:
    rng = np.random.default_rng(number)
    grid = [(8.0 * i, 8.0 * j) for i in range(-6, 7) for j in range(-2, 3)]
    scene = [seed(x, y, rng.uniform(100, 3000), 10.0) for x, y in grid]
    at = station(travel={"by": {"kind": "pitch", "mm_per_frame": 1.0}, "sigma_share": 0.02, "sigma_mm": 0.1})
    travels = [-30.0, 0.0, 30.0]
    frames = cut(scene, travels, at)
    err = 1 + share * rng.choice([-1, 1])
    noisy = [
        frame(
            *(
                replace(
                    d,
                    x_mm=d.x_mm + rng.normal(0, 0.05),
                    y_mm=d.y_mm + rng.normal(0, 0.05),
                    height_um=d.height_um + rng.normal(0, 8.0),
                )
                for d in f.result.defects
            ),
            travel_mm=f.travel_mm * err,
        )
        for f in frames
    ]
    found = judged(*noisy, at=at).defects
    assert len(found) == len({places([d])[0][:2] for d in scene if -60 <= d.x_mm <= 60})


def test_the_best_measured_sighting_is_kept_with_what_all_of_them_say() -> None:
    poor, good = seed(10, 0, 1010.0, 40.0, flags=Flag.SATURATED), seed(50, 0, 1000.0, 4.0, flags=Flag.SUNK)
    (found,) = judged(frame(poor), frame(good, travel_mm=40.0)).defects
    assert (found.height_um, found.height_sigma_um) == (1000.0, 4.0)
    assert (found.x_mm, found.y_mm) == (10.0, 0.0)
    assert found.flags == Flag.SATURATED | Flag.SUNK
    at_edge, inside = seed(10, 0, 1010.0, 1.0, flags=Flag.AT_EDGE), seed(50, 0, 1000.0, 4.0)
    (found,) = judged(frame(at_edge), frame(inside, travel_mm=40.0)).defects
    assert (found.height_um, found.flags) == (1000.0, Flag(0))


def test_the_higher_of_two_sightings_is_kept_where_the_method_knows_no_sigma() -> None:
    (found,) = judged(frame(seed(10, 0, 990.0, None)), frame(seed(50, 0, 1000.0, None), travel_mm=40.0)).defects
    assert found.height_um == 1000.0


@pytest.mark.parametrize(
    ("other", "count"),
    [
        (seed(50.3, 0), 1),
        (seed(52.5, 0), 2),
        (seed(50, 0, 1060.0), 1),
        (seed(50, 0, 1200.0), 2),
        (seed(50, 0, 1200.0, 60.0), 1),
        (seed(50, 0, math.nan), 1),
        (seed(math.nan, 0), 2),
    ],
)
def test_two_sightings_are_one_seed_if_place_and_height_agree(other: Defect, count: int) -> None:
    found = judged(frame(seed(10, 0)), frame(other, travel_mm=40.0)).defects
    assert len(found) == count
    assert any(d.height_um == 1000.0 for d in found) or other.height_um == 1060.0


def spots_of(defect: Defect) -> tuple[tuple[float, float], tuple[float, float]]:
    """Pixels of a seed's two spots in the frame whose coordinates it has."""
    radius = defect.height_um / 2000
    ends = reflection.highlights(np.array([[defect.x_mm, defect.y_mm, radius, radius]]), CALIBRATION)
    (direct,), (mirror,) = (end.tolist() for end in ends)
    return tuple(direct), tuple(mirror)


FAIL_ON_LONE = {"max_height_um": None, "unmeasured_seed": "fail", "max_unpaired": 0}


@pytest.mark.parametrize("end", [0, 1])
@pytest.mark.parametrize("flags", [Flag.PARTNER_OUTSIDE_FRAME | Flag.AT_EDGE, Flag.PARTNER_HIDDEN, Flag.AMBIGUOUS])
def test_a_spot_without_its_partner_is_resolved_by_a_frame_that_measures_the_seed(end: int, flags: Flag) -> None:
    at, on_panel = station(limits=FAIL_ON_LONE), seed(-20, 5, 2000.0)
    x, y = spots_of(on_panel)[end]
    border = frame(unpaired=(Unpaired(x + 0.3, y - 0.3, flags),))
    measured = frame(moved(on_panel, 25.0, at), travel_mm=25.0)
    alone = judged(border, at=at)
    assert (alone.verdict, len(alone.unpaired)) == (Verdict.FAIL, 1)
    both = judged(border, measured, at=at)
    assert (both.verdict, both.unpaired, len(both.defects)) == (Verdict.PASS, (), 1)


def test_spots_that_ran_into_one_are_resolved_by_a_frame_that_tells_them_apart() -> None:
    at, on_panel = station(limits=FAIL_ON_LONE), seed(-20, 5, 900.0)
    direct, mirror = spots_of(on_panel)
    middle = [(a + b) / 2 for a, b in zip(direct, mirror, strict=True)]
    merged = frame(unpaired=(Unpaired(middle[0], middle[1], Flag.MERGED),))
    assert judged(merged, frame(moved(on_panel, 25.0, at), travel_mm=25.0), at=at).unpaired == ()


def test_a_spot_elsewhere_stays_and_one_seed_explains_no_third_spot() -> None:
    at, on_panel = station(limits=FAIL_ON_LONE), seed(-20, 5, 2000.0)
    (x, y), (u, v) = spots_of(on_panel)
    flags = Flag.PARTNER_HIDDEN
    border = frame(unpaired=(Unpaired(x, y, flags), Unpaired(u, v, flags), Unpaired(x + 0.2, y, flags)))
    measured = frame(moved(on_panel, 25.0, at), travel_mm=25.0)
    both = judged(border, measured, at=at)
    assert (both.verdict, len(both.unpaired)) == (Verdict.FAIL, 1)
    elsewhere = frame(unpaired=(Unpaired(x + 60, y + 40, flags),))
    assert len(judged(elsewhere, measured, at=at).unpaired) == 1


def test_a_seed_that_its_own_frame_measures_explains_no_lone_spot_of_that_frame() -> None:
    at, on_panel = station(limits=FAIL_ON_LONE), seed(-20, 5, 2000.0)
    x, y = spots_of(on_panel)[0]
    same = frame(on_panel, unpaired=(Unpaired(x, y, Flag.PARTNER_HIDDEN),))
    other = frame(moved(on_panel, 25.0, at), travel_mm=25.0)
    assert judged(same, other, at=at).verdict is Verdict.FAIL


def test_dust_that_two_frames_show_is_told_once_and_kinds_are_kept_apart() -> None:
    at = station()
    here = np.array([[-20.0, 5.0, 0.0]])
    (first,), (second,) = (CALIBRATION.camera.project(here + [s, 0, 0]).tolist() for s in (0.0, 25.0))
    for other, count in ((Flag.DUST, 1), (Flag.DUST | Flag.SATURATED, 1), (Flag.MERGED, 2), (Flag.PAINT_POOL, 2)):
        one = frame(unpaired=(Unpaired(*first, Flag.DUST),))
        two = frame(unpaired=(Unpaired(*second, other),), travel_mm=25.0)
        found = judged(one, two, at=at).unpaired
        assert len(found) == count
        assert found[0].flags & Flag.DUST or count == 2
        assert (found[0].x_mm, found[0].y_mm) == pytest.approx((-20.0, 5.0), abs=1e-6)


def test_limits_and_zones_hold_over_the_panel() -> None:
    zone = {"name": "door", "x_min_mm": -70.0, "x_max_mm": -55.0, "y_min_mm": -20.0, "y_max_mm": 20.0, "max_count": 0}
    # In its frame the seed lies at x = -20; on the panel at -60, in the zone.
    frames = (frame(), frame(seed(-20, 0), travel_mm=40.0))
    at = station(limits={"max_height_um": None, "zones": [zone]})
    assert judged(*frames, at=at).reasons == Reason.ZONE_LIMIT
    twice = (frame(seed(-20, 0)), frame(seed(20, 0), travel_mm=40.0))
    assert judged(*twice, at=station(limits={"max_height_um": None, "max_count": 1})).verdict is Verdict.PASS


def test_density_is_over_the_area_that_the_frames_saw_together() -> None:
    one, again, two = judged(frame()), judged(frame(), frame()), judged(frame(), frame(travel_mm=30.0))
    x, y = CALIBRATION.camera.outline_mm().T
    exact = abs(float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))) / 2e6
    assert one.extent.area_m2 == pytest.approx(exact, rel=2e-3)
    assert again.extent.area_m2 == one.extent.area_m2
    assert one.extent.area_m2 < two.extent.area_m2 <= one.extent.area_m2 + 30.0 * (y.max() - y.min()) / 1e6 * 1.001
    assert two.extent.bounds_mm == pytest.approx((x.min() - 30.0, y.min(), x.max(), y.max()))
    assert two.extent.rim_mm == pytest.approx(one.extent.rim_mm + 60.0)
    limit = 1 / ((one.extent.area_m2 + two.extent.area_m2) / 2)
    at = station(limits={"max_height_um": None, "max_per_m2": limit})
    assert judged(frame(seed(0, 0)), at=at).verdict is Verdict.FAIL
    assert judged(frame(seed(0, 0)), frame(seed(30, 0), travel_mm=30.0), at=at).verdict is Verdict.PASS


def refused() -> PanelFrame:
    return PanelFrame(FrameResult("f", Verdict.NOT_INSPECTED, Reason.FRAME_BLACK, ("the frame is black",)), 40.0)


@pytest.mark.parametrize(
    ("frames", "panel", "expected"),
    [
        ((), {}, "0 frames instead of 1"),
        ((frame(), refused()), {}, "frame 2 of 2: the frame is black"),
        ((frame(),), {"min_frames": 2}, "1 frames instead of 2"),
        ((frame(),), {"frames": {"kind": "count", "count": 3}}, "1 frames instead of 3"),
        ((frame(), frame(travel_mm=500.0)), {}, "mm between two frames were not seen"),
        (
            (frame(), frame(travel_mm=40.0)),
            {"area": {"x_min_mm": -700.0, "x_max_mm": 0.0, "y_min_mm": -5.0, "y_max_mm": 5.0}},
            "of the panel was not seen",
        ),
    ],
)
def test_a_panel_not_seen_whole_is_not_inspected_and_says_why(
    frames: tuple[PanelFrame, ...], panel: dict[str, Any], expected: str
) -> None:
    found = judged(*frames, at=station(**panel))
    assert found.verdict is Verdict.NOT_INSPECTED
    assert Reason.PANEL_INCOMPLETE in found.reasons
    assert any(expected in text for text in found.reasons_text), found.reasons_text


def test_a_panel_whose_area_all_frames_together_saw_passes() -> None:
    area = {"x_min_mm": -60.0, "x_max_mm": 0.0, "y_min_mm": -5.0, "y_max_mm": 5.0}
    assert judged(frame(), frame(travel_mm=40.0), at=station(area=area)).verdict is Verdict.PASS


def test_a_measured_seed_over_its_limit_fails_a_panel_not_seen_whole_and_nothing_less_does() -> None:
    limits = {"max_height_um": 500.0, "max_per_m2": 1e-6, "max_unpaired": 0}
    at = station(limits=limits)
    high, low = frame(seed(0, 0, 900.0)), frame(seed(0, 0, 100.0), unpaired=(Unpaired(300, 200, Flag.MERGED),))
    assert judged(high, at=at, missing=("a frame is missing",)).verdict is Verdict.FAIL
    assert judged(high, at=at, missing=("a frame is missing",)).reasons & Reason.PANEL_INCOMPLETE
    assert judged(low, at=at, missing=("a frame is missing",)).verdict is Verdict.NOT_INSPECTED
    assert judged(low, at=at).verdict is Verdict.FAIL


LONE = st.builds(Unpaired, st.floats(0, 640), st.floats(0, 480), st.sampled_from(list(Flag)))
ANY_FRAME = st.builds(
    lambda defects, lone, travel, refuse: replace(
        frame(*defects, travel_mm=travel, unpaired=tuple(lone)),
        **({"result": refused().result} if refuse else {}),
    ),
    st.lists(SIGHTING, max_size=3),
    st.lists(LONE, max_size=3),
    st.floats(-200, 200),
    st.booleans(),
)
LIMITS = st.fixed_dictionaries(
    {},
    optional={
        "max_height_um": st.none() | st.floats(1, 3000),
        "max_count": st.integers(0, 3),
        "max_per_m2": st.floats(0.1, 1000),
        "max_unpaired": st.integers(0, 2),
        "unmeasured_seed": st.sampled_from(["fail", "report"]),
    },
)


@given(st.lists(ANY_FRAME, max_size=4), LIMITS, st.booleans())
def test_a_fault_is_never_a_pass(frames: list[PanelFrame], limits: dict[str, Any], missing: bool) -> None:
    at = station(limits=limits)
    found = judged(*frames, at=at, missing=("a trigger brought no frame",) if missing else ())
    if missing or not frames or any(f.result.verdict is Verdict.NOT_INSPECTED for f in frames):
        assert found.verdict is not Verdict.PASS
        assert Reason.PANEL_INCOMPLETE in found.reasons
    assert bool(found.reasons_text) == bool(found.reasons)
    if found.verdict is Verdict.FAIL and Reason.PANEL_INCOMPLETE in found.reasons:
        # Whatever the missing part would have shown, the same seeds fail the panel that was seen whole.
        sound = [f for f in frames if f.result.verdict is not Verdict.NOT_INSPECTED]
        assert judged(*sound, at=at).verdict is Verdict.FAIL
