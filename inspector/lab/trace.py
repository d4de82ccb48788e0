"""Rays among spheres, paint pools and the panel: what they hit, how they are mirrored, where they leave.

Every surface is a smooth coat over a dark matt base: it mirrors by Fresnel's formula and scatters a little. A ray is
followed through at most :data:`MOST_BOUNCES` mirrors; matt light comes from the lamp alone, where nothing shades it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from inspector.lab.scene import Paint, Scene, Seed, unit
from inspector.model import FloatArray, IntArray

BoolArray = npt.NDArray[np.bool_]

MOST_BOUNCES = 5
PANEL = 1
"""The panel's number in a path; dust flakes have 2, spheres and pools the numbers from 3."""
FLAKE = 2
FIRST_BODY = 3
WHITE = 0.85
_CLEAR_MM = 1e-7
"""A hit nearer than this is the surface the ray has just left."""


@dataclass(frozen=True)
class Traced:
    """What became of n rays.

    ``path`` (n,): the surfaces met, in order, as one number; ``escaped`` (n,): left the scene after one mirror at
    least; ``origin_mm`` and ``direction`` (n, 3): of the last leg; ``mirrored`` (n,): the share of light that the
    mirrors pass on; ``matt`` (n,): radiance scattered into the ray on its way.
    """

    path: IntArray
    escaped: BoolArray
    origin_mm: FloatArray
    direction: FloatArray
    mirrored: FloatArray
    matt: FloatArray


@dataclass(frozen=True)
class _Hits:
    distance_mm: FloatArray
    surface: IntArray
    normal: FloatArray


class Tracer:
    """One scene, made ready for rays."""

    def __init__(self, scene: Scene) -> None:
        self.lamp, self.paint, self.camera = scene.lamp, scene.paint, scene.camera
        balls = [d for d in scene.dust if d.kind == "ball"]
        self._flakes = [d for d in scene.dust if d.kind == "flake"]
        self._centres = np.array([s.centre_mm for s in scene.seeds] + [(b.x_mm, b.y_mm, b.radius_mm) for b in balls])
        self._centres = self._centres.reshape(-1, 3)
        self._radii = np.array([s.radius_mm for s in scene.seeds] + [b.radius_mm for b in balls])
        self._first_white = FIRST_BODY + len(scene.seeds)
        self._first_pool = FIRST_BODY + len(self._radii)
        self._pools = [s for s in scene.seeds if s.fillet_mm is not None]
        self._base = self._first_pool + len(self._pools) + 1

    def from_pixels(self, xy_px: FloatArray, matt: bool = True) -> Traced:
        """Follow the rays that reach the camera at pixels (n, 2); ``matt`` False leaves scattered light out."""
        parts = [self._follow_pixels(part, matt) for part in _parts(xy_px)]
        return Traced(*(np.concatenate([getattr(p, f) for p in parts]) for f in Traced.__dataclass_fields__))

    def blocked(self, from_mm: FloatArray, to_mm: FloatArray, clear_mm: float = 1e-6) -> bool:
        """Whether anything stands between two points (3,) of the scene, which may lie on surfaces."""
        way = to_mm - from_mm
        length = float(np.linalg.norm(way))
        hit = self._nearest(from_mm[None] + clear_mm * way[None] / length, way[None] / length)
        return bool(hit.distance_mm[0] < length - 2 * clear_mm)

    def _follow_pixels(self, xy_px: FloatArray, matt: bool) -> Traced:
        direction = unit(self.camera.rays(xy_px))
        origin = np.broadcast_to(self.camera.centre_mm, direction.shape)
        return self._follow(np.array(origin), direction, matt)

    def _follow(self, origin: FloatArray, direction: FloatArray, matt: bool) -> Traced:
        n = len(origin)
        path, escaped = np.zeros(n, np.intp), np.zeros(n, bool)
        share, scattered = np.ones(n), np.zeros(n)
        live = np.arange(n)
        for _ in range(MOST_BOUNCES + 1):
            hits = self._nearest(origin[live], direction[live])
            out = ~np.isfinite(hits.distance_mm)
            escaped[live[out]] = path[live[out]] > 0
            live, hits = live[~out], _Hits(*(getattr(hits, f)[~out] for f in _Hits.__dataclass_fields__))
            if not len(live):
                break
            origin[live] += hits.distance_mm[:, None] * direction[live]
            path[live] = path[live] * self._base + hits.surface
            if matt:
                scattered[live] += share[live] * self._scattered(origin[live], hits)
            facing = -np.sum(direction[live] * hits.normal, axis=1)
            direction[live] += 2 * facing[:, None] * hits.normal
            share[live] *= np.where(self._white(hits.surface), 0.0, fresnel(facing, self.paint))
        return Traced(path, escaped, origin, direction, share, scattered)

    def _white(self, surface: IntArray) -> BoolArray:
        return np.asarray((surface == FLAKE) | ((surface >= self._first_white) & (surface < self._first_pool)))

    def _scattered(self, points: FloatArray, hits: _Hits) -> FloatArray:
        """Radiance (n,) that a matt base sends back, from the lamp's middle unless a body stands in between."""
        toward = self.lamp.toward(points)
        lit = np.isinf(self._nearest(points + _CLEAR_MM * hits.normal, toward).distance_mm)
        albedo = np.where(self._white(hits.surface), WHITE, self.paint.diffuse)
        slant = np.maximum(np.sum(toward * hits.normal, axis=1), 0.0)
        return np.asarray(albedo / np.pi * self.lamp.irradiance(points) * slant * lit)

    def _nearest(self, origin: FloatArray, direction: FloatArray) -> _Hits:
        distance, surface, normal = self._panel(origin, direction)
        for number, near, entered in self._bodies_hit(origin, direction):
            nearer = entered[0] < distance[near]
            hit = near[nearer]
            distance[hit], surface[hit], normal[hit] = entered[0][nearer], number, entered[1][nearer]
        return _Hits(distance, surface, normal)

    def _bodies_hit(
        self, origin: FloatArray, direction: FloatArray
    ) -> Iterator[tuple[int, IntArray, tuple[FloatArray, FloatArray]]]:
        """Body by body: its number, the rays that come near it, and their distances and normals where they enter it."""
        for i, (centre, radius) in enumerate(zip(self._centres, self._radii, strict=True)):
            near = _near(origin, direction, centre, radius)
            yield FIRST_BODY + i, near, _sphere(origin[near], direction[near], centre, radius)
        for i, pool in enumerate(self._pools):
            foot, reach = np.array([pool.x_mm, pool.y_mm, 0.0]), float(np.hypot(pool.pool_radius_mm, pool.pool_top_mm))
            near = _near(origin, direction, foot, reach)
            near = near[_reaches_pool(origin[near], direction[near], pool)]
            yield self._first_pool + i, near, _pool(origin[near], direction[near], pool)

    def _panel(self, origin: FloatArray, direction: FloatArray) -> tuple[FloatArray, IntArray, FloatArray]:
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = -origin[:, 2] / direction[:, 2]
        distance = np.where(distance > _CLEAR_MM, distance, np.inf)
        surface = np.full(len(origin), PANEL, np.intp)
        for flake in self._flakes:
            with np.errstate(invalid="ignore"):
                at = origin[:, :2] + np.where(np.isfinite(distance), distance, 0.0)[:, None] * direction[:, :2]
            surface[np.hypot(*(at - [flake.x_mm, flake.y_mm]).T) <= flake.radius_mm] = FLAKE
        return distance, surface, np.tile([0.0, 0.0, 1.0], (len(origin), 1))


