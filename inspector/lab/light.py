"""The light that a scene sends into the camera: every spot found and resolved, however small against a pixel.

Pixels that could see a seed, its mirror image or its shadow are divided into quarters, again and again, where the rays
of a cell may reach the lamp, until the direction in which they leave changes little within a cell. A cell's middle ray
then stands for the cell, and the lamp's Gaussian is summed over cells fine enough for the sum to be exact.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from inspector.lab.scene import Scene
from inspector.lab.trace import BoolArray, Traced, Tracer
from inspector.model import FloatArray, IntArray
from inspector.optics import Camera

_FINEST_LEVEL = 12
"""A cell is never smaller than 2 ** -12 px."""
_FINEST_EDGE_LEVEL = 8
"""Nor than 2 ** -8 px where a cell's rays take different ways, at the edge of something."""
_FINEST_FIRST_LEVEL = 4
"""And the first cells than 2 ** -4 px."""
_LEAST_SHARE = 1e-3
"""A cell that can add no more than this share of a spot's light is not divided further."""
_WIDEST_CELL = 0.8
"""From a cell's middle to its corners, in sigmas of the lamp: the sum over a Gaussian is then good to 1e-6."""
_CORNERS = np.array([(0.0, 0.0), (-0.5, -0.5), (0.5, -0.5), (-0.5, 0.5), (0.5, 0.5)])
_QUARTERS = np.array([(-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)])


@dataclass(frozen=True)
class Light:
    """Radiance by pixel area, so that a pixel full of radiance L holds L.

    ``matt`` (height, width): of the paint and the dust; ``spots_px`` (n, 2) and ``spots`` (n,): points of mirrored
    lamp light, each at its own place within its pixel.
    """

    matt: FloatArray
    spots_px: FloatArray
    spots: FloatArray


@dataclass(frozen=True)
class _Cells:
    middle_px: FloatArray
    size_px: FloatArray

    def where(self, chosen: BoolArray) -> _Cells:
        return _Cells(self.middle_px[chosen], self.size_px[chosen])

    def quartered(self) -> _Cells:
        middles = self.middle_px[:, None] + self.size_px[:, None, None] * _QUARTERS
        return _Cells(middles.reshape(-1, 2), np.repeat(self.size_px / 2, 4))


def gather(scene: Scene) -> Light:
    """The light of a scene, before lens and sensor."""
    tracer = Tracer(scene)
    matt = _bare_panel(scene)
    cells = _first_cells(scene)
    _clear(matt, cells)
    points, values = [np.zeros((0, 2))], [np.zeros(0)]
    while len(cells.size_px):
        split, done = _divide(tracer, scene, cells)
        traced = tracer.from_pixels(done.middle_px)
        _add(matt, done, traced.matt)
        lamp = _lamp_light(scene, traced)
        points.append(done.middle_px[lamp > 0])
        values.append((lamp * done.size_px**2)[lamp > 0])
        cells = split
    spots_px, spots = np.concatenate(points), np.concatenate(values)
    return Light(matt * vignetting(scene.camera), spots_px, spots * _cos4(scene.camera, spots_px))


def vignetting(camera: Camera) -> FloatArray:
    """cos^4 of each pixel's angle from the optical axis, (height, width)."""
    y, x = np.mgrid[: camera.height_px, : camera.width_px]
    return _cos4(camera, np.column_stack([x.ravel(), y.ravel()]).astype(float)).reshape(x.shape)


def _cos4(camera: Camera, xy_px: FloatArray) -> FloatArray:
    radius = np.linalg.norm(camera.undistort(camera.sensor(xy_px)), axis=1)
    return np.asarray(np.cos(np.arctan(radius / camera.f_mm)) ** 4)


def _bare_panel(scene: Scene) -> FloatArray:
    """Matt radiance (height, width) of a panel with nothing on it; none where a pixel looks past the panel."""
    y, x = np.mgrid[: scene.camera.height_px, : scene.camera.width_px]
    ground = scene.camera.back_project(np.column_stack([x.ravel(), y.ravel()]).astype(float))
    at = np.column_stack([np.nan_to_num(ground), np.zeros(len(ground))])
    slant = np.maximum(scene.lamp.toward(at)[:, 2], 0.0)
    radiance = scene.paint.diffuse / np.pi * scene.lamp.irradiance(at) * slant
    return np.where(np.isfinite(ground[:, 0]), radiance, 0.0).reshape(x.shape)


def _first_cells(scene: Scene) -> _Cells:
    """Whole pixels around all that lies on the panel, divided so that a cell is small against what it may see."""
    level = np.full((scene.camera.height_px, scene.camera.width_px), -1)
    for x, y, radius, reach, height in _bodies(scene):
        left, top, right, bottom, body_px = _seen_box(scene, np.array([x, y, 0.0]), reach, height, radius)
        wanted = int(np.clip(np.ceil(np.log2(4 / max(body_px, 1e-3))), 0, _FINEST_FIRST_LEVEL))
        part = level[top:bottom, left:right]
        np.maximum(part, wanted, out=part)
    rows, columns = np.nonzero(level >= 0)
    cells = _Cells(np.column_stack([columns, rows]).astype(float), np.ones(len(rows)))
    at_level = level[rows, columns]
    while np.any(at_level > 0):
        coarse = at_level > 0
        fine = cells.where(coarse).quartered()
        kept = cells.where(~coarse)
        cells = _Cells(np.vstack([kept.middle_px, fine.middle_px]), np.concatenate([kept.size_px, fine.size_px]))
        at_level = np.concatenate([at_level[~coarse], np.repeat(at_level[coarse] - 1, 4)])
    return cells


