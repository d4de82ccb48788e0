"""Calibration files: read as other tools write them, refused with every problem, never half written."""

from __future__ import annotations

import copy
import math
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from board_scene import Scene
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from inspector import calibration_file
from inspector.calibration_file import CalibrationError, lamp_direction, read, write
from inspector.model import CAMERA_PARAMETERS
from inspector.optics import Calibration, Light, Sensor

FOREIGN: dict[str, Any] = {
    "version": 1,
    "camera": {
        "model": "tsai", "width_px": 640, "height_px": 480, "f_mm": 7.972616, "kappa1_per_mm2": 0.008464034,
        "sx": 1, "cx_px": 320, "cy_px": 240.0, "dx_mm": 0.0075, "dy_mm": 0.0075,
        "rotation": [
            [0.427326, 0.00879, -0.904055], [-0.014612, -0.999755, -0.016627], [-0.90398, 0.020315, -0.427092]
        ],
        "translation_mm": [-31.566435, 51.851543, 331.419589],
    },
    "light": {"direction": [-0.49987378804920174, 0.011233700251551447, 0.8660254037844387]},
}  # fmt: skip
"""What a tool that knows only the file's description writes, with the numbers of the thesis' Table 5.3."""

Load = Callable[[dict[str, Any]], Calibration]


@pytest.fixture
def load(tmp_path: Path) -> Load:
    def through_a_file(document: dict[str, Any]) -> Calibration:
        path = tmp_path / "calibration.yaml"
        path.write_text(yaml.safe_dump(document))
        return read(path)

    return through_a_file


def changed(**changes: Any) -> dict[str, Any]:
    """FOREIGN with values replaced: camera__f_mm=8 sets camera.f_mm; ... removes."""
    document = copy.deepcopy(FOREIGN)
    for name, value in changes.items():
        *parents, last = name.split("__")
        place = document
        for parent in parents:
            place = place.setdefault(parent, {})
        place.pop(last, None) if value is ... else place.update({last: value})
    return document


def test_a_foreign_file_is_read_with_the_defaults(load: Load) -> None:
    c = load(FOREIGN)
    assert (c.camera.f_mm, c.camera.sx, c.camera.width_px) == (7.972616, 1.0, 640)
    assert np.array_equal(c.camera.rotation, FOREIGN["camera"]["rotation"])
    assert c.light.direction is not None
    assert np.array_equal(c.light.direction, FOREIGN["light"]["direction"])
    assert (c.light.position_mm, c.light.angular_sigma_deg) == (None, None)
    assert c.sensor == Sensor(gamma=1.0, black_dn=None, saturation_dn=255.0)
    assert (c.height_gain, c.covariance, c.covariance_of) == (1.0, None, ())
    assert c.view_angle_deg == pytest.approx(64.7168, abs=1e-3)


def test_optional_keys_are_read(load: Load) -> None:
    c = load(
        changed(light__angular_sigma_deg=2, view_angle_deg=65, height_gain=1.064, sensor={"gamma": 0.45, "black_dn": 3},
                uncertainty={"parameters": ["f_mm", "kappa1_per_mm2"], "covariance": [[1e-4, 0], [0, 1e-8]]})
    )  # fmt: skip
    assert (c.light.angular_sigma_deg, c.view_angle_deg, c.height_gain) == (2.0, 65.0, 1.064)
    assert c.sensor == Sensor(0.45, 3.0, 255.0)
    assert c.covariance_of == ("f_mm", "kappa1_per_mm2")
    assert np.array_equal(c.covariance, [[1e-4, 0], [0, 1e-8]])


def test_numbers_as_json_writes_them(load: Load, tmp_path: Path) -> None:
    path = tmp_path / "c.yaml"
    path.write_text(yaml.safe_dump(FOREIGN).replace("0.008464034", "8.464034e-3"))
    assert read(path).camera.kappa1_per_mm2 == 8.464034e-3


def test_the_lamp_is_opposite_the_camera_unless_told(load: Load) -> None:
    opposite = load(changed(light={"alpha_deg": 30})).light.direction
    assert opposite == pytest.approx(FOREIGN["light"]["direction"], abs=1e-6)
    turned = load(changed(light={"alpha_deg": 30.0, "azimuth_deg": 90})).light.direction
    assert turned == pytest.approx([0, 0.5, math.sqrt(0.75)])
    upright = load(changed(light={"alpha_deg": 0})).light.direction
    assert upright == pytest.approx([0, 0, 1])


def test_a_near_lamp(load: Load) -> None:
    light = load(changed(light={"position_mm": [-200, 50, 300], "angular_sigma_deg": 1.5})).light
    assert light.direction is None
    assert np.array_equal(light.position_mm, [-200, 50, 300])


