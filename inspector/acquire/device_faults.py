"""Which fault code a device's error is: one table, (device, class of error) -> code."""

from __future__ import annotations

from firmware_bridge import errors
from inspector.faults import Fault

_MODULE: dict[type[errors.BridgeError], Fault] = {
    errors.DeviceGone: Fault.MODULE_GONE,
    errors.NoReply: Fault.MODULE_SILENT,
    errors.ReplyWrong: Fault.MODULE_REPLY_WRONG,
    errors.Refused: Fault.MODULE_REFUSED,
    errors.OutOfRange: Fault.MODULE_REFUSED,
    errors.WatchdogTripped: Fault.MODULE_WATCHDOG_TRIPPED,
    errors.ReadBackWrong: Fault.LAMP_READBACK,
}
FAULTS: dict[str, dict[type[errors.BridgeError], Fault]] = {
    "module": _MODULE,
    "lamp": _MODULE,  # a lamp has no wire of its own: all it can say is its module's
    "camera": {
        errors.DeviceGone: Fault.CAMERA_GONE,
        errors.NoReply: Fault.CAMERA_TIMEOUT,
        errors.ReplyWrong: Fault.CAMERA_FRAME_WRONG,
        errors.Refused: Fault.CAMERA_REFUSED,
        errors.OutOfRange: Fault.CAMERA_REFUSED,
        errors.ReadBackWrong: Fault.EXPOSURE_READBACK,
    },
}
"""An error's code is that of the nearest class in its ancestry; a device or class not listed is INTERNAL."""


def fault_of(error: errors.BridgeError) -> Fault:
    """The fault code of a device's error."""
    codes = FAULTS.get(error.device, {})
    return next((codes[kind] for kind in type(error).__mro__ if kind in codes), Fault.INTERNAL)
