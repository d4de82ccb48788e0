"""Scenes by the dozen: stations of many shapes, and panels of every kind on them, from one random seed each.

Kinds: ``A`` one seed, ``B`` many near each other, ``C`` none but dust and hot pixels, ``D`` sunk in the paint, ``F``
with a paint pool.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from inspector.lab.scene import (
    THESIS_CAMERA,
    Dust,
    Lamp,
    Lens,
    Paint,
    Scene,
    Seed,
    Sensor,
    mirrored,
    sphere_glint_mm,
    unit,
)
from inspector.lab.trace import fresnel
from inspector.model import FloatArray
from inspector.optics import Camera

_KINDS = "ABCDF"


@dataclass(frozen=True)
class Station:
    """A camera and its lamp."""

    camera: Camera
    lamp: Lamp


def camera(
    view_deg: float,
    distance_mm: float,
    mm_per_px: float,
    f_mm: float = 12.0,
    roll_deg: float = 0.0,
    azimuth_deg: float = 0.0,
    kappa1_per_mm2: float = 0.0,
    size_px: tuple[int, int] = (640, 480),
    looks_at_mm: tuple[float, float] = (0.0, 0.0),
) -> Camera:
    """A camera that looks at a point of the panel, ``view_deg`` from its normal, standing at ``azimuth_deg`` from +x.

    ``mm_per_px``: a pixel's width across the optical axis at the panel; ``roll_deg`` 0 has the panel's far side up.
    """
    view, azimuth, roll = np.radians([view_deg, azimuth_deg, roll_deg])
    away = np.array([np.sin(view) * np.cos(azimuth), np.sin(view) * np.sin(azimuth), np.cos(view)])
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    down = np.cross(-away, right)
    rows = np.array([np.cos(roll) * right + np.sin(roll) * down, np.cos(roll) * down - np.sin(roll) * right, -away])
    centre = np.array([*looks_at_mm, 0.0]) + distance_mm * away
    pitch = mm_per_px * f_mm / distance_mm
    width, height = size_px
    return Camera(width, height, f_mm, kappa1_per_mm2, 1.0, width / 2, height / 2, pitch, pitch, rows, -rows @ centre)


def lamp(
    seen_by: Camera, angle_deg: float, swing_deg: float = 0.0, distance_mm: float | None = None, sigma_deg: float = 1.75
) -> Lamp:
    """A lamp ``angle_deg`` from the panel's normal, opposite the camera but for ``swing_deg``; far away by default."""
    middle = np.append(seen_by.back_project(np.array([[seen_by.cx_px, seen_by.cy_px]]))[0], 0.0)
    away = seen_by.centre_mm - middle
    angle, azimuth = np.radians(angle_deg), np.arctan2(away[1], away[0]) + np.pi + np.radians(swing_deg)
    direction = np.array([np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), np.cos(angle)])
    if distance_mm is None:
        return Lamp(direction, sigma_deg=sigma_deg)
    return Lamp.at(middle + distance_mm * direction, middle, sigma_deg)


def stations() -> dict[str, Station]:
    """Stations of many shapes, by name.

    In all of them the lamp stands some 25 degrees or more nearer to the panel's normal than the camera. Where the two
    come closer, the panel's own reflection of the lamp comes near, mirror spots smear along the seed's outline, and a
    third spot appears between the two: lamp to panel to seed.
    """
    near = camera(65, 267, 0.27, 8.0, roll_deg=-90, kappa1_per_mm2=0.0085)
    upright = camera(60, 400, 0.15, 16.0, kappa1_per_mm2=-0.0004)
    zoomed = camera(70, 300, 0.06, 25.0, roll_deg=37, azimuth_deg=205)
    large = camera(55, 350, 0.12, 12.0, 180.0, 90.0, 0.0006, (1280, 1024), (150.0, -40.0))
    steep = camera(47, 200, 0.2, 8.0, 75.0, -30.0, -0.002)
    flat = camera(75, 500, 0.2, 25.0, -90.0, 180.0)
    wide = camera(55, 160, 0.25, 8.0, -80.0, 0.0, -0.003)
    return {
        "thesis": Station(THESIS_CAMERA, lamp(THESIS_CAMERA, 30)),
        "near": Station(near, lamp(near, 30)),
        "upright": Station(upright, lamp(upright, 20, swing_deg=25)),
        "zoomed": Station(zoomed, lamp(zoomed, 40, swing_deg=-15, sigma_deg=1.2)),
        "large": Station(large, lamp(large, 22, swing_deg=-30, sigma_deg=2.5)),
        "steep": Station(steep, lamp(steep, 15, swing_deg=10)),
        "flat": Station(flat, lamp(flat, 15, swing_deg=30)),
        "wide": Station(wide, lamp(wide, 20)),
        "lamp_near": Station(upright, lamp(upright, 30, swing_deg=-10, distance_mm=250)),
        "lamp_far": Station(near, lamp(near, 30, swing_deg=20, distance_mm=700)),
    }


