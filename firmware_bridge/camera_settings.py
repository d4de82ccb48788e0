"""What a station must say about its camera. Types and ranges only: nothing is touched."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, PositiveFloat, ValidationInfo, field_validator, model_validator

from firmware_bridge.strict import Strict
from firmware_bridge.wire.ccd_dialects import DIALECTS, Dialect
from firmware_bridge.wire.raw_frames import RawFormat

CameraFault = Literal[
    "gone",
    "silent",
    "damaged",
    "old",
    "ids back",
    "black",
    "saturated",
    "noise",
    "other size",
    "other exposure",
    "hangs",
]
"""What can go wrong with a frame. "hangs": the driver breaks its word and never returns; the watchdogs end that."""
NOMINAL_EXPOSURE_US = 1000.0
"""The exposure at which the brightness of what is drawn is told."""
SeedPlace = Annotated[tuple[float, float, Annotated[float, Field(gt=0)]], Field(strict=False)]
SpotPlace = Annotated[tuple[float, float, Annotated[float, Field(gt=0)]], Field(strict=False)]
FramePath = Annotated[Path, Field(strict=False)]


class FaultSettings(Strict):
    """Something that goes wrong with frames on request, to see what the station and its PLC make of it."""

    kind: CameraFault
    """What goes wrong."""
    after: int = Field(0, ge=0)
    """So many frames are right before."""
    count: int = Field(1, ge=1)
    """So many frames suffer it."""


Faults = Annotated[tuple[FaultSettings, ...], Field(strict=False)]


class ReplaySettings(Strict):
    """Recorded frames shown as if a camera took them."""

    kind: Literal["replay"]
    """Recorded frames."""
    paths: tuple[FramePath, ...] = Field(min_length=1, strict=False)
    """Image files (PNG, TIFF, BMP, PGM, npy) and folders of them, shown in this order, a folder's sorted by name."""
    rate_hz: float = Field(0.0, ge=0, le=1000)
    """Frames a second; 0: as fast as they are asked for."""
    loop: bool = True
    """True: start again after the last frame."""
    faults: Faults = ()
    """What goes wrong with its frames, and when."""
    deadline_s: PositiveFloat = Field(5.0, le=3600, validate_default=True)
    """A frame must come within this time, seconds."""

    @property
    def slowest_s(self) -> float:
        """The longest that any one thing asked of it may take, seconds."""
        return self.deadline_s

    @property
    def recordings(self) -> tuple[Path, ...]:
        """What must be there before frames can be shown."""
        return self.paths

    def under(self, folder: Path) -> ReplaySettings:
        """The same settings with relative paths taken from ``folder`` (the settings file's)."""
        return self.model_copy(update={"paths": tuple(folder / path for path in self.paths)})

    @field_validator("deadline_s")
    @classmethod
    def _deadline_spans_a_frame(cls, deadline_s: float, info: ValidationInfo) -> float:
        rate_hz = info.data.get("rate_hz", 0.0)
        if rate_hz and 1 / rate_hz >= deadline_s:
            raise ValueError(f"must be longer than the {1 / rate_hz:g} s between frames (1 / rate_hz)")
        return deadline_s


class _Frames(Strict):
    """Shape of a grey frame."""

    width_px: int = Field(640, ge=1, le=16384)
    """Pixels in a row."""
    height_px: int = Field(480, ge=1, le=16384)
    """Rows."""
    bits: Literal[8, 16] = 8
    """Bits of a pixel; 10, 12 and 14 stand in 16."""


class V4l2Frames(_Frames):
    """Frames of a Video4Linux device, in grey."""

    kind: Literal["v4l2"]
    """A Video4Linux device."""
    path: str = Field(min_length=1)
    """The device's file; /dev/v4l/by-id/... keeps its name when it is replugged."""

    @property
    def form(self) -> RawFormat:
        """What frames must be like."""
        return RawFormat(self.width_px, self.height_px, self.bits)


