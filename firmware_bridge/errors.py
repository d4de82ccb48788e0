"""One error tree; an error says whose fault it is and what to do.

``OutOfRange`` is the caller's fault: nothing was sent. ``DeviceGone``, ``NoReply`` and ``ReplyWrong`` are the
device's or the wire's: the driver is closed and reopened with back-off. ``Refused`` is the device's considered no.
"""

from __future__ import annotations


class BridgeError(Exception):
    """Base of all that a device can raise. ``device`` names it as the settings do (camera, lamp, module)."""

    def __init__(self, device: str, message: str, remedy: str = "") -> None:
        super().__init__(f"{device}: {message}" + (f"; {remedy}" if remedy else ""))
        self.device = device
        self.message = message
        self.remedy = remedy


class OutOfRange(BridgeError):
    """The request is outside what the device can do; nothing was sent."""


class DeviceGone(BridgeError):
    """The port, socket or folder is missing or closed under us."""


class NoReply(BridgeError):
    """The device did not answer, or gave no frame, within its deadline."""


class NoTrigger(NoReply):
    """The camera works and waits for its hardware line: the line stands still. No fault; the device stays open.

    ``passed_over``: frames that the camera had taken before it was asked, and that nobody is given.
    """

    passed_over = 0


class EndOfRecording(NoReply):
    """A recording was shown to its end; there is nothing wrong, and nothing more."""


class ReplyWrong(BridgeError):
    """The answer is damaged, stale, truncated, or another device's."""


class Refused(BridgeError):
    """The device answered no (a Modbus exception, a camera's error text)."""


class WatchdogTripped(Refused):
    """The module fell back to its safe value and ignores writes until its status is cleared."""


class ReadBackWrong(BridgeError):
    """The device took the setting but reads back another value."""
