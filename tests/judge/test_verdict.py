"""The verdict: each rule by example, and the promises that hold for any defects and limits."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from inspector.judge.verdict import judge
from inspector.model import Defect, Flag, Reason, Unpaired, Verdict
from inspector.recipe import Limits, Zone

AREA_M2 = 0.01


def seed(height_um: float, sigma_um: float | None = None, x_mm: float = 0.0, y_mm: float = 0.0) -> Defect:
    return Defect(x_mm, y_mm, height_um, sigma_um, (0.0, 0.0), (1.0, 1.0))


def zone(**limits: object) -> Zone:
    return Zone.model_validate(
        {"name": "door", "x_min_mm": 0.0, "x_max_mm": 9.0, "y_min_mm": 0.0, "y_max_mm": 9.0} | limits
    )


def verdict_of(*defects: Defect, unpaired: tuple[Unpaired, ...] = (), **limits: object) -> tuple[Verdict, Reason]:
    verdict, reasons, texts = judge(defects, unpaired, Limits.model_validate(limits), AREA_M2)
    assert bool(texts) == bool(reasons)
    return verdict, reasons


def test_a_clean_panel_passes_without_reasons() -> None:
    assert judge((), (), Limits(), AREA_M2) == (Verdict.PASS, Reason(0), ())


@pytest.mark.parametrize(
    ("height_um", "sigma_um", "guard_band", "verdict", "reason"),
    [
        (500, None, "fail", Verdict.PASS, Reason(0)),
        (500.1, None, "fail", Verdict.FAIL, Reason.HEIGHT_LIMIT),
        (500.1, 0.0, "pass", Verdict.FAIL, Reason.HEIGHT_LIMIT),
        (479.9, 10, "fail", Verdict.PASS, Reason(0)),
        (480, 10, "fail", Verdict.PASS, Reason(0)),
        (481, 10, "fail", Verdict.FAIL, Reason.HEIGHT_WITHIN_GUARD_BAND),
        (520, 10, "fail", Verdict.FAIL, Reason.HEIGHT_WITHIN_GUARD_BAND),
        (521, 10, "fail", Verdict.FAIL, Reason.HEIGHT_LIMIT),
        (519, 10, "pass", Verdict.PASS, Reason.HEIGHT_WITHIN_GUARD_BAND),
        (521, 10, "pass", Verdict.FAIL, Reason.HEIGHT_LIMIT),
    ],
)
def test_a_height_within_its_uncertainty_of_the_limit_is_decided_by_the_guard_band(
    height_um: float, sigma_um: float | None, guard_band: str, verdict: Verdict, reason: Reason
) -> None:
    got = verdict_of(seed(height_um, sigma_um), max_height_um=500.0, guard_band_sigma=2.0, guard_band=guard_band)
    assert got == (verdict, reason)


def test_seeds_surely_below_the_least_height_do_not_count() -> None:
    limits = {"min_height_um": 100.0, "max_count": 0, "guard_band_sigma": 2.0}
    assert verdict_of(seed(79, 10), **limits) == (Verdict.PASS, Reason(0))
    assert verdict_of(seed(81, 10), **limits) == (Verdict.FAIL, Reason.COUNT_LIMIT)


def test_counts_and_density() -> None:
    three = [seed(100)] * 3
    assert verdict_of(*three, max_count=3) == (Verdict.PASS, Reason(0))
    assert verdict_of(*three, max_count=2) == (Verdict.FAIL, Reason.COUNT_LIMIT)
    assert verdict_of(*three, max_per_m2=300.0) == (Verdict.PASS, Reason(0))
    assert verdict_of(*three, max_per_m2=299.0) == (Verdict.FAIL, Reason.DENSITY_LIMIT)


@pytest.mark.parametrize("area_m2", [0.0, math.nan])
def test_a_density_on_an_unknown_area_is_not_a_pass(area_m2: float) -> None:
    limits = Limits(max_per_m2=1e9)
    assert judge([seed(1)], (), limits, area_m2)[0] is Verdict.FAIL
    assert judge([], (), limits, area_m2)[0] is Verdict.PASS


def test_a_zone_has_limits_of_its_own_and_the_stricter_holds() -> None:
    inside, outside = seed(400, x_mm=9.0), seed(400, x_mm=9.1)
    strict, loose = (zone(max_height_um=300.0),), (zone(max_height_um=900.0),)
    assert verdict_of(inside, zones=strict) == (Verdict.FAIL, Reason.ZONE_LIMIT)
    assert verdict_of(outside, zones=strict) == (Verdict.PASS, Reason(0))
    assert verdict_of(seed(600), zones=loose) == (Verdict.FAIL, Reason.HEIGHT_LIMIT)
    assert verdict_of(inside, zones=(zone(max_count=0),)) == (Verdict.FAIL, Reason.ZONE_LIMIT)


def test_an_ignored_zone_is_reported_but_not_judged() -> None:
    assert verdict_of(seed(9000), zones=(zone(ignore=True),), max_count=0) == (Verdict.PASS, Reason(0))


@pytest.mark.parametrize("flag", [Flag.MERGED, Flag.PARTNER_HIDDEN, Flag.PARTNER_OUTSIDE_FRAME])
def test_a_seed_without_a_height_fails_unless_told_to_report(flag: Flag) -> None:
    lone = (Unpaired(1, 2, flag | Flag.SATURATED),)
    assert verdict_of(unpaired=lone) == (Verdict.FAIL, Reason.UNMEASURED_SEED)
    assert verdict_of(unpaired=lone, unmeasured_seed="report") == (Verdict.PASS, Reason.UNMEASURED_SEED)


def test_spots_that_could_not_be_told_apart_are_never_a_pass_whatever_else_they_are() -> None:
    """Not even where each has a partner and a height: with other partners they would have other heights."""
    crowded = Flag.CROWDED | Flag.PAINT_POOL | Flag.TOO_LARGE
    assert verdict_of(replace(seed(10), flags=Flag.CROWDED)) == (Verdict.FAIL, Reason.UNMEASURED_SEED)
    assert verdict_of(unpaired=(Unpaired(1, 2, crowded),)) == (Verdict.FAIL, Reason.UNMEASURED_SEED)


def test_only_unexplained_highlights_count_against_their_limit() -> None:
    explained = tuple(Unpaired(1, 2, f) for f in (Flag.DUST, Flag.HOT_PIXEL, Flag.PAINT_POOL | Flag.MERGED))
    unexplained = (Unpaired(1, 2, Flag.AMBIGUOUS), Unpaired(1, 2))
    assert verdict_of(unpaired=explained, max_unpaired=0) == (Verdict.PASS, Reason(0))
    assert verdict_of(unpaired=unexplained, max_unpaired=2) == (Verdict.PASS, Reason(0))
    assert verdict_of(unpaired=unexplained, max_unpaired=1) == (Verdict.FAIL, Reason.UNPAIRED_LIMIT)


def test_the_sentence_names_the_limit_the_height_and_the_place() -> None:
    _, _, (text,) = judge([seed(732.4, 8, 12.34, 45.6), seed(600)], (), Limits(), AREA_M2)
    assert text == "2 seeds higher than 500 um on the panel, the highest 732 +/- 8 um at x 12.3, y 45.6 mm"


@pytest.mark.parametrize("nonsense", [math.nan, math.inf, -math.inf])
def test_a_height_or_sigma_that_is_no_number_is_not_a_pass(nonsense: float) -> None:
    nothing_applies = {"max_height_um": None, "min_height_um": 100.0, "unmeasured_seed": "report"}
    assert verdict_of(seed(nonsense), **nothing_applies) == (Verdict.FAIL, Reason.UNMEASURED_SEED)
    assert verdict_of(seed(1, nonsense), **nothing_applies) == (Verdict.FAIL, Reason.UNMEASURED_SEED)


NUMBER = st.floats(0, 2000)
SIGMA = st.none() | st.floats(0, 300)
PLACE = st.floats(-20, 20)
SEED = st.builds(seed, NUMBER, SIGMA, PLACE, PLACE)
BROKEN_SEED = st.builds(seed, st.sampled_from([math.nan, math.inf, -math.inf]), SIGMA, PLACE, PLACE) | st.builds(
    seed, NUMBER, st.sampled_from([math.nan, math.inf]), PLACE, PLACE
)
LONE = st.builds(Unpaired, PLACE, PLACE, st.sampled_from(Flag))
HEIGHT_LIMIT = st.none() | st.floats(1, 2000)
COUNT_LIMIT = st.none() | st.integers(0, 5)
JUDGED_ZONE = st.builds(zone, max_height_um=HEIGHT_LIMIT, max_count=COUNT_LIMIT)
LIMITS = st.builds(
    Limits,
    max_height_um=HEIGHT_LIMIT,
    min_height_um=st.floats(0, 500),
    guard_band_sigma=st.floats(0, 10),
    guard_band=st.sampled_from(["fail", "pass"]),
    max_count=COUNT_LIMIT,
    max_per_m2=st.none() | st.floats(1, 1000),
    max_unpaired=COUNT_LIMIT,
    unmeasured_seed=st.sampled_from(["fail", "report"]),
    zones=st.tuples(JUDGED_ZONE) | st.just(()) | st.tuples(JUDGED_ZONE, st.builds(zone, ignore=st.just(True))),
)
SEEDS, LONES = st.lists(SEED | BROKEN_SEED, max_size=6), st.lists(LONE, max_size=6)


@given(SEEDS, LONES, LIMITS, SEED | BROKEN_SEED)
def test_one_more_defect_never_turns_fail_into_pass(
    defects: list[Defect], unpaired: list[Unpaired], limits: Limits, more: Defect
) -> None:
    if judge(defects, unpaired, limits, AREA_M2)[0] is Verdict.FAIL:
        assert judge([*defects, more], unpaired, limits, AREA_M2)[0] is Verdict.FAIL


@given(SEEDS, LONES, LIMITS, st.data())
def test_a_higher_defect_never_turns_fail_into_pass(
    defects: list[Defect], unpaired: list[Unpaired], limits: Limits, data: st.DataObject
) -> None:
    if defects and judge(defects, unpaired, limits, AREA_M2)[0] is Verdict.FAIL:
        grown = [replace(d, height_um=d.height_um + data.draw(st.floats(0, 1000))) for d in defects]
        assert judge(grown, unpaired, limits, AREA_M2)[0] is Verdict.FAIL


RAISABLE = ["max_height_um", "min_height_um", "max_count", "max_per_m2", "max_unpaired"]


@given(SEEDS, LONES, LIMITS, st.sampled_from(RAISABLE), st.integers(1, 2000))
def test_a_raised_limit_never_turns_pass_into_fail(
    defects: list[Defect], unpaired: list[Unpaired], limits: Limits, name: str, by: int
) -> None:
    if judge(defects, unpaired, limits, AREA_M2)[0] is Verdict.PASS:
        now = getattr(limits, name)
        raised = limits.model_copy(update={name: None if now is None else now + by})
        assert judge(defects, unpaired, raised, AREA_M2)[0] is Verdict.PASS


@given(SEEDS, BROKEN_SEED, LONES, LIMITS)
def test_a_defect_without_a_finite_height_never_passes(
    defects: list[Defect], broken: Defect, unpaired: list[Unpaired], limits: Limits
) -> None:
    shown = limits.model_copy(update={"zones": tuple(z for z in limits.zones if not z.ignore)})
    assert judge([*defects, broken], unpaired, shown, AREA_M2)[0] is Verdict.FAIL