def test_a_direction_of_three_decimals_is_made_unit(load: Load) -> None:
    assert np.linalg.norm(load(changed(light={"direction": [-0.5, 0.011, 0.866]})).light.direction) == pytest.approx(1)


ROTATION = FOREIGN["camera"]["rotation"]


@pytest.mark.parametrize(
    ("changes", "path", "allowed"),
    [
        ({"version": 2}, "version", "1"),
        ({"version": ...}, "version", "required"),
        ({"camera": ...}, "camera", "required"),
        ({"light": ...}, "light", "required"),
        ({"camera__model": "pinhole"}, "camera.model", "tsai"),
        ({"camera__f_mm": ...}, "camera.f_mm", "required"),
        ({"camera__f_mm": 0}, "camera.f_mm", "above 0"),
        ({"camera__f_mm": "8"}, "camera.f_mm", "number"),
        ({"camera__f_mm": True}, "camera.f_mm", "number"),
        ({"camera__f_mm": math.nan}, "camera.f_mm", "number"),
        ({"camera__f_mm": math.inf}, "camera.f_mm", "number"),
        ({"camera__width_px": 640.5}, "camera.width_px", "whole number"),
        ({"camera__width_px": -640}, "camera.width_px", "above 0"),
        ({"camera__focal_mm": 8.0}, "camera.focal_mm", "unknown key"),
        ({"lamp": {}}, "lamp", "unknown key"),
        ({"camera__rotation": ROTATION[:2]}, "camera.rotation", "3"),
        ({"camera__rotation": [[*r[:2], math.nan] for r in ROTATION]}, "camera.rotation[0][2]", "number"),
        ({"camera__rotation": [[1.001 * v for v in r] for r in ROTATION]}, "camera.rotation", "not a rotation"),
        ({"camera__rotation": [ROTATION[1], ROTATION[0], ROTATION[2]]}, "camera.rotation", "right-handed"),
        ({"camera__translation_mm": [0, 0]}, "camera.translation_mm", "3"),
        ({"camera__translation_mm": [0, 0, -300]}, "camera", "above the panel"),
        ({"light": {}}, "light", "exactly one of"),
        ({"light__alpha_deg": 30}, "light", "exactly one of"),
        ({"light__azimuth_deg": 30}, "light", "azimuth_deg without alpha_deg"),
        ({"light": {"alpha_deg": 90}}, "light.alpha_deg", "below 90"),
        ({"light": {"direction": [0, 0, 2]}}, "light.direction", "length 1"),
        ({"light": {"direction": [0, 0.6, -0.8]}}, "light.direction", "z > 0"),
        ({"light": {"position_mm": [0, 0, -5]}}, "light.position_mm", "z > 0"),
        ({"light__angular_sigma_deg": -1}, "light.angular_sigma_deg", "from 0"),
        ({"view_angle_deg": 90}, "view_angle_deg", "below 90"),
        ({"height_gain": 0}, "height_gain", "above 0"),
        ({"sensor": {"gamma": 0}}, "sensor.gamma", "above 0"),
        ({"sensor": {"black_dn": 255}}, "sensor", "less than saturation_dn"),
        ({"uncertainty": {"parameters": ["f_mm"], "covariance": [[1, 0]]}}, "uncertainty", "1 x 1"),
        ({"uncertainty": {"parameters": ["f"], "covariance": [[1]]}}, "uncertainty.parameters", "f_mm"),
        ({"uncertainty": {"parameters": ["f_mm"], "covariance": [[-1]]}}, "uncertainty", "negative"),
    ],
)
def test_each_problem_is_named(load: Load, changes: dict[str, Any], path: str, allowed: str) -> None:
    with pytest.raises(CalibrationError) as caught:
        load(changed(**changes))
    problems = str(caught.value).splitlines()[1:]
    assert any(f": {path}: " in line and allowed in line for line in problems), caught.value


def test_all_problems_at_once(load: Load) -> None:
    wrong = changed(camera__f_mm=-1, camera__rotation=[[1, 0, 0]] * 3, light__direction=[0, 0, 0], height_gain="big")
    with pytest.raises(CalibrationError) as caught:
        load(wrong)
    for place in ("camera.f_mm: -1", "camera.rotation", "light.direction", "height_gain: 'big'"):
        assert place in str(caught.value)


def test_a_camera_that_looks_straight_down_has_no_opposite(load: Load) -> None:
    down = changed(camera__rotation=[[1, 0, 0], [0, -1, 0], [0, 0, -1]], camera__translation_mm=[0, 0, 300])
    with pytest.raises(CalibrationError, match="azimuth_deg"):
        load(down | {"light": {"alpha_deg": 30}})
    assert load(down | {"light": {"alpha_deg": 30, "azimuth_deg": 0}}).light.direction == pytest.approx(
        [0.5, 0, math.sqrt(0.75)]
    )