def fresnel(cosine: FloatArray, paint: Paint) -> FloatArray:
    """The share (n,) of unpolarised light that a dielectric reflects, its index such that ``paint.spec`` is head on."""
    root = np.sqrt(paint.spec)
    index = (1 + root) / (1 - root)
    cosine = np.clip(cosine, 0.0, 1.0)
    inside = np.sqrt(1 - (1 - cosine**2) / index**2)
    across = (cosine - index * inside) / (cosine + index * inside)
    along = (index * cosine - inside) / (index * cosine + inside)
    return np.asarray((across**2 + along**2) / 2)


def _parts(xy_px: FloatArray, rows: int = 50_000) -> Iterator[FloatArray]:
    """Rows in blocks that fit a processor's cache; one empty block of none."""
    for start in range(0, max(len(xy_px), 1), rows):
        yield xy_px[start : start + rows]


def _near(origin: FloatArray, direction: FloatArray, centre: FloatArray, radius: float) -> IntArray:
    """Which rays come within a radius of a centre, ahead of their origin."""
    to = centre - origin
    along = np.einsum("ij,ij->i", to, direction)
    clear = np.einsum("ij,ij->i", to, to) - along**2 > radius**2 * (1 + 1e-6) + 1e-9
    return np.flatnonzero(~clear & (along > -radius))


def _sphere(
    origin: FloatArray, direction: FloatArray, centre: FloatArray, radius: float
) -> tuple[FloatArray, FloatArray]:
    """Distances (n,), inf for a miss, and normals (n, 3) where rays from outside enter a sphere."""
    to = centre - origin
    along = np.sum(to * direction, axis=1)
    # From the closest point's offset, not from |to|^2 - along^2: that would lose the digits that place a spot.
    miss = to - along[:, None] * direction
    inside = radius**2 - np.sum(miss**2, axis=1)
    distance = along - np.sqrt(np.maximum(inside, 0.0))
    distance = np.where((inside > 0) & (distance > _CLEAR_MM), distance, np.inf)
    point = along - np.sqrt(np.maximum(inside, 0.0))
    return distance, (origin + point[:, None] * direction - centre) / radius


