"""What a station must say about its camera, its I/O module and its lamp. Types and ranges only: nothing is touched."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Annotated, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    PositiveFloat,
    ValidationInfo,
    WithJsonSchema,
    field_validator,
)

from firmware_bridge.wire import lamp_curve
from firmware_bridge.wire.profiles import PROFILES, Profile


class Strict(BaseModel):
    """Base of every settings model: unknown keys and silent conversions are errors; instances do not change."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, strict=True, allow_inf_nan=False, use_attribute_docstrings=True
    )


def _known_profile(name: str) -> str:
    if name not in PROFILES:
        raise ValueError(f"no such profile; known are {', '.join(PROFILES)}")
    return name


ProfileName = Annotated[str, AfterValidator(_known_profile), WithJsonSchema({"type": "string", "enum": list(PROFILES)})]


class SerialLink(Strict):
    """A serial line, opened exclusively; 8 data bits, as Modbus RTU needs."""

    kind: Literal["serial"]
    """A serial line."""
    port: str = Field(min_length=1)
    """The port's device file; /dev/serial/by-id/... keeps its name when the adapter is replugged."""
    baud: Literal[1200, 2400, 4800, 9600, 19200, 38400, 57600, 115200] = 9600
    """Bits per second."""
    parity: Literal["N", "E", "O"] = "N"
    """None, even or odd."""
    stop_bits: Literal[1, 2] = 1
    """Stop bits."""


class TcpLink(Strict):
    """A Modbus TCP connection, to the module itself or to a gateway before its serial line."""

    kind: Literal["tcp"]
    """A TCP connection."""
    host: str = Field(min_length=1)
    """Address or name of the module."""
    port: int = Field(502, ge=1, le=65535)
    """TCP port."""


class SimulatedLink(Strict):
    """No hardware: a simulator of the profile, started as a process behind a real pseudo-terminal or TCP port."""

    kind: Literal["simulated"]
    """A simulator that comes and goes with the service."""


ModuleLink = Annotated[SerialLink | TcpLink | SimulatedLink, Field(discriminator="kind")]


class ModuleSettings(Strict):
    """The I/O module that drives the lamp."""

    profile: ProfileName
    """Which module it is."""
    unit: int = Field(1, ge=1, le=247)
    """Modbus unit id (slave address)."""
    link: ModuleLink
    """How it is reached."""
    deadline_s: PositiveFloat = Field(0.5, le=10)
    """Every request is answered or given up within this time, seconds."""
    safe_v: float | None = Field(None, ge=0, le=lamp_curve.CLAMP_V)
    """Level that the lamp's output takes when the module's watchdog trips, volts; null: as the module was set up."""
    watchdog_s: PositiveFloat | None = None
    """The module goes to its safe level when nothing was asked of it for so long, seconds; null: as it was set up."""

    @property
    def profile_row(self) -> Profile:
        """The profile's row of the table."""
        return PROFILES[self.profile]

    @field_validator("link")
    @classmethod
    def _profile_has_link(cls, link: ModuleLink, info: ValidationInfo) -> ModuleLink:
        profile = _profile_of(info)
        if profile and link.kind == "serial" and not profile.has_serial:
            raise ValueError(f"{profile.name} has no serial line; use kind tcp")
        return link

    @field_validator("safe_v")
    @classmethod
    def _profile_has_safe_value(cls, safe_v: float | None, info: ValidationInfo) -> float | None:
        profile = _profile_of(info)
        if profile and safe_v is not None and profile.safe_value is None:
            raise ValueError(f"{profile.name} takes its safe value from its maker's tool only; use null")
        return safe_v

    @field_validator("watchdog_s")
    @classmethod
    def _profile_has_watchdog(cls, watchdog_s: float | None, info: ValidationInfo) -> float | None:
        profile = _profile_of(info)
        if profile is None or watchdog_s is None:
            return watchdog_s
        if profile.watchdog is None or profile.watchdog.timeout is None:
            raise ValueError(f"{profile.name} has no watchdog that can be set here; use null")
        step_s = profile.watchdog.timeout_s_per_count
        longest_s = step_s * profile.watchdog.timeout_counts_max
        if not step_s <= watchdog_s <= longest_s:
            raise ValueError(f"{profile.name} takes {step_s:g} to {longest_s:g} s")
        return watchdog_s


def _profile_of(info: ValidationInfo) -> Profile | None:
    """The profile validated before this field; None if it was refused itself."""
    return PROFILES.get(info.data.get("profile", ""))


Percent = Annotated[float, Field(ge=0, le=100)]
LevelVolts = Annotated[float, Field(ge=0, le=lamp_curve.CLAMP_V)]
CurvePoint = Annotated[tuple[Percent, LevelVolts], Field(strict=False)]


class LampSettings(Strict):
    """The lamp on the module's analogue output."""

    channel: int = Field(0, ge=0)
    """Analogue output of the module that the lamp's level input is wired to, counted from 0."""
    tolerance_v: float = Field(0.05, gt=0, le=1)
    """How far the level read back may be from the level set, volts."""
    curve: tuple[CurvePoint, ...] = Field(lamp_curve.LINEAR, strict=False, json_schema_extra={"minItems": 2})
    """Intensity in percent against level in volts, as pairs [percent, volts], both rising."""
    warm_up_s: float = Field(0.0, ge=0, le=3600)
    """Results count only after the lamp has been lit for so long, seconds."""

    def volts(self, percent: float) -> float:
        """Level in volts for an intensity in percent, never above the lamp's 5.0 V."""
        return lamp_curve.volts(self.curve, percent)

    def percent(self, volts: float) -> float:
        """Intensity in percent at a level in volts."""
        return lamp_curve.percent(self.curve, volts)

    @field_validator("curve")
    @classmethod
    def _curve_rises(cls, curve: tuple[CurvePoint, ...]) -> tuple[CurvePoint, ...]:
        if len(curve) < 2:
            raise ValueError("at least two pairs [percent, volts]")
        for (percent, level_v), (next_percent, next_level_v) in pairwise(curve):
            if next_percent <= percent or next_level_v <= level_v:
                raise ValueError("percent and volts must both rise from pair to pair")
        return curve


FramePath = Annotated[Path, Field(strict=False)]


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
    deadline_s: PositiveFloat = Field(5.0, le=3600, validate_default=True)
    """A frame must come within this time, seconds."""

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


CameraSettings = Annotated[ReplaySettings, Field(discriminator="kind")]
"""One of the cameras, told apart by ``kind``."""


def conflicts(module: ModuleSettings, lamp: LampSettings) -> list[tuple[str, object, str]]:
    """What does not fit together: (path below the station's settings, value, what is allowed). Touches nothing."""
    profile = module.profile_row
    found: list[tuple[str, object, str]] = []
    if lamp.channel >= profile.channels:
        found.append(("lamp.channel", lamp.channel, f"0 to {profile.channels - 1} on {profile.name}"))
    if lamp.tolerance_v < profile.span.step_v:
        found.append(("lamp.tolerance_v", lamp.tolerance_v, f"at least one count, {profile.span.step_v:.4f} V"))
    return found
