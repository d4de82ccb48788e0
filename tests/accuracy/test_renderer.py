"""The laboratory's renderer against another one: frames that Radiance rendered, and the truth that came with them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from inspector.lab import records, sets, truth
from inspector.lab.imaging import expose, noise_free_dn
from inspector.lab.light import gather
from inspector.lab.render import irradiance, render
from inspector.lab.scene import THESIS_CAMERA, Lamp, Paint, Scene, Seed, mirrored, sphere_glint_mm
from inspector.lab.trace import Tracer, fresnel
from inspector.model import FloatArray

pytestmark = pytest.mark.xdist_group("renderer")
"""A scene takes a second to render: one worker does it once."""
DATA = Path(__file__).parents[1] / "data"
REFERENCE = json.loads((DATA / "lab" / "reference_scenes.json").read_text())
SMALL = Seed(75.0, 50.0, 0.9, 0.9)


@pytest.fixture(scope="module")
def small_seeds_light() -> FloatArray:
    return irradiance(on_thesis_station(SMALL))


def on_thesis_station(*seeds: Seed, **others: Any) -> Scene:
    return Scene(THESIS_CAMERA, sets.lamp(THESIS_CAMERA, 30), seeds, **others)


def patch(image: FloatArray, at_px: list[float], reach: int = 4) -> FloatArray:
    x, y = np.rint(at_px).astype(int)
    return image[y - reach : y + reach + 1, x - reach : x + reach + 1].astype(float)


def centroid(light: FloatArray, at_px: list[float]) -> FloatArray:
    """Of a patch above its own rim, relative to ``at_px``."""
    part = patch(light, at_px)
    part = np.clip(part - np.median(np.concatenate([part[0], part[-1], part[:, 0], part[:, -1]])), 0, None)
    y, x = np.mgrid[-4:5, -4:5]
    return np.array([(part * x).sum(), (part * y).sum()]) / part.sum() + np.rint(at_px) - at_px


@pytest.fixture(scope="module", params=list(REFERENCE))
def reference(request: pytest.FixtureRequest) -> tuple[str, FloatArray, list[Any], list[dict[str, Any]]]:
    """Name, frame without noise, its spots by our truth, and as the other renderer's truth has them."""
    scene = records.read(REFERENCE[request.param]["scene"])
    drawn_dn = noise_free_dn(irradiance(scene), scene.sensor)
    return request.param, drawn_dn, truth.of(scene, drawn_dn)["defects"], REFERENCE[request.param]["spots"]


def test_spots_lie_where_the_other_renderers_truth_has_them(reference: Any) -> None:
    _, _, found, spots = reference
    for ours, theirs in zip(found, spots, strict=True):
        assert ours["direct_px"] == pytest.approx(theirs["direct_px"], abs=1e-6)
        assert ours["mirror_px"] == pytest.approx(theirs["mirror_px"], abs=1e-6)
        assert ours["direct_visible"]
        assert ours["mirror_visible"]
        if "pool_px" in theirs:
            assert ours["pool"]["px"] == pytest.approx(theirs["pool_px"], abs=1e-6)


def test_spots_are_as_bright_as_the_other_renderers(reference: Any) -> None:
    """To the tenth that its rule of thumb for Fresnel's formula is off by, and more where a pool's spot adds to one."""
    name, _, found, spots = reference
    for ours, theirs in zip(found, spots, strict=True):
        for peak in ("direct_peak_dn_unclipped", "mirror_peak_dn_unclipped"):
            assert ours[peak] == pytest.approx(theirs[peak], rel=0.15 if name == "paint_pool" else 0.1)


def test_mirror_spots_look_as_the_other_renderer_shows_them(reference: Any) -> None:
    """Scaled to its brightness, what remains of the difference is the frame's own noise."""
    name, drawn_dn, _, spots = reference
    frame = cv2.imread(str(DATA / "frames" / f"{name}.png"), cv2.IMREAD_GRAYSCALE)
    for spot in spots:
        if spot["mirror_peak_dn_unclipped"] > 250:
            continue
        seen = patch(frame, spot["mirror_px"], 2).ravel()
        drawn = patch(drawn_dn, spot["mirror_px"], 2).ravel()
        fit = np.column_stack([drawn, np.ones(len(drawn))])
        left = seen - fit @ np.linalg.lstsq(fit, seen, rcond=None)[0]
        assert np.sqrt(np.mean(left**2)) < 0.03 * seen.max()


@pytest.mark.parametrize("name", ["upright", "zoomed", "steep", "lamp_near"])
def test_light_gathers_where_the_truth_says_on_other_stations(name: str) -> None:
    station = sets.stations()[name]
    x, y = station.camera.back_project(np.array([[300.2, 220.7]]))[0]
    radius = 6 * sets.mm_per_px(station.camera, np.array([x, y, 0.0]))
    scene = Scene(station.camera, station.lamp, (Seed(float(x), float(y), radius, radius),), paint=Paint(diffuse=0.0))
    light = irradiance(scene)
    (found,) = truth.of(scene, light)["defects"]
    assert found["separation_px"] > 6
    for spot in ("direct_px", "mirror_px"):
        assert np.hypot(*centroid(light, found[spot])) < 0.03


