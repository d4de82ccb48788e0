"""A scene as plain values, as it stands in a truth file, and back."""

from __future__ import annotations

from typing import Any

import numpy as np

from inspector.lab.scene import Dust, Lamp, Lens, Paint, Scene, Seed, Sensor
from inspector.optics import Camera


def read(record: dict[str, Any]) -> Scene:
    """The scene of a record, the same as was written. Raises KeyError with the name of a value that is missing."""
    optics, sensor = record["optics"], record["sensor"]
    return Scene(
        _camera_of(record["camera"]),
        _lamp_of(record["light"]),
        tuple(Seed(s["x"], s["y"], s["R"], s["c"], s.get("fillet_rho")) for s in record["seeds"]),
        tuple(Dust(d["type"], d["x"], d["y"], d["r"]) for d in record["dust"]),
        Paint(record["paint"]["spec"], record["paint"]["diff"]),
        Lens(optics["fnum"], optics["psf_sigma"], optics["halo"], optics["halo_sigma"]),
        Sensor(
            exposure=sensor["tau"],
            e_saturation=sensor["E_sat"],
            gamma=sensor["gamma"],
            full_well_e=sensor["full_well"],
            read_noise_e=sensor["read_e"],
            offset_dn=sensor["offset_dn"],
            prnu=sensor["prnu"],
            bloom=sensor["bloom"],
            hot=tuple((int(x), int(y), float(dn)) for x, y, dn in sensor["hot"]),
            bits=sensor.get("bits", 8),
            seed=sensor["seed"],
        ),
    )


def _camera_of(record: dict[str, Any]) -> Camera:
    return Camera(
        width_px=record["width"],
        height_px=record["height"],
        f_mm=record["f_mm"],
        kappa1_per_mm2=record["kappa1_per_mm2"],
        sx=record["sx"],
        cx_px=record["Cx"],
        cy_px=record["Cy"],
        dx_mm=record["dx_mm"],
        dy_mm=record["dy_mm"],
        rotation=np.array(record["R"]),
        translation_mm=np.array(record["T_mm"]),
    )


def _lamp_of(record: dict[str, Any]) -> Lamp:
    near: dict[str, Any] = {name: np.array(record[name]) for name in ("position_mm", "seen_from_mm") if name in record}
    beam = {name: record[name] for name in ("sigma_deg", "cutoff_deg", "radiance")}
    return Lamp(np.array(record["dir"]), **near, **beam)


def write(scene: Scene) -> dict[str, Any]:
    """The scene as plain values, fit for JSON."""
    lens, sensor = scene.lens, scene.sensor
    return {
        "camera": _camera(scene.camera),
        "alpha_deg": float(np.degrees(np.arccos(scene.lamp.direction[2]))),
        "beta_nominal_deg": scene.camera.view_angle_deg,
        "beta_axis_deg": scene.camera.view_angle_deg,
        "light": _lamp(scene.lamp),
        "paint": {"spec": scene.paint.spec, "diff": scene.paint.diffuse},
        "seeds": [_seed(s) for s in scene.seeds],
        "dust": [_dust(d) for d in scene.dust],
        "optics": {
            "fnum": lens.f_number,
            "psf_sigma": lens.psf_sigma_px,
            "halo": lens.halo,
            "halo_sigma": lens.halo_sigma_px,
        },
        "sensor": {
            "tau": sensor.exposure,
            "E_sat": sensor.e_saturation,
            "gamma": sensor.gamma,
            "full_well": sensor.full_well_e,
            "read_e": sensor.read_noise_e,
            "offset_dn": sensor.offset_dn,
            "prnu": sensor.prnu,
            "bloom": sensor.bloom,
            "hot": [list(h) for h in sensor.hot],
            "bits": sensor.bits,
            "seed": sensor.seed,
        },
    }


def _camera(camera: Camera) -> dict[str, Any]:
    return {
        "f_mm": camera.f_mm,
        "kappa1_per_mm2": camera.kappa1_per_mm2,
        "R": camera.rotation.tolist(),
        "T_mm": camera.translation_mm.tolist(),
        "dx_mm": camera.dx_mm,
        "dy_mm": camera.dy_mm,
        "Cx": camera.cx_px,
        "Cy": camera.cy_px,
        "sx": camera.sx,
        "width": camera.width_px,
        "height": camera.height_px,
        "centre_world_mm": camera.centre_mm.tolist(),
    }


def _lamp(lamp: Lamp) -> dict[str, Any]:
    record: dict[str, Any] = {
        "dir": lamp.direction.tolist(),
        "sigma_deg": lamp.sigma_deg,
        "cutoff_deg": lamp.cutoff_deg,
        "radiance": lamp.radiance,
    }
    if lamp.position_mm is not None:
        record |= {"position_mm": lamp.position_mm.tolist(), "seen_from_mm": lamp.seen_from_mm.tolist()}
    return record


def _seed(seed: Seed) -> dict[str, Any]:
    record = {"x": seed.x_mm, "y": seed.y_mm, "R": seed.radius_mm, "c": seed.centre_z_mm, "kind": seed.kind}
    return record if seed.fillet_mm is None else record | {"fillet_rho": seed.fillet_mm}


def _dust(dust: Dust) -> dict[str, Any]:
    return {"type": dust.kind, "x": dust.x_mm, "y": dust.y_mm, "r": dust.radius_mm}