@pytest.mark.parametrize("content", [b"", b"[1, 2", b"- 1\n", b"version: 1\nversion: 1\n", b"\xff\xfe\x00", b"a: b: c"])
def test_what_is_no_calibration_is_refused_by_name(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "broken.yaml"
    path.write_bytes(content)
    with pytest.raises(CalibrationError, match=r"broken\.yaml"):
        read(path)


def test_a_missing_file_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"none\.yaml.*\n.*No such file"):
        read(tmp_path / "none.yaml")


# --- writing ---------------------------------------------------------------------------------------------------------


def calibration(**changes: Any) -> Calibration:
    camera = Scene().camera
    return replace(Calibration(camera, Light(lamp_direction(camera, 30)), 65.0), **changes)


def same(a: Calibration, b: Calibration) -> bool:
    """Whether two calibrations agree to the last bit."""
    pairs = [(getattr(a.camera, k), getattr(b.camera, k)) for k in ("rotation", "translation_mm")]
    pairs += [(a.light.direction, b.light.direction), (a.light.position_mm, b.light.position_mm)]
    pairs += [(a.covariance, b.covariance)]
    arrays = all((x is None and y is None) or np.array_equal(x, y) for x, y in pairs)
    numbers = [(c.camera.f_mm, c.camera.kappa1_per_mm2, c.camera.cx_px, c.view_angle_deg, c.sensor, c.height_gain,
                c.covariance_of, c.light.angular_sigma_deg) for c in (a, b)]  # fmt: skip
    return arrays and numbers[0] == numbers[1]


finite = st.floats(-1e3, 1e3)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    f_mm=st.floats(1e-3, 1e3), kappa1=st.floats(-1, 1), azimuth=st.floats(-360, 360), alpha=st.floats(0, 89),
    gain=st.floats(0.5, 2), spread=st.lists(finite, min_size=64, max_size=64),
)  # fmt: skip
def test_what_is_written_is_read_to_the_last_bit(
    tmp_path: Path, f_mm: float, kappa1: float, azimuth: float, alpha: float, gain: float, spread: list[float]
) -> None:
    camera = replace(Scene(azimuth_deg=azimuth).camera, f_mm=np.float64(f_mm), kappa1_per_mm2=kappa1)
    root = np.array(spread).reshape(8, 8)
    covariance = root @ root.T
    written = Calibration(camera, Light(lamp_direction(camera, alpha, azimuth), None, 1.75), 65.0,
                          Sensor(0.45, 6.1, 4095.0), gain, (covariance + covariance.T) / 2,
                          CAMERA_PARAMETERS)  # fmt: skip
    assert camera.centre_mm[2] > 0  # which also fills the camera's cache: it is no key of the file
    path = tmp_path / "c.yaml"
    write(path, written)
    assert same(read(path), written)


def test_a_near_lamp_is_written_and_read(tmp_path: Path) -> None:
    written = calibration(light=Light(None, np.array([-100.0, 3.0, 250.0])))
    write(tmp_path / "c.yaml", written)
    assert same(read(tmp_path / "c.yaml"), written)


def test_residuals_are_kept(tmp_path: Path) -> None:
    point = calibration_file.PointResidual(world_mm=[1, 2, 0], seen_px=[3, 4], residual_px=[0.1, 0.2])
    kept = calibration_file.Residuals(method="tsai", mean_px=0.1, rms_px=0.2, largest_px=0.3, points=[point])
    write(tmp_path / "c.yaml", calibration(), kept)
    assert calibration_file.load(tmp_path / "c.yaml").residuals == kept


def test_what_could_not_be_read_back_is_not_written(tmp_path: Path) -> None:
    path = tmp_path / "c.yaml"
    write(path, calibration())
    before = path.read_bytes()
    with pytest.raises(CalibrationError, match="height_gain"):
        write(path, calibration(height_gain=float("nan")))
    assert path.read_bytes() == before


def test_an_interrupted_write_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "c.yaml"
    write(path, calibration())
    before = path.read_bytes()

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        write(path, calibration(height_gain=1.1))
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["c.yaml"]


def test_the_service_may_read_what_a_person_wrote(tmp_path: Path) -> None:
    path = tmp_path / "c.yaml"
    mask = os.umask(0o022)
    try:
        write(path, calibration())
    finally:
        os.umask(mask)
    assert path.stat().st_mode & 0o777 == 0o644
