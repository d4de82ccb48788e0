"""Rendered frames with exact truth, whole through the pipeline: found, measured, and honest about how well.

Radiance's ray tracer made them, through the thesis' calibrated camera: A single seeds (some over-exposed, with
blooming, or on a panel brighter than 60 DN), B crowds, C dust and hot pixels, D seeds sunk in the paint, F paint pools.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest

from inspector import calibration_file, imagefile
from inspector.model import Defect, Flag, FloatArray, Frame, FrameResult, Image, Verdict
from inspector.optics import Calibration, Camera
from inspector.pipeline import Station, inspect
from inspector.recipe import Recipe

ROOT = Path(__file__).parents[2]
TRUTH: dict[str, Any] = json.loads((ROOT / "tests" / "data" / "accuracy" / "truth.json").read_text())
MATCH_PX = 2.5
Method = Literal["exact", "thesis"]


@pytest.fixture(scope="module")
def base(frames_folder: Path) -> Calibration:
    return calibration_file.read(frames_folder / "calibration.yaml")


def station(name: str, base: Calibration, method: Method = "exact") -> Station:
    return Station(replace(base, sensor=replace(base.sensor, gamma=TRUTH[name]["gamma"])), Recipe(method=method))


def image_of(name: str) -> Image:
    return imagefile.read(ROOT / TRUTH[name]["image"])


@dataclass(frozen=True)
class Score:
    """One frame against its truth: matched (seed, defect), measurable seeds missed, defects that are no seed."""

    matched: list[tuple[dict[str, Any], Defect]]
    missed: int
    false: int


def score(name: str, result: FrameResult, match_px: float = MATCH_PX) -> Score:
    free, matched, missed = list(result.defects), [], 0
    for seed in TRUTH[name]["seeds"]:
        gaps = [
            max(np.hypot(*np.subtract(getattr(d, end), seed[end])) for end in ("direct_px", "mirror_px")) for d in free
        ]
        if gaps and min(gaps) <= match_px:
            matched.append((seed, free.pop(int(np.argmin(gaps)))))
        elif seed["measurable"]:
            missed += 1
    return Score(matched, missed, len(free))


@pytest.fixture(scope="module")
def scores(base: Calibration) -> Callable[..., dict[str, Score]]:
    """``scores(kinds, method="exact")``: every frame of these kinds against its truth."""
    kept: dict[tuple[str, Method], Score] = {}

    def of(kinds: str, method: Method = "exact") -> dict[str, Score]:
        names = [name for name in TRUTH if name[0] in kinds]
        for name in names:
            if (name, method) not in kept:
                match_px = MATCH_PX if method == "exact" else 2 * MATCH_PX
                result = inspect(Frame(image_of(name), name), station(name, base, method))
                kept[name, method] = score(name, result, match_px)
        return {name: kept[name, method] for name in names}

    return of


def errors_pct(found: dict[str, Score]) -> FloatArray:
    """Height errors of all measurable seeds that were found, percent."""
    rows = [(d.height_um, s["height_um"]) for f in found.values() for s, d in f.matched if s["measurable"]]
    height, truth = np.array(rows).T
    return np.asarray(100 * (height - truth) / truth)


def test_single_seeds(scores: Callable[..., dict[str, Score]]) -> None:
    found = scores("A")
    error = np.abs(errors_pct(found))
    assert sum(f.missed + f.false for f in found.values()) == 0
    assert len(error) == 7
    assert error.mean() <= 0.35
    assert np.median(error) <= 0.15


def test_crowds(scores: Callable[..., dict[str, Score]]) -> None:
    found = scores("B")
    error = np.abs(errors_pct(found))
    assert sum(f.missed for f in found.values()) <= 0.02 * (len(error) + 1)
    assert sum(f.false for f in found.values()) == 0
    assert error.mean() <= 0.5


def test_clean_and_dusty_panels_have_no_defect(scores: Callable[..., dict[str, Score]]) -> None:
    found = scores("C")
    assert len(found) == 2
    assert all(f.false == 0 for f in found.values())


def test_seeds_sunk_in_the_paint(scores: Callable[..., dict[str, Score]]) -> None:
    found = scores("D")
    assert sum(f.missed + f.false for f in found.values()) == 0
    assert np.abs(errors_pct(found)).mean() <= 1.0


def test_paint_pools(scores: Callable[..., dict[str, Score]]) -> None:
    found = scores("F")
    assert sum(f.missed + f.false for f in found.values()) == 0
    assert np.abs(errors_pct(found)).mean() <= 0.6


def test_sigma_is_honest(scores: Callable[..., dict[str, Score]]) -> None:
    matched = [pair for f in scores("AB").values() for pair in f.matched if pair[0]["measurable"]]
    sigma = np.array([d.height_sigma_um for _, d in matched if d.height_sigma_um is not None])
    error = np.array([d.height_um - s["height_um"] for s, d in matched])
    assert len(sigma) == len(error) > 30
    assert 0.7 < np.std(error / sigma) < 1.4


def test_places_on_the_panel(scores: Callable[..., dict[str, Score]]) -> None:
    for f in scores("ABF").values():
        for seed, defect in f.matched:
            assert np.hypot(defect.x_mm - seed["x_mm"], defect.y_mm - seed["y_mm"]) < 0.1


def test_the_exact_model_is_ten_times_better_than_the_thesis(scores: Callable[..., dict[str, Score]]) -> None:
    thesis, exact = (np.abs(errors_pct(scores("A", method))).mean() for method in ("thesis", "exact"))
    assert 2.5 < thesis < 6
    assert exact < thesis / 10


def test_every_highlight_is_reported_once(base: Calibration) -> None:
    for name in TRUTH:
        result = inspect(Frame(image_of(name), name), station(name, base))
        pairs = [place for d in result.defects for place in (d.direct_px, d.mirror_px)]
        places = pairs + [(u.x_px, u.y_px) for u in result.unpaired]
        assert len(set(places)) == len(places)
        assert result.highlights is not None
        assert len(places) == len(result.highlights)


# --- the same scene seen another way: turned and mirrored frames with the calibration of such a camera ----------------


def turned(camera: Camera) -> Camera:
    """The camera whose frame is the transpose of this one's: x and y change places, and with them its handedness."""
    swap = [1, 0, 2]
    return replace(
        camera,
        width_px=camera.height_px,
        height_px=camera.width_px,
        cx_px=camera.cy_px,
        cy_px=camera.cx_px,
        dx_mm=camera.dy_mm,
        dy_mm=camera.dx_mm,
        rotation=camera.rotation[swap],
        translation_mm=camera.translation_mm[swap],
    )


