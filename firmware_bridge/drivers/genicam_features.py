"""How a GenICam camera is to be set, each feature read back. Names are SFNC's; Aravis knows the older ones too.

Aravis turns exposure, gain, trigger and region into the features that the camera has (ExposureTime or
ExposureTimeAbs, Gain or GainRaw, TriggerSelector where there is one); what the camera has not is Refused.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from firmware_bridge.contracts import CameraCapabilities
from firmware_bridge.errors import OutOfRange, ReadBackWrong, Refused
from firmware_bridge.links.aravis import AravisCamera

_CONTINUOUS, _AUTO_OFF = 0, 0
"""Of ArvAcquisitionMode and ArvAuto."""

FREE_RUNNING = "Off"
SOFTWARE = "Software"

STEP_UNKNOWN_US = 1.0
"""Step of an exposure whose feature names none."""


@dataclass(frozen=True, slots=True)
class Region:
    """Part of the sensor that is read out, pixels."""

    x_px: int
    y_px: int
    width_px: int
    height_px: int


@dataclass(frozen=True, slots=True)
class Wanted:
    """Everything that is set at opening: a camera keeps what others left in it.

    ``trigger`` is Software, a line's name (Line0...), or Off for a camera that runs freely. ``region`` None is the
    whole sensor, ``gain_db`` None the lowest gain, ``packet_size_bytes`` None the largest that the network takes.
    """

    pixel_format: str = "Mono8"
    region: Region | None = None
    trigger: str = SOFTWARE
    gain_db: float | None = None
    packet_size_bytes: int | None = None


def set_up(camera: AravisCamera, wanted: Wanted, device: str) -> CameraCapabilities:
    """Set the open camera; what it can do then. Raises DeviceGone, Refused, OutOfRange, ReadBackWrong."""
    if camera.call("is_exposure_auto_available"):
        camera.call("set_exposure_time_auto", _AUTO_OFF)
    camera.call("set_acquisition_mode", _CONTINUOUS)
    _set_gain(camera, wanted.gain_db, device)
    camera.call("set_pixel_format_from_string", wanted.pixel_format.encode())
    _check(device, "pixel format", wanted.pixel_format, camera.text("get_pixel_format_as_string"))
    region = _set_region(camera, wanted.region, device)
    _set_trigger(camera, wanted.trigger, device)
    low_us, high_us = camera.floats("get_exposure_time_bounds")
    triggers = camera.texts("dup_available_trigger_sources")
    return CameraCapabilities(low_us, high_us, _step_us(camera), region.width_px, region.height_px, triggers)


def _check(device: str, what: str, wanted: object, found: object) -> None:
    if found != wanted:
        raise ReadBackWrong(device, f"{what} reads back {found}, not {wanted}", "choose a value that the camera has")


def _set_gain(camera: AravisCamera, gain_db: float | None, device: str) -> None:
    if camera.call("is_gain_auto_available"):
        camera.call("set_gain_auto", _AUTO_OFF)
    if not camera.call("is_gain_available"):
        if gain_db:
            raise Refused(device, "has no gain that can be set", "set gain_db: null")
        return
    low_db, high_db = camera.floats("get_gain_bounds")
    wanted_db = low_db if gain_db is None else gain_db
    if not low_db <= wanted_db <= high_db:
        raise OutOfRange(device, f"gain {wanted_db:g} dB is outside {low_db:g} to {high_db:g} dB", "set gain_db so")
    camera.call("set_gain", wanted_db)
    found_db = camera.call("get_gain")
    if not math.isclose(found_db, wanted_db, abs_tol=0.1):
        _check(device, "gain", wanted_db, found_db)


def _set_region(camera: AravisCamera, wanted: Region | None, device: str) -> Region:
    camera.call("set_region", 0, 0, -1, -1)  # how wide and high it may be depends on the offsets
    _, width_px = camera.integers("get_width_bounds")
    _, height_px = camera.integers("get_height_bounds")
    wanted = wanted or Region(0, 0, width_px, height_px)
    if wanted.x_px + wanted.width_px > width_px or wanted.y_px + wanted.height_px > height_px:
        raise OutOfRange(device, f"{wanted} ends outside the sensor's {width_px} x {height_px}", "choose a smaller roi")
    camera.call("set_region", wanted.x_px, wanted.y_px, wanted.width_px, wanted.height_px)
    found = Region(*camera.integers("get_region", 4))
    _check(device, "region", wanted, found)
    return found


def _set_trigger(camera: AravisCamera, trigger: str, device: str) -> None:
    if trigger == FREE_RUNNING:
        camera.call("clear_triggers")
        return
    camera.call("set_trigger", trigger.encode())
    _check(device, "trigger source", trigger, camera.text("get_trigger_source"))


def _step_us(camera: AravisCamera) -> float:
    """Step of the exposure; features without one answer with the least number there is."""
    feature = b"ExposureTime" if camera.call("is_feature_available", b"ExposureTime") else b"ExposureTimeAbs"
    try:
        step_us: float = camera.call("get_float_increment", feature)
    except Refused:
        return STEP_UNKNOWN_US
    return step_us if step_us > 1e-6 else STEP_UNKNOWN_US
