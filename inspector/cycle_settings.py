"""What begins a cycle, how near a frame must be to what was asked, and how failed devices are tried again."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, PositiveFloat

from firmware_bridge.strict import Strict


class FreeRunning(Strict):
    """A cycle begins when the one before it is done: the camera sets the pace."""

    kind: Literal["free_running"] = "free_running"
    """The camera sets the pace."""


class Timed(Strict):
    """A cycle begins at each tick of a clock."""

    kind: Literal["timed"]
    """A clock sets the pace."""
    rate_hz: float = Field(gt=0, le=1000)
    """Cycles a second."""


class DigitalInput(Strict):
    """A cycle begins when an input of the I/O module comes on, as from a light barrier at the station."""

    kind: Literal["digital_input"]
    """An input of the I/O module sets the pace."""
    channel: int = Field(0, ge=0)
    """Which input, counted from 0."""
    active: Literal["on", "off"] = "on"
    """What begins a cycle: the input coming on, or going off."""
    debounce_s: float = Field(0.02, ge=0, le=10)
    """The input must have stood so for this time, seconds."""
    poll_s: float = Field(0.01, gt=0, le=1)
    """It is read this often, seconds, as far as the module's line lets."""


class HardwareLine(Strict):
    """A cycle begins when the camera's own input line begins an exposure; the camera's settings name the line."""

    kind: Literal["hardware_line"]
    """A signal into the camera sets the pace."""


class ByHand(Strict):
    """A cycle begins at each SIGUSR1, as from `systemctl kill --signal=USR1 inspector`."""

    kind: Literal["by_hand"]
    """A person or a script sets the pace."""


class ByPlc(Strict):
    """A cycle begins when the PLC raises TRIGGER in the control block, and the station answers each."""

    kind: Literal["plc"]
    """The PLC sets the pace."""


class CycleSettings(Strict):
    """When a frame is taken, how near it must be to what was asked, and how failed devices are tried again."""

    trigger: Annotated[
        FreeRunning | Timed | DigitalInput | HardwareLine | ByHand | ByPlc, Field(discriminator="kind")
    ] = FreeRunning.default()
    """What begins a cycle; what comes while a cycle runs is counted as missed, and not made up for."""
    late_after_s: PositiveFloat = 0.05
    """A cycle that begins so long after its trigger is counted as late, seconds; it is inspected all the same."""
    exposure_tolerance: float = Field(0.01, ge=0, lt=1)
    """How far the exposure read back may be from the one asked for, as a share of it."""
    retry_first_s: float = Field(0.1, gt=0, le=60)
    """A failed device is tried again after this time, seconds; each further failure doubles it."""
    retry_longest_s: float = Field(2.0, gt=0, le=600)
    """The longest time between two tries, seconds."""
    rollback_after_s: float | None = Field(30.0, ge=1, le=3600)
    """After a reload, a station that was ready and is not again within this time goes back to the last good settings,
    seconds; null: never."""