def test_a_spot_holds_the_light_that_a_sphere_sends_that_way() -> None:
    """R^2 / 4 of the lamp's irradiance to the steradian, times Fresnel's share: the formula for a convex mirror."""
    scene = on_thesis_station(SMALL, paint=Paint(diffuse=0.0))
    light = gather(scene)
    point = sphere_glint_mm(SMALL, scene.lamp, THESIS_CAMERA.centre_mm)
    away = THESIS_CAMERA.centre_mm - point
    distance = np.linalg.norm(away)
    at = THESIS_CAMERA.project(point[None])
    near = np.hypot(*(light.spots_px - at).T) < 1
    half = np.sqrt((1 + scene.lamp.direction @ away / distance) / 2)
    cut = 1 - np.exp(-0.5 * (scene.lamp.cutoff_deg / scene.lamp.sigma_deg) ** 2)
    irradiance_there = cut * scene.lamp.irradiance(point[None])[0]
    towards = THESIS_CAMERA.rotation[2] @ (-away / distance)
    # A pixel's solid angle is its area over f^2, cos^3 of the angle off axis; what is left of cos^4 is one cosine.
    pixel_sr = THESIS_CAMERA.dx_mm**2 / THESIS_CAMERA.f_mm**2 * towards**3
    expected = fresnel(np.array([half]), scene.paint)[0] * irradiance_there * SMALL.radius_mm**2 / 4 / distance**2
    assert light.spots[near].sum() == pytest.approx(expected / pixel_sr * towards**4, rel=0.01)


def test_the_same_scene_gives_the_same_frame() -> None:
    scene = on_thesis_station(SMALL)
    (one, of_one), (other, of_other) = render(scene), render(scene)
    assert np.array_equal(one, other)
    assert of_one == of_other
    assert not np.array_equal(one, render(replace(scene, sensor=replace(scene.sensor, seed=1)))[0])


def test_a_scene_survives_its_record() -> None:
    for name in ("thesis", "lamp_near"):
        (scene,) = sets.random_scenes("F", 1, 3, sets.stations()[name])
        record = records.write(scene)
        assert records.write(records.read(json.loads(json.dumps(record)))) == record


def test_brightness_falls_with_exposure(small_seeds_light: FloatArray) -> None:
    peaks = [expose(small_seeds_light, on_thesis_station(SMALL).exposed(e).sensor).max() for e in (0.02, 0.005, 0.001)]
    assert peaks[0] > peaks[1] > peaks[2]


def test_a_seed_in_front_hides_the_mirror_spot_behind_it() -> None:
    behind = Seed(75.0, 50.0, 0.6, 0.6)
    scene = on_thesis_station(behind)
    eye = THESIS_CAMERA.centre_mm
    mirror = sphere_glint_mm(behind, scene.lamp, mirrored(eye))
    assert not Tracer(scene).blocked(mirror, mirror + [3.0, 0.0, 0.1])
    front = Seed(77.2, 50.0, 1.2, 1.2)
    hidden, shown = truth.of(on_thesis_station(behind, front), np.zeros((480, 640)))["defects"]
    assert (hidden["mirror_visible"], hidden["mirror_peak_dn_unclipped"]) == (False, None)
    assert shown["direct_visible"]
    assert shown["mirror_visible"]


@pytest.mark.parametrize("bits", [10, 12, 16])
def test_deeper_sensors_hold_the_same_picture(bits: int, small_seeds_light: FloatArray) -> None:
    scene = on_thesis_station(SMALL)
    eight = expose(small_seeds_light, scene.sensor)
    deep = expose(small_seeds_light, replace(scene.sensor, bits=bits))
    assert deep.dtype == np.uint16
    assert deep.max() <= 2**bits - 1
    assert np.abs(deep / (2**bits - 1) * 255 - eight).max() < 1


def test_hot_pixels_and_bloom_mark_the_frame(small_seeds_light: FloatArray) -> None:
    scene = on_thesis_station(SMALL).exposed(0.5)
    plain = expose(small_seeds_light, scene.sensor).astype(int)
    marked = expose(small_seeds_light, replace(scene.sensor, hot=((5, 7, 120.0),), bloom=0.8)).astype(int)
    assert marked[7, 5] - plain[7, 5] == pytest.approx(120, abs=1)
    assert (marked == 255).sum() > (plain == 255).sum()


def test_every_kind_of_scene_can_be_had_and_no_other() -> None:
    station = sets.stations()["thesis"]
    kinds = {kind: next(sets.random_scenes(kind, 1, 1, station)) for kind in "ABCDF"}
    assert [len(kinds[k].seeds) for k in "AC"] == [1, 0]
    assert len(kinds["B"].seeds) >= 2
    assert {s.kind for s in kinds["D"].seeds} == {"submerged_seed"}
    assert {s.kind for s in kinds["F"].seeds} == {"seed_with_pool"}
    with pytest.raises(ValueError, match="use one of A, B, C, D, F"):
        next(sets.random_scenes("Z", 1, 1, station))


def test_a_near_lamp_far_away_is_a_distant_one(small_seeds_light: FloatArray) -> None:
    distant = sets.lamp(THESIS_CAMERA, 30)
    near = Lamp.at(1e7 * distant.direction, np.zeros(3))
    from_near = irradiance(Scene(THESIS_CAMERA, near, (SMALL,)))
    assert np.abs(from_near - small_seeds_light).max() < 1e-3 * from_near.max()