def random_scenes(kind: str, count: int, seed: int, station: Station) -> Iterator[Scene]:
    """``count`` scenes of a kind on a station. The n-th depends on kind, seed and station, not on ``count``.

    Raises ValueError for a kind that is none of those above.
    """
    if kind not in _KINDS:
        raise ValueError(f"no kind of scene is called {kind!r}; use one of {', '.join(_KINDS)}")
    for number in range(count):
        yield _scene(kind, number, np.random.default_rng([seed, _KINDS.index(kind), number]), station)


def _scene(kind: str, number: int, random: np.random.Generator, station: Station) -> Scene:
    sensor = Sensor(
        gamma=1.0 if random.random() < 0.5 else float(random.uniform(0.75, 1.0)),
        full_well_e=float(random.uniform(12e3, 20e3)),
        read_noise_e=float(random.uniform(40, 120)),
        offset_dn=float(random.uniform(2, 9)),
        seed=int(random.integers(2**31)),
    )
    lens = Lens(8.0, *random.uniform((0.6, 0.01, 3.0), (0.8, 0.03, 4.5)).tolist())
    scene = Scene(station.camera, station.lamp, sensor=sensor, lens=lens)
    over = number % 7 == 5 and kind != "C"
    # The base's albedo follows from how bright the bare panel is to be once the exposure is known.
    panel_dn = float(random.uniform(40, 90) if random.random() < 0.12 else random.uniform(0.3, 12))
    if kind == "C":
        return _clean(replace(scene, dust=_dust(random, station)), random, panel_dn)
    scene = replace(scene, seeds=_seeds(kind, random, station))
    if over:
        scene = replace(scene, sensor=replace(scene.sensor, bloom=float(random.uniform(0.5, 0.9))))
    elif kind == "B" and number % 4 == 3:
        scene = replace(scene, sensor=replace(scene.sensor, hot=_hot(random, station.camera, 3)))
    level = float(random.uniform(1.8, 8.0) if over else random.uniform(0.45, 0.95))
    return _exposed(scene, level, panel_dn)


def _exposed(scene: Scene, level: float, panel_dn: float) -> Scene:
    """The scene with its brightest mirror spot at ``level`` of the way to clipping, its bare panel at ``panel_dn``."""
    brightest = max((_mirror_peak(seed, scene) for seed in scene.seeds), default=1e-5)
    exposure = level ** (1 / scene.sensor.gamma) * scene.sensor.e_saturation / brightest
    return _with_panel(scene.exposed(exposure), panel_dn)


def _mirror_peak(seed: Seed, scene: Scene) -> float:
    """About the irradiance in the middle of a mirror spot at an exposure of 1.

    A sphere sends a distant lamp's light evenly all around, R^2 / 4 of its irradiance to the steradian; the paint
    and the coat each take Fresnel's share, and the lens spreads what is left.
    """
    eye = mirrored(scene.camera.centre_mm)
    glint = sphere_glint_mm(seed, scene.lamp, eye)
    to_eye, to_lamp = unit(eye - glint), scene.lamp.toward(glint[None])[0]
    cosines = np.array([-to_eye[2], np.sqrt((1 + to_eye @ to_lamp) / 2)])
    radius_px = seed.radius_mm / mm_per_px(scene.camera, glint)
    sigma_rad = np.radians(scene.lamp.sigma_deg)
    light = np.prod(fresnel(cosines, scene.paint)) * radius_px**2 / 4 * 2 * np.pi * sigma_rad**2 * scene.lamp.radiance
    spread = scene.lens.psf_sigma_px**2 + 1 / 12 + (radius_px * sigma_rad / 2) ** 2
    return float(light / (2 * np.pi * spread) * np.pi / 4 / scene.lens.f_number**2)


def _clean(scene: Scene, random: np.random.Generator, panel_dn: float) -> Scene:
    """A panel without seeds, at an exposure that would suit seeds of a few pixels."""
    hot = _hot(random, scene.camera, int(random.integers(0, 4)))
    scene = replace(scene, sensor=replace(scene.sensor, hot=hot))
    return _with_panel(scene.exposed(float(np.exp(random.uniform(np.log(0.004), np.log(0.06))))), panel_dn)


