"""What is known of a scene: the place of every spot, to the last digit, and whether it can be seen."""

from __future__ import annotations

from typing import Any

import numpy as np

from inspector.lab import records
from inspector.lab.scene import Scene, Seed, mirrored, pool_glint_mm, sphere_glint_mm, unit
from inspector.lab.trace import Tracer
from inspector.model import FloatArray
from inspector.optics import Camera

_PEAK_REACH_PX = 1.5
_FAR_MM = 1e4


def of(scene: Scene, grey: FloatArray) -> dict[str, Any]:
    """``scene`` and ``defects`` as plain values. ``grey`` (height, width): the frame without noise or clipping."""
    tracer = Tracer(scene)
    return {
        "scene": records.write(scene),
        "defects": [_defect(i, seed, scene, tracer, grey) for i, seed in enumerate(scene.seeds)],
    }


def _defect(number: int, seed: Seed, scene: Scene, tracer: Tracer, grey: FloatArray) -> dict[str, Any]:
    eye = scene.camera.centre_mm
    direct = sphere_glint_mm(seed, scene.lamp, eye)
    mirror = sphere_glint_mm(seed, scene.lamp, mirrored(eye))
    on_panel = mirror + (mirrored(eye) - mirror) * mirror[2] / (mirror[2] + eye[2])
    direct_px, mirror_px = scene.camera.project(np.array([direct, mirrored(mirror)]))
    lit = {"direct": _lit(tracer, seed, direct), "mirror": _lit(tracer, seed, mirror)}
    seen = {
        "direct": not tracer.blocked(direct, eye),
        "mirror": not tracer.blocked(mirror, on_panel) and not tracer.blocked(on_panel, eye),
    }
    record = {
        "id": number,
        "x_w": seed.x_mm,
        "y_w": seed.y_mm,
        "R": seed.radius_mm,
        "c": seed.centre_z_mm,
        "height_a": seed.height_mm,
        "submersion_c_over_R": seed.centre_z_mm / seed.radius_mm,
        "kind": seed.kind,
        "direct_px": direct_px.tolist(),
        "mirror_px": mirror_px.tolist(),
        "separation_px": float(np.linalg.norm(direct_px - mirror_px)),
        "direct_world": direct.tolist(),
        "mirror_world": mirror.tolist(),
        "mirror_panel_world": on_panel.tolist(),
    }
    for name, at in (("direct", direct_px), ("mirror", mirror_px)):
        record[f"{name}_visible"] = lit[name] and seen[name]
        record[f"{name}_in_frame"] = _in_frame(scene.camera, at)
        record[f"{name}_peak_dn_unclipped"] = _peak(grey, at) if record[f"{name}_visible"] else None
    pool = pool_glint_mm(seed, scene.lamp, eye)
    if pool is not None:
        visible = _lit(tracer, seed, pool) and not tracer.blocked(pool, eye, 1e-4)
        record["pool"] = {
            "px": scene.camera.project(pool[None])[0].tolist(),
            "world": pool.tolist(),
            "visible": visible,
        }
    return record


def _lit(tracer: Tracer, seed: Seed, point_mm: FloatArray) -> bool:
    """Whether the lamp's middle shines on a point, which must also lie clear of the paint and of its own pool."""
    on_sphere = np.linalg.norm(point_mm - seed.centre_mm) < seed.radius_mm * (1 + 1e-6)
    if point_mm[2] < (seed.pool_top_mm if on_sphere else 0.0):
        return False
    lamp = tracer.lamp
    end = lamp.position_mm if lamp.position_mm is not None else point_mm + _FAR_MM * unit(lamp.direction)
    return not tracer.blocked(point_mm, end, 1e-4)


def _in_frame(camera: Camera, xy_px: FloatArray) -> bool:
    x, y = xy_px
    return bool(0 <= x <= camera.width_px - 1 and 0 <= y <= camera.height_px - 1)


def _peak(grey: FloatArray, xy_px: FloatArray) -> float | None:
    """The greatest grey level within :data:`_PEAK_REACH_PX` of a spot; None where that lies outside the frame."""
    low = np.maximum(np.ceil(xy_px - _PEAK_REACH_PX), 0).astype(int)
    high = np.maximum(np.floor(xy_px + _PEAK_REACH_PX) + 1, 0).astype(int)
    part = grey[low[1] : high[1], low[0] : high[0]]
    return float(part.max()) if part.size else None
