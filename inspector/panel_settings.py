"""What makes a panel of frames, and how the panel travels past the camera. Frozen and strict, as recipes are."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field, PositiveFloat, PositiveInt

from firmware_bridge.strict import Strict
from inspector.recipe import Rectangle


class EachFrame(Strict):
    """Every frame is a panel."""

    kind: Literal["each"] = "each"
    """Every frame is a panel."""


class ByCount(Strict):
    """So many frames in a row are a panel. A frame that is missed or fails takes its place among them all the same."""

    kind: Literal["count"]
    """So many frames in a row are a panel."""
    count: PositiveInt
    """Frames of a panel."""


class ByInput(Strict):
    """The frames taken while an input of the I/O module is on are a panel, as from a light barrier across it."""

    kind: Literal["digital_input"]
    """An input of the I/O module says when a panel is in view."""
    channel: int = Field(1, ge=0)
    """Which input, counted from 0."""
    active: Literal["on", "off"] = "on"
    """What says that a panel is in view: the input on, or off."""
    debounce_s: float = Field(0.1, ge=0, le=10)
    """The panel ends when the input has been otherwise for this time, seconds; frames taken meanwhile are not of it."""
    poll_s: float = Field(0.02, gt=0, le=1)
    """It is read this often, seconds, while no frame is taken; and once with each frame, after its exposure."""


class ByPlcMarks(Strict):
    """The frames between PANEL_START and PANEL_END of the PLC's control block are a panel; a start ends it too."""

    kind: Literal["plc"]
    """The PLC says when a panel begins and ends."""


class ByLength(Strict):
    """The frames of so long a stretch are a panel; the next frame begins the next one, as on an endless web."""

    kind: Literal["length"]
    """A panel is so long."""
    length_mm: PositiveFloat
    """How far the panel travels until the next one begins, mm."""


class Pitch(Strict):
    """The panel moves as far from each trigger to the next, as when it is indexed, or moves while a clock triggers."""

    kind: Literal["pitch"]
    """As far from each trigger to the next."""
    mm_per_frame: float = Field(ge=0)
    """From one trigger to the next, mm; a missed one counts. 0: it stands still."""


class Encoder(Strict):
    """An encoder on the line triggers the camera, once in so many pulses."""

    kind: Literal["encoder"]
    """An encoder triggers the camera."""
    mm_per_pulse: PositiveFloat
    """How far the panel moves with each pulse, mm."""
    pulses_per_frame: PositiveInt
    """Pulses from one trigger to the next; a missed one counts."""

    @property
    def mm_per_frame(self) -> float:
        """From one trigger to the next, mm."""
        return self.mm_per_pulse * self.pulses_per_frame


class LineSpeed(Strict):
    """The line runs at a known speed; the time between exposures says how far the panel has moved."""

    kind: Literal["line_speed"]
    """The line's speed, and the time between exposures."""
    mm_per_s: PositiveFloat
    """The line's speed, mm/s."""


class Travel(Strict):
    """How the panel moves past the camera, on the panel's plane and without turning."""

    by: Annotated[Pitch | Encoder | LineSpeed, Field(discriminator="kind")]
    """What tells how far it has moved."""
    direction_deg: float = Field(0.0, ge=-360, le=360)
    """Where it moves to, degrees from the world's x axis towards its y axis."""
    sigma_mm: float = Field(0.1, ge=0)
    """Standard deviation of where the panel is in each frame, both along and across, mm: wobble, jitter of triggers."""
    sigma_share: float = Field(0.01, ge=0, lt=1)
    """Standard deviation of how far it has moved, as a share of it: how well speed or pitch are known."""

    @property
    def direction(self) -> tuple[float, float]:
        """Where it moves to, as a unit vector (x, y) of the world."""
        angle = math.radians(self.direction_deg)
        return math.cos(angle), math.sin(angle)

    def sigma_between_mm(self, moved_mm: float) -> float:
        """Standard deviation of the distance between two frames' places, ``moved_mm`` apart, mm."""
        return math.hypot(math.sqrt(2) * self.sigma_mm, self.sigma_share * moved_mm)


class SameSeed(Strict):
    """When two frames show the same seed: near enough to each other on the panel, and of the same height."""

    sigmas: float = Field(4.0, gt=0, le=10)
    """Places and heights may differ by so many of their standard deviations, the travel's included."""
    place_mm: float = Field(0.3, ge=0)
    """Places may differ by this besides, mm: what the calibration is off by over the field."""
    height_share: float = Field(0.05, ge=0, lt=1)
    """Heights may differ by this share of the higher one besides."""


class PanelSettings(Strict):
    """Which frames make a panel, how it travels, and when it has been seen whole."""

    frames: Annotated[EachFrame | ByCount | ByInput | ByPlcMarks | ByLength, Field(discriminator="kind")] = (
        EachFrame.default()
    )
    """What makes frames a panel."""
    travel: Travel | None = None
    """How the panel moves from frame to frame; needed wherever a panel has several frames."""
    area: Rectangle | None = None
    """Where the panel lies in its first frame, mm of the world: all of it must have been seen. null: not known, and
    frames must follow each other without a gap."""
    min_frames: PositiveInt = 1
    """A panel of fewer frames is not a PASS; where frames are counted, their count holds."""
    timeout_s: PositiveFloat = Field(30.0, le=3600)
    """A panel without a frame or its end for so long is ended, and is not a PASS, seconds."""
    same_seed: SameSeed = SameSeed.default()
    """When two frames show the same seed."""

    @property
    def several(self) -> bool:
        """Whether a panel may have several frames."""
        return not isinstance(self.frames, EachFrame)

    @property
    def needed(self) -> int:
        """Frames that a panel must have."""
        return self.frames.count if isinstance(self.frames, ByCount) else self.min_frames