def _reaches_pool(origin: FloatArray, direction: FloatArray, seed: Seed) -> BoolArray:
    """Which rays are inside the cylinder around a pool while they are between its foot and its top."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = (np.array([[0.0], [seed.pool_top_mm]]) - origin[:, 2]) / direction[:, 2]
    enter, leave = np.clip(np.nan_to_num(np.sort(ends, axis=0)), 0.0, None)
    flat = direction[:, :2]
    to = np.array([seed.x_mm, seed.y_mm]) - origin[:, :2]
    nearest = np.clip(np.sum(to * flat, axis=1) / np.maximum(np.sum(flat**2, axis=1), 1e-12), enter, leave)
    return np.asarray(np.linalg.norm(to - nearest[:, None] * flat, axis=1) <= seed.pool_radius_mm + _CLEAR_MM)


def _pool(origin: FloatArray, direction: FloatArray, seed: Seed) -> tuple[FloatArray, FloatArray]:
    """The same for a pool: the part of a torus' inside between its lowest ring and the one that touches the sphere."""
    fillet = float(seed.fillet_mm or 0.0)
    # Distances are taken from the ray's point nearest to the pool: the quartic then has small, well-kept numbers.
    local = origin - [seed.x_mm, seed.y_mm, fillet]
    nearest = -np.sum(local * direction, axis=1)
    local = local + nearest[:, None] * direction
    roots = _torus_roots(local, direction, seed.pool_radius_mm, fillet)
    point = local[:, None] + roots[..., None] * direction[:, None]
    ring = np.hypot(point[..., 0], point[..., 1])
    outward = point * [1.0, 1.0, 0.0] / np.maximum(ring, 1e-12)[..., None]
    normal = unit(seed.pool_radius_mm * outward - point)
    inward = np.sum(normal * direction[:, None], axis=-1) < 0
    on_profile = (ring <= seed.pool_radius_mm) & (point[..., 2] <= seed.pool_top_mm - fillet)
    distance = roots + nearest[:, None]
    distance = np.where(inward & on_profile & (distance > _CLEAR_MM), distance, np.inf)
    first = np.argmin(distance, axis=1)[:, None]
    return np.take_along_axis(distance, first, 1)[:, 0], np.take_along_axis(normal, first[..., None], 1)[:, 0]


def _torus_roots(local: FloatArray, direction: FloatArray, ring: float, tube: float) -> FloatArray:
    """Where rays (n, 3) meet a torus about z, (n, 4) distances along each, NaN for a root that is not real.

    (|p|^2 + ring^2 - tube^2)^2 = 4 ring^2 (x^2 + y^2), with p along the ray. ``local`` must be the ray's point nearest
    to the torus' middle: the quartic then lacks its cubic term, t^4 + a t^2 + b t + c = 0, and Ferrari's two quadratics
    solve it; three rounds of Newton take away what rounding the formula has lost.
    """
    around = np.sum(local**2, axis=1) + ring**2 - tube**2
    along, at = direction[:, :2], local[:, :2]
    dd, ld, ll = (np.sum(u * v, axis=1) for u, v in ((along, along), (at, along), (at, at)))
    a, b, c = 2 * around - 4 * ring**2 * dd, -8 * ring**2 * ld, around**2 - 4 * ring**2 * ll
    u = np.maximum(_largest_cubic_root(2 * a, a**2 - 4 * c, -(b**2)), 1e-12)
    s = np.sqrt(u)
    with np.errstate(divide="ignore", invalid="ignore"):
        one, other = np.sqrt(-u - 2 * a + 2 * b / s), np.sqrt(-u - 2 * a - 2 * b / s)
        roots = np.stack([-s - one, -s + one, s - other, s + other], axis=1) / 2
        a, b, c = a[:, None], b[:, None], c[:, None]
        for _ in range(3):
            roots = roots - (((roots**2 + a) * roots + b) * roots + c) / ((4 * roots**2 + 2 * a) * roots + b)
    return np.asarray(roots)


def _largest_cubic_root(a: FloatArray, b: FloatArray, c: FloatArray) -> FloatArray:
    """The largest real root (n,) of x^3 + a x^2 + b x + c (Cardano's formula, the cosine where all three are real)."""
    p, q = b - a**2 / 3, 2 * a**3 / 27 - a * b / 3 + c
    within = (q / 2) ** 2 + (p / 3) ** 3
    root = np.sqrt(np.maximum(within, 0.0))
    single = np.cbrt(-q / 2 + root) + np.cbrt(-q / 2 - root)
    size = np.sqrt(np.maximum(-p / 3, 1e-60))
    triple = 2 * size * np.cos(np.arccos(np.clip(-q / 2 / size**3, -1.0, 1.0)) / 3)
    return np.asarray(np.where(within > 0, single, triple) - a / 3)