def mirrored(camera: Camera) -> Camera:
    """The camera whose frame is this one's with left and right exchanged."""
    flip = np.array([-1.0, 1.0, 1.0])
    return replace(
        camera,
        cx_px=camera.width_px - 1 - camera.cx_px,
        rotation=camera.rotation * flip[:, None],
        translation_mm=camera.translation_mm * flip,
    )


def shifted(camera: Camera) -> Camera:
    """The camera whose frame is this one's, shifted down by 3 rows and right by 5 columns."""
    return replace(camera, cx_px=camera.cx_px + 5, cy_px=camera.cy_px + 3)


VIEWS: dict[str, tuple[Callable[[Image], Image], Callable[[Camera], Camera]]] = {
    "transposed": (lambda image: image.T, turned),
    "mirrored": (lambda image: image[:, ::-1], mirrored),
    "a quarter turn": (lambda image: np.rot90(image, -1), lambda camera: mirrored(turned(camera))),
    "half a turn": (lambda image: image[::-1, ::-1], lambda camera: turned(mirrored(turned(mirrored(camera))))),
    "shifted": (lambda image: np.pad(image, ((3, 0), (5, 0)), "edge")[:-3, :-5], shifted),
}


@pytest.mark.parametrize("name", ["A000", "A005", "A026", "B002", "B003", "D004", "F002"])
@pytest.mark.parametrize("view", VIEWS)
def test_a_turned_mirrored_or_shifted_camera_measures_the_same(view: str, name: str, base: Calibration) -> None:
    """The same noise in another frame: heights and places agree within their own uncertainty."""
    turn, as_camera = VIEWS[view]
    first = station(name, base)
    second = replace(first, calibration=replace(first.calibration, camera=as_camera(first.calibration.camera)))
    before, after = (inspect(Frame(i, name), s) for i, s in ((image_of(name), first), (turn(image_of(name)), second)))
    assert len(before.defects) == len(after.defects) > 0
    for one, other in zip(sorted(before.defects, key=place), sorted(after.defects, key=place), strict=True):
        assert one.height_sigma_um is not None
        assert abs(one.height_um - other.height_um) < 2 * one.height_sigma_um
        assert place(other) == pytest.approx(place(one), abs=0.05)


def place(defect: Defect) -> tuple[float, float]:
    return defect.x_mm, defect.y_mm


def test_what_is_flagged_on_over_exposed_frames(base: Calibration) -> None:
    result = inspect(Frame(image_of("A005"), "A005"), station("A005", base))
    assert result.verdict is Verdict.FAIL
    assert result.defects[0].flags & Flag.SATURATED
