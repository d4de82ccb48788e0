"""Lamp -> exposure -> grab -> Frame, where every setting is read back: what is not as set raises, and is no frame."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass

from firmware_bridge.contracts import Camera, CameraFrame, Lamp
from firmware_bridge.errors import ReadBackWrong
from inspector.acquire.keeper import Keeper, Waiting
from inspector.model import Frame

EXPOSURE_STEP_US = 1.0
"""Cameras take exposures in whole microseconds or finer: a difference below one step is rounding."""


@dataclass(frozen=True, slots=True)
class Wanted:
    """How a frame is to be taken, and how near the read-back must be; the exposure's tolerance is a share of it."""

    exposure_us: float
    lamp_v: float
    lamp_tolerance_v: float
    exposure_tolerance: float


def prepare(lamp: Keeper[Lamp], camera: Keeper[Camera], wanted: Wanted) -> None:
    """Set lamp and exposure as wanted, so that the next frame need not wait for them. Raises BridgeError."""
    lamp.use(lambda device: _light(device, wanted))
    camera.use(lambda device: _check_exposure(device.set_exposure_us(wanted.exposure_us), wanted, "reads back"))


def capture(lamp: Keeper[Lamp], camera: Keeper[Camera], wanted: Wanted, waiting: Waiting = nullcontext) -> Frame:
    """One frame, taken with the lamp and the exposure as wanted. Raises BridgeError.

    The lamp is read again after the grab, so that one which died during the exposure is noticed. ``waiting`` is
    entered around what may wait long for the camera.
    """
    lamp.use(lambda device: _light(device, wanted))
    taken, exposure_us = camera.use(lambda device: _expose(device, wanted, waiting))
    lamp_v = lamp.use(lambda device: _still_lit(device, wanted))
    return Frame(taken.image, taken.name, taken.frame_id, exposure_us, lamp_v, taken.taken_at_s, taken.taken_s)


def _light(lamp: Lamp, wanted: Wanted) -> None:
    _check_lamp(lamp.set_volts(wanted.lamp_v), wanted, "it was set")


def _still_lit(lamp: Lamp, wanted: Wanted) -> float:
    return _check_lamp(lamp.read_volts(), wanted, "the exposure")


def _check_lamp(read_v: float, wanted: Wanted, when: str) -> float:
    # Written so that a NaN is out of tolerance too.
    if not abs(read_v - wanted.lamp_v) <= wanted.lamp_tolerance_v:
        raise ReadBackWrong(
            "lamp",
            f"reads back {read_v:.3f} V after {when}, not {wanted.lamp_v:.3f} V within {wanted.lamp_tolerance_v:g} V",
            "check the module's output and range",
        )
    return read_v


def _expose(camera: Camera, wanted: Wanted, waiting: Waiting) -> tuple[CameraFrame, float]:
    """A new frame and the exposure it was taken at: the frame's own word, else the setting as read back."""
    set_us = _check_exposure(camera.set_exposure_us(wanted.exposure_us), wanted, "reads back")
    with waiting():
        taken = camera.grab()
    if taken.exposure_us is None:
        return taken, set_us
    return taken, _check_exposure(taken.exposure_us, wanted, "took the frame at")


def _check_exposure(exposure_us: float, wanted: Wanted, how: str) -> float:
    tolerance_us = max(wanted.exposure_us * wanted.exposure_tolerance, EXPOSURE_STEP_US)
    if not abs(exposure_us - wanted.exposure_us) <= tolerance_us:
        raise ReadBackWrong(
            "camera",
            f"{how} {exposure_us:g} us, not {wanted.exposure_us:g} us within {tolerance_us:g} us",
            "check the camera's range and mode",
        )
    return exposure_us
