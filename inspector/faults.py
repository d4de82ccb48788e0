"""The one table of fault codes: what the PLC reads, what the log says, what the operator does.

Codes never change meaning; new ones are added. Zero is no fault. Hundreds group by whose fault it is.
"""

from __future__ import annotations

import enum
from typing import Self


class Fault(enum.IntEnum):
    """A fault code with its meaning and remedy."""

    meaning: str
    remedy: str

    def __new__(cls, code: int, meaning: str, remedy: str) -> Self:
        member = int.__new__(cls, code)
        member._value_ = code
        member.meaning = meaning
        member.remedy = remedy
        return member

    NONE = 0, "No fault", "Nothing to do"

    MODULE_GONE = 101, "The I/O module's port is missing or closed", "Check the adapter's cable and the port's name"
    MODULE_SILENT = 102, "The I/O module does not answer", "Check power, unit id, baud rate and A/B wiring"
    MODULE_REPLY_WRONG = 103, "The I/O module's answer is damaged or for another unit", "Check shield and unit ids"
    MODULE_REFUSED = 104, "The I/O module refused a request (Modbus exception)", "Check profile and channel"
    MODULE_WATCHDOG_TRIPPED = 105, "The I/O module's watchdog tripped and it ignores writes", "Clear the trip status"

    LAMP_READBACK = 201, "The lamp level read back is not the level set", "Check the module's output and range"
    LAMP_WARMING_UP = 202, "The lamp is not warm yet", "Wait for the warm-up time"
    LAMP_WEAK = 203, "The lamp is too weak to keep its level", "Change the bulb"

    CAMERA_GONE = 301, "The camera or its folder is missing", "Check cable, power and address"
    CAMERA_TIMEOUT = 302, "The camera gave no frame in time", "Check trigger and exposure"
    CAMERA_FRAME_WRONG = 303, "The camera's frame is short, stale or unreadable", "Check the link and the frame source"
    CAMERA_REFUSED = 304, "The camera refused a setting", "Set it within the camera's range"
    EXPOSURE_READBACK = 305, "The frame was not taken at the exposure set", "Check the camera's range and mode"

    FRAME_BLACK = 401, "The frame is black", "Check lamp, lens cap and exposure"
    FRAME_OVERLIT = 402, "The frame is lit all over", "Shield from ambient light; lower exposure"
    FRAME_WRONG_SHAPE = 403, "The frame's shape is not the calibration's", "Calibrate this camera, or undo its ROI"

    CYCLE_STALLED = 501, "The inspection cycle has stopped", "The watchdog restarts the service; send us its log"
    INTERNAL = 502, "An error in the program", "Send us the log"
    SETTINGS_REFUSED = 503, "New settings were refused; the old ones stay", "Run: inspector config check FILE"

    STORE_DEGRADED = 601, "The results' store cannot be written, or not in time", "Check the disk: space, health, mount"
    STORE_DAMAGED = 602, "The results' store was damaged and has been set aside", "Save the file; check the disk"