def _with_panel(scene: Scene, panel_dn: float) -> Scene:
    sensor, lens = scene.sensor, scene.lens
    relative = (panel_dn / (255 - sensor.offset_dn)) ** (1 / sensor.gamma)
    radiance = relative * sensor.e_saturation / (np.pi / 4 / lens.f_number**2 * sensor.exposure)
    middle = _panel_point(scene.camera, np.array([scene.camera.cx_px, scene.camera.cy_px]))
    lit = scene.lamp.irradiance(middle[None])[0] * scene.lamp.toward(middle[None])[0, 2]
    return replace(scene, paint=Paint(diffuse=float(np.pi * radiance / lit)))


def _seeds(kind: str, random: np.random.Generator, station: Station) -> tuple[Seed, ...]:
    fewest, most = {"A": (1, 1), "B": (2, 12), "D": (1, 3), "F": (1, 2)}[kind]
    wanted = int(random.integers(fewest, most, endpoint=True))
    seeds: list[Seed] = []
    middle = random.uniform(0.2, 0.8, 2) * [station.camera.width_px, station.camera.height_px]
    crowd = 0.08 if kind == "B" and random.random() < 0.7 else 1.0
    for _ in range(1000):
        if len(seeds) == wanted:
            break
        anywhere = random.uniform(0.06, 0.94, 2) * [station.camera.width_px, station.camera.height_px]
        seed = _seed(kind, random, station, middle + crowd * (anywhere - middle))
        if _stands_free(seed, seeds) and _both_spots_in_frame(seed, station):
            seeds.append(seed)
    return tuple(seeds)


def _seed(kind: str, random: np.random.Generator, station: Station, at_px: FloatArray) -> Seed:
    x, y, _ = at = _panel_point(station.camera, at_px)
    pixel_mm = mm_per_px(station.camera, at)
    lowest, highest = {"A": (3.6, 27.0), "B": (3.6, 11.0), "D": (3.6, 14.0), "F": (5.0, 14.0)}[kind]
    height = pixel_mm * float(np.exp(random.uniform(np.log(lowest), np.log(highest))))
    sunk = float(random.uniform(0.3, 0.98)) if kind == "D" or (kind == "B" and random.random() < 0.15) else 1.0
    radius = height / (1 + sunk)
    fillet = radius * float(random.uniform(1.2, 1.7)) if kind == "F" else None
    return Seed(float(x), float(y), radius, sunk * radius, fillet)


def _stands_free(seed: Seed, others: list[Seed]) -> bool:
    def reach(one: Seed) -> float:
        return max(one.radius_mm, one.pool_radius_mm)

    return all(np.hypot(seed.x_mm - o.x_mm, seed.y_mm - o.y_mm) > 1.05 * (reach(seed) + reach(o)) for o in others)


def _both_spots_in_frame(seed: Seed, station: Station) -> bool:
    eye = station.camera.centre_mm
    direct = sphere_glint_mm(seed, station.lamp, eye)
    mirror = mirrored(sphere_glint_mm(seed, station.lamp, mirrored(eye)))
    seen = station.camera.project(np.array([direct, mirror]))
    size = np.array([station.camera.width_px, station.camera.height_px])
    return bool(np.all((seen > 8) & (seen < size - 9)))


def mm_per_px(seen_by: Camera, at_mm: FloatArray) -> float:
    """A pixel's width across the line of sight at a point (3,)."""
    return float(np.linalg.norm(seen_by.centre_mm - at_mm)) * seen_by.dx_mm / seen_by.f_mm


def _panel_point(seen_by: Camera, xy_px: FloatArray) -> FloatArray:
    return np.append(seen_by.back_project(xy_px[None])[0], 0.0)


def _dust(random: np.random.Generator, station: Station) -> tuple[Dust, ...]:
    if random.random() < 0.3:
        return ()
    at_px = random.uniform(0.1, 0.9, 2) * [station.camera.width_px, station.camera.height_px]
    x, y, _ = at = _panel_point(station.camera, at_px)
    pixel_mm = mm_per_px(station.camera, at)
    radius = pixel_mm * float(random.uniform(0.4, 0.9))
    return (Dust("ball" if random.random() < 0.3 else "flake", float(x), float(y), radius),)


def _hot(random: np.random.Generator, seen_by: Camera, count: int) -> tuple[tuple[int, int, float], ...]:
    size = seen_by.width_px, seen_by.height_px
    places = [random.integers(size) for _ in range(count)]
    return tuple((int(x), int(y), float(random.uniform(60, 240))) for x, y in places)
