"""What a station must say about its I/O module and its lamp. Types and ranges only: nothing is touched."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    Field,
    PositiveFloat,
    ValidationInfo,
    WithJsonSchema,
    field_validator,
)

from firmware_bridge.strict import Strict
from firmware_bridge.wire import lamp_curve
from firmware_bridge.wire.module_setup import Safety, most_requests
from firmware_bridge.wire.profiles import PROFILES, Profile


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
    power_on_v: float | None = Field(None, ge=0, le=lamp_curve.CLAMP_V)
    """Level that the lamp's output takes when the module's power comes back, volts; null: as the module was set up."""
    watchdog_s: PositiveFloat | None = None
    """The module goes to its safe level when nothing was asked of it for so long, seconds; null: as it was set up."""

    @property
    def profile_row(self) -> Profile:
        """The profile's row of the table."""
        return PROFILES[self.profile]

    @property
    def safety(self) -> Safety:
        """What the module's outputs must do when the station is gone."""
        return Safety(self.safe_v, self.power_on_v, self.watchdog_s)

    @property
    def opening_s(self) -> float:
        """The longest that opening the module for one output may take, seconds: connecting, and every request."""
        return (1 + most_requests(self.profile_row, [0], self.safety)) * self.deadline_s

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

    @field_validator("power_on_v")
    @classmethod
    def _profile_has_power_on_value(cls, power_on_v: float | None, info: ValidationInfo) -> float | None:
        profile = _profile_of(info)
        if profile and power_on_v is not None and profile.power_on_value is None:
            raise ValueError(f"{profile.name} takes its power-on value from its maker's tool only; use null")
        return power_on_v

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


def _or_curve_file(schema: dict[str, Any]) -> None:
    """A measured curve stands in a file of its own: say so in the JSON schema."""
    pairs = {key: schema.pop(key) for key in ("type", "items")} | {"minItems": 2}
    schema["anyOf"] = [pairs, {"type": "string", "description": "File of the measured curve"}]


class LampSettings(Strict):
    """The lamp on the module's analogue output."""

    channel: int = Field(0, ge=0)
    """Analogue output of the module that the lamp's level input is wired to, counted from 0."""
    tolerance_v: float = Field(0.05, gt=0, le=1)
    """How far the level read back may be from the level set, volts."""
    curve: tuple[CurvePoint, ...] = Field(lamp_curve.LINEAR, strict=False, json_schema_extra=_or_curve_file)
    """Intensity in percent against level in volts, as pairs [percent, volts], both rising; in place, or the name of a
    file with measured samples."""
    warm_up_s: float = Field(0.0, ge=0, le=3600)
    """Results count only after the lamp has been lit for so long, seconds."""
    settle_s: float = Field(1.0, ge=0, le=60)
    """After a change of recipe that changes its level, results count only after this time, seconds."""
    hours_file: Annotated[Path, Field(strict=False)] | None = None
    """File in which the hours that the bulb has burnt are kept over restarts; null: they are not kept."""

    def under(self, folder: Path) -> LampSettings:
        """The same settings with relative paths taken from ``folder`` (the settings file's)."""
        return self.model_copy(update={"hours_file": folder / self.hours_file}) if self.hours_file else self

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


def conflicts(module: ModuleSettings, lamp: LampSettings) -> list[tuple[str, object, str]]:
    """What does not fit together: (path below the station's settings, value, what is allowed). Touches nothing."""
    profile = module.profile_row
    found: list[tuple[str, object, str]] = []
    if lamp.channel >= profile.channels:
        found.append(("lamp.channel", lamp.channel, f"0 to {profile.channels - 1} on {profile.name}"))
    if lamp.tolerance_v < profile.span.step_v:
        found.append(("lamp.tolerance_v", lamp.tolerance_v, f"at least one count, {profile.span.step_v:.4f} V"))
    return found
