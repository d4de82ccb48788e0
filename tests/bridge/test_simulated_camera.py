"""The camera that draws: what it shows follows exposure and lamp, and goes wrong only where that was asked for."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError

from firmware_bridge import errors
from firmware_bridge.camera_settings import CameraSettings
from firmware_bridge.contracts import Camera
from firmware_bridge.factory import build_camera

SPOT = [30.0, 20.0, 0.5]


def camera_of(lit_share: Callable[[], float] = lambda: 1.0, **settings: Any) -> Camera:
    """An open camera without noise, unless the settings say otherwise."""
    wanted = {"kind": "simulated", "width_px": 64, "height_px": 48, "rate_hz": 1000, "noise_share": 0.0} | settings
    camera = build_camera(TypeAdapter(CameraSettings).validate_python(wanted), lit_share)
    camera.open()
    return camera


def taken(camera: Camera, exposure_us: float) -> np.ndarray[Any, Any]:
    assert camera.set_exposure_us(exposure_us) == exposure_us
    frame = camera.grab()
    assert frame.exposure_us == exposure_us
    return frame.image


@pytest.mark.parametrize("bits", [8, 16])
def test_light_is_exposure_times_lamp_and_the_sensor_is_full_at_full_scale(bits: int) -> None:
    lit = [1.0]
    camera = camera_of(lambda: lit[0], spots=[SPOT], panel_share=0.04, bits=bits)
    full = 2**bits - 1
    image = taken(camera, 1000.0)
    assert image[5, 5] == pytest.approx(0.04 * full, abs=1)
    assert 0.45 * full < image[20, 30] < 0.54 * full
    assert (image > 0.06 * full).sum() < 60, "a spot is small"
    lit[0] = 0.5
    assert taken(camera, 2000.0)[20, 30] == pytest.approx(int(image[20, 30]), abs=1)
    assert taken(camera, 20_000.0)[20, 30] == full
    lit[0] = 0.0
    assert taken(camera, 20_000.0).max() == 0


def test_noise_is_new_in_every_frame_and_as_strong_as_asked_for() -> None:
    camera = camera_of(noise_share=0.01, panel_share=0.5)
    first, second = taken(camera, 1000.0).astype(float), taken(camera, 1000.0).astype(float)
    assert np.std(second - first) == pytest.approx(np.sqrt(2) * 0.01 * 255, rel=0.15)


FAULTS = {
    "gone": errors.DeviceGone,
    "silent": errors.NoReply,
    "damaged": errors.ReplyWrong,
}


@pytest.mark.parametrize("kind", FAULTS)
def test_a_frame_can_fail_on_request(kind: str) -> None:
    camera = camera_of(faults=[{"kind": kind, "after": 2, "count": 1}])
    for _ in range(2):
        camera.grab()
    with pytest.raises(FAULTS[kind], match=r"this was asked for by camera\.faults"):
        camera.grab()
    camera.close()
    camera.open()
    assert camera.grab().frame_id == 4


@pytest.mark.parametrize(
    ("kind", "differs"),
    [
        ("black", lambda bad, _: bad.image.max() == 0),
        ("saturated", lambda bad, _: bad.image.min() == 255),
        ("noise", lambda bad, _: np.ptp(bad.image) > 250),
        ("other size", lambda bad, good: bad.image.shape == (good.image.shape[0] // 2, good.image.shape[1])),
        ("other exposure", lambda bad, good: bad.exposure_us == 2 * good.exposure_us),
        ("old", lambda bad, good: bad.frame_id == good.frame_id),
        ("ids back", lambda bad, good: bad.frame_id < good.frame_id),
    ],
)
def test_a_frame_can_be_wrong_on_request(kind: str, differs: Callable[[Any, Any], bool]) -> None:
    camera = camera_of(faults=[{"kind": kind, "after": 1, "count": 2}])
    good = camera.grab()
    assert all(differs(camera.grab(), good) for _ in range(2))
    after = camera.grab()
    assert after.frame_id == 4
    assert after.image.shape == good.image.shape


def test_every_fault_that_can_be_asked_for_is_here() -> None:
    with pytest.raises(ValidationError) as refused:
        camera_of(faults=[{"kind": "none"}])
    offered = refused.value.errors()[0]["ctx"]["expected"]
    assert all(f"'{kind}'" in offered for kind in FAULTS)
    assert offered.count("'") == 2 * 11