def _bodies(scene: Scene) -> list[tuple[float, float, float, float, float]]:
    """x, y, radius, reach to the side and height, mm, of all that lies on the panel."""
    seeds = [(s.x_mm, s.y_mm, s.radius_mm, max(s.radius_mm, s.pool_radius_mm), s.height_mm) for s in scene.seeds]
    # Dust has no glint to be found, only an outline: cells a quarter as fine do.
    return seeds + [(d.x_mm, d.y_mm, 4 * d.radius_mm, d.radius_mm, 2 * d.radius_mm) for d in scene.dust]


def _seen_box(
    scene: Scene, foot_mm: FloatArray, reach_mm: float, height_mm: float, radius_mm: float
) -> tuple[int, int, int, int, float]:
    """Pixels that may see a body, its mirror image or its shadow: left, top, right, bottom; and its radius in px."""
    away = scene.lamp.toward(foot_mm[None])[0]
    shadow = -height_mm * away / away[2] * [1.0, 1.0, 0.0]
    sides = np.array(
        [(i * reach_mm, j * reach_mm, k * height_mm) for i in (-1, 1) for j in (-1, 1) for k in (-1, 0, 1)]
    )
    seen = scene.camera.project(np.vstack([foot_mm + sides, foot_mm + shadow + sides[1::3]]))
    if not np.all(np.isfinite(seen)):
        seen = np.array([(0.0, 0.0), (scene.camera.width_px, scene.camera.height_px)])
    low = np.maximum(np.floor(seen.min(axis=0)) - 2, 0).astype(int)
    high = np.ceil(seen.max(axis=0)).astype(int) + 3
    around = scene.camera.project(foot_mm + radius_mm * np.array([(1.0, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0)]))
    smallest = float(min(np.linalg.norm(around[0] - around[1]), np.linalg.norm(around[2] - around[3]))) / 2
    return int(low[0]), int(low[1]), int(high[0]), int(high[1]), smallest if np.isfinite(smallest) else 1.0


def _divide(tracer: Tracer, scene: Scene, cells: _Cells) -> tuple[_Cells, _Cells]:
    """Cells to look at more closely, already in quarters, and cells that are fine enough."""
    lamp_rad, sigma_rad = np.radians(scene.lamp.cutoff_deg), np.radians(scene.lamp.sigma_deg)
    at = (cells.middle_px[:, None] + cells.size_px[:, None, None] * _CORNERS).reshape(-1, 2)
    rays = tracer.from_pixels(at, matt=False)
    off = np.where(rays.escaped, scene.lamp.off_axis_rad(rays.origin_mm, rays.direction), np.pi).reshape(-1, 5)
    path = rays.path.reshape(-1, 5)
    direction = rays.direction.reshape(-1, 5, 3)
    spread = np.linalg.norm(direction[:, 1:] - direction[:, :1], axis=-1).max(axis=1)
    edge = np.any(path != path[:, :1], axis=1)
    near = np.where(edge, off.min(axis=1) < lamp_rad + 0.25, off[:, 0] < lamp_rad + 1.5 * spread)
    finest = np.where(edge, _FINEST_EDGE_LEVEL, _FINEST_LEVEL)
    # At the edge of nothing bright two more rounds are enough: one pixel's share of a dim surface.
    coarse = np.where(edge, True, spread > _WIDEST_CELL * sigma_rad) & (cells.size_px > 2.0**-finest)
    most = rays.mirrored.reshape(-1, 5).max(axis=1) * cells.size_px**2
    split = coarse & ((near & (most > _LEAST_SHARE * _faintest_glint(scene))) | (edge & (cells.size_px > 0.25)))
    return cells.where(split).quartered(), cells.where(~split)


def _faintest_glint(scene: Scene) -> float:
    """The light of the smallest seed's direct spot, R^2 / 4 over the lamp's solid angle, in px^2 of its radiance."""
    sizes_px = [_seen_box(scene, np.array([x, y, 0.0]), r, h, r)[4] for x, y, r, _, h in _bodies(scene)]
    glint = scene.paint.spec * 2 * np.pi * np.radians(scene.lamp.sigma_deg) ** 2 / 4
    return float(min(sizes_px, default=1.0) ** 2 * glint)


def _lamp_light(scene: Scene, rays: Traced) -> FloatArray:
    """Radiance (n,) of the lamp in rays that left the scene."""
    off = scene.lamp.off_axis_rad(rays.origin_mm, rays.direction)
    return np.where(rays.escaped, rays.mirrored * scene.lamp.seen(off), 0.0)


def _pixel_of(scene_shape: tuple[int, ...], cells: _Cells) -> tuple[IntArray, IntArray]:
    x, y = np.rint(cells.middle_px).astype(int).T
    return np.clip(y, 0, scene_shape[0] - 1), np.clip(x, 0, scene_shape[1] - 1)


def _clear(matt: FloatArray, cells: _Cells) -> None:
    matt[_pixel_of(matt.shape, cells)] = 0.0


def _add(matt: FloatArray, cells: _Cells, radiance: FloatArray) -> None:
    np.add.at(matt, _pixel_of(matt.shape, cells), radiance * cells.size_px**2)