class RawFrames(_Frames):
    """Raw frames, row after row from the top, 16 bits low byte first."""

    kind: Literal["raw"]
    """Raw frames."""
    path: str = Field(min_length=1)
    """A frame grabber's device file or a named pipe, from which frames come one after another, or a file (in shared
    memory) that holds one and is written anew for each."""
    header: bool = False
    """True: each frame is preceded by 32 bytes with its number, shape, exposure and time; false: frames of a stream are
    told apart by the pauses between them."""

    @property
    def form(self) -> RawFormat:
        """What frames must be like."""
        return RawFormat(self.width_px, self.height_px, self.bits, self.header)


COMMANDS_IN_A_ROW = 3
"""Commands that a camera may be given in one thing that is asked of it: opening, an exposure, or a frame."""


class SerialCcdCameraSettings(Strict):
    """A CCD head that is set over a serial line; its frames come another way."""

    kind: Literal["serial_ccd"]
    """A CCD head on a serial line."""
    dialect: Literal["dalsa", "jai"]
    """What it speaks: DALSA's three-letter commands, or JAI's short ASCII commands."""
    port: str = Field(min_length=1)
    """The serial port's device file; /dev/serial/by-id/... keeps its name when the adapter is replugged."""
    baud: Literal[9600, 19200, 38400, 57600, 115200] = 9600
    """Bits per second; heads start at 9600."""
    frames: Annotated[V4l2Frames | RawFrames, Field(discriminator="kind")]
    """Where its frames come from."""
    trigger: Literal["Off", "Line0"] = "Off"
    """Off: the head runs freely, and a frame that begins after it is asked for is taken; Line0: a signal on the head's
    own input begins each exposure."""
    exposure_min_us: PositiveFloat | None = None
    """Shortest exposure of the head, microseconds; null: 1."""
    exposure_max_us: PositiveFloat | None = None
    """Longest exposure of the head, microseconds; null: 1 s."""
    us_per_count: PositiveFloat = 1.0
    """Microseconds in one count of its exposure: 1, or a line's time for JAI heads that count lines."""
    command_deadline_s: PositiveFloat = Field(0.5, le=10)
    """Every command is answered or given up within this time, seconds."""
    deadline_s: PositiveFloat = Field(5.0, le=3600)
    """A frame must come within this time, seconds; longer than three exposures, if the head runs freely."""

    @property
    def dialect_row(self) -> Dialect:
        """The dialect's row of the table."""
        return DIALECTS[self.dialect]

    @property
    def exposure_range_us(self) -> tuple[float, float]:
        """Shortest and longest exposure, microseconds."""
        row = self.dialect_row
        return self.exposure_min_us or row.exposure_min_us, self.exposure_max_us or row.exposure_max_us

    @property
    def slowest_s(self) -> float:
        """The longest that any one thing asked of it may take, seconds: a frame, or a row of commands."""
        return self.deadline_s + COMMANDS_IN_A_ROW * self.command_deadline_s

    @property
    def recordings(self) -> tuple[Path, ...]:
        """A live camera needs none."""
        return ()

    def under(self, folder: Path) -> SerialCcdCameraSettings:
        """The same: devices have names of their own, whatever the folder."""
        return self

    @model_validator(mode="after")
    def _range_is_one(self) -> Self:
        low_us, high_us = self.exposure_range_us
        if low_us >= high_us:
            raise ValueError(f"exposure_max_us must be more than exposure_min_us, {low_us:g}")
        return self


class RegionSettings(Strict):
    """Part of a sensor that is read out."""

    x_px: int = Field(0, ge=0)
    """First column (SFNC OffsetX)."""
    y_px: int = Field(0, ge=0)
    """First row (SFNC OffsetY)."""
    width_px: int = Field(ge=1)
    """Columns (SFNC Width)."""
    height_px: int = Field(ge=1)
    """Rows (SFNC Height)."""


