"""What a camera, a lamp and an I/O module promise, in units. Drivers are blocking; one thread owns each.

Every method raises only :mod:`firmware_bridge.errors`; every blocking call returns or raises within the deadline
configured for the device. ``open`` may be called again after ``close``; ``close`` may be called twice.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt


@dataclass(frozen=True, slots=True)
class CameraFrame:
    """A frame as the camera gave it: image (H, W) uint8 or uint16; ids rise by the frames the camera took.

    ``exposure_us`` is the exposure it was really taken at, None when the source does not know.
    ``taken_at_s`` is Unix time, for records: that clock may be set. ``taken_s`` is the same moment on this machine's
    monotonic clock, seconds; now, where the source says no better.
    ``camera_time_ns`` is the camera's own clock, None if it has none.
    ``name`` tells the source (a file's path, a serial number and id).
    """

    image: npt.NDArray[np.uint8] | npt.NDArray[np.uint16]
    frame_id: int
    name: str
    exposure_us: float | None
    taken_at_s: float
    taken_s: float
    camera_time_ns: int | None = None


@dataclass(frozen=True, slots=True)
class CameraCapabilities:
    """Exposure range and step in microseconds; shape in pixels (None until known); trigger sources by SFNC name."""

    exposure_min_us: float
    exposure_max_us: float
    exposure_step_us: float
    width_px: int | None
    height_px: int | None
    triggers: tuple[str, ...] = ("Software",)


class Camera(Protocol):
    """A source of grey frames."""

    simulated: bool
    """True if what it shows is not the line in front of it (replayed or drawn)."""

    def open(self) -> None: ...
    def close(self) -> None: ...
    def capabilities(self) -> CameraCapabilities: ...
    def set_exposure_us(self, exposure_us: float) -> float:
        """Set the exposure; return it as read back. Raises OutOfRange outside the capabilities, nothing sent."""
        ...

    def grab(self) -> CameraFrame:
        """Take one new frame (never an old one). Raises NoReply after the deadline, DeviceGone, ReplyWrong."""
        ...


class AnalogueModule(Protocol):
    """An I/O module with analogue outputs, in volts; raw counts never leave the driver."""

    simulated: bool

    def open(self) -> None: ...
    def close(self) -> None: ...
    def write_volts(self, channel: int, volts: float) -> None:
        """Write one output. Raises OutOfRange outside the module's span, nothing sent."""
        ...

    def read_volts(self, channel: int) -> float:
        """Read one output back, volts."""
        ...

    def check_trip(self) -> None:
        """Raise WatchdogTripped if the module fell back to its safe value and ignores writes."""
        ...


class DigitalIO(Protocol):
    """An I/O module's digital points, by channel from 0; True is on, as the module sees it."""

    simulated: bool

    def open(self) -> None: ...
    def close(self) -> None: ...
    def read_inputs(self) -> tuple[bool, ...]:
        """Every digital input, read in one request; empty if the module has none."""
        ...

    def read_outputs(self) -> tuple[bool, ...]:
        """Every digital output as it stands; empty if the module has none."""
        ...

    def write_output(self, channel: int, on: bool) -> None:
        """Switch one output and read it back. Raises OutOfRange (nothing sent), WatchdogTripped, ReadBackWrong."""
        ...


class Lamp(Protocol):
    """A lamp with a 0-5 V level input."""

    simulated: bool

    def open(self) -> None: ...
    def close(self) -> None:
        """Leave the lamp at 0 V if it can be reached, then close. Never raises."""
        ...

    def set_volts(self, volts: float) -> float:
        """Set the level; return it as read back, volts.

        Raises OutOfRange above the 5.0 V clamp or below 0 (nothing sent), ReadBackWrong outside the tolerance.
        """
        ...

    def read_volts(self) -> float:
        """The level as the module reads it back, volts."""
        ...

    def keep_alive(self) -> None:
        """Ask something of the module, so that its watchdog sees that the station lives; to be called while it waits.

        Raises WatchdogTripped or ReadBackWrong if the level is no longer the one set.
        """
        ...

    def burnt_hours(self) -> float:
        """For how long the lamp has burnt in its life, hours, as far as this program lit it."""
        ...