class GenicamCameraSettings(Strict):
    """A GigE Vision or USB3 Vision camera; needs the system's package libaravis-0.8-0."""

    kind: Literal["genicam"]
    """A GenICam camera."""
    camera: str | None = Field(None, min_length=1)
    """Which one: its IP or MAC address, its id as `arv-tool-0.8` lists it, or its serial number, by which finding it
    takes 2 s more; null: the first one found."""
    pixel_format: Literal["Mono8", "Mono10", "Mono10Packed", "Mono10p", "Mono12", "Mono12Packed", "Mono12p"] = "Mono8"
    """Grey values and how they are packed, by PFNC name."""
    roi: RegionSettings | None = None
    """Part of the sensor that is read out; null: all of it. The calibration must be of the same part."""
    trigger: str = Field("Software", pattern=r"^(Software|Off|\w+\d+)$")
    """Software: each frame is asked for; Line0, Line1...: a signal on that input of the camera begins each exposure;
    Off: the camera runs freely, and the next frame that comes is taken."""
    gain_db: float | None = None
    """Gain in dB, or in the camera's own unit if it has no other; null: its lowest."""
    packet_size_bytes: int | None = Field(None, ge=576, le=16384)
    """Packets of GigE Vision, bytes; null: the largest that the network is found to let through."""
    command_deadline_s: PositiveFloat = Field(1.5, le=10)
    """Every command is answered within this time, or the camera is gone, seconds."""
    deadline_s: PositiveFloat = Field(5.0, ge=3, le=3600)
    """A frame must come within this time, seconds, and the camera must be found within it."""

    @property
    def slowest_s(self) -> float:
        """The longest that any one thing asked of it may take, seconds: a frame, or a row of commands."""
        return self.deadline_s + COMMANDS_IN_A_ROW * self.command_deadline_s

    @property
    def recordings(self) -> tuple[Path, ...]:
        """A live camera needs none."""
        return ()

    def under(self, folder: Path) -> GenicamCameraSettings:
        """The same: devices have names of their own, whatever the folder."""
        return self


class SimulatedCameraSettings(_Frames):
    """A camera that draws what the settings would show: nothing of the line is seen."""

    kind: Literal["simulated"]
    """A drawn scene."""
    seeds: tuple[SeedPlace, ...] = Field((), strict=False)
    """Seeds that rest on the panel, as [x_mm, y_mm, height_um]; the calibration says where their highlights are."""
    spots: tuple[SpotPlace, ...] = Field((), strict=False)
    """Further spots of light, as [x_px, y_px, peak], the peak as a share of full scale at 1000 us and 100 %."""
    panel_share: float = Field(0.04, ge=0, le=1)
    """What the panel shows of full scale at 1000 us and 100 %."""
    seed_share: float = Field(2.0, gt=0, le=100)
    """Peak of the brighter highlight of a seed 2 mm high at 1000 us and 100 %, as a share of full scale: beyond 1 the
    sensor is full."""
    noise_share: float = Field(0.004, ge=0, le=0.1)
    """Standard deviation of the noise, as a share of full scale."""
    rate_hz: float = Field(10.0, gt=0, le=1000)
    """Frames a second."""
    deadline_s: PositiveFloat = Field(5.0, le=3600)
    """A frame must come within this time, seconds."""
    faults: Faults = ()
    """What goes wrong with its frames, and when."""

    @property
    def slowest_s(self) -> float:
        """The longest that any one thing asked of it may take, seconds."""
        return self.deadline_s

    @property
    def recordings(self) -> tuple[Path, ...]:
        """It needs none."""
        return ()

    def under(self, folder: Path) -> SimulatedCameraSettings:
        """The same: it has no paths."""
        return self


CameraSettings = Annotated[
    ReplaySettings | SerialCcdCameraSettings | GenicamCameraSettings | SimulatedCameraSettings,
    Field(discriminator="kind"),
]
"""One of the cameras, told apart by ``kind``."""
