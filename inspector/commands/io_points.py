"""An I/O module's points by the names a technician uses: ao0, di3, do0, trip."""

from __future__ import annotations

import enum
from collections.abc import Iterable
from dataclasses import dataclass

from firmware_bridge.drivers.modbus_module import ModbusModule
from firmware_bridge.errors import OutOfRange, ReadBackWrong, Refused, WatchdogTripped
from firmware_bridge.wire.lamp_curve import CLAMP_V
from firmware_bridge.wire.profiles import Bank, Point, Profile


class Kind(enum.Enum):
    """What a point is."""

    ANALOGUE_OUTPUT = "analogue output, V"
    DIGITAL_INPUT = "digital input"
    DIGITAL_OUTPUT = "digital output"
    TRIP = "watchdog's trip"


@dataclass(frozen=True, slots=True)
class IoPoint:
    """One point; ``address`` is where it is read, as manuals write it; ``most_v`` the highest level allowed."""

    name: str
    kind: Kind
    channel: int
    address: str
    note: str = ""
    most_v: float = 0.0


def points(profile: Profile, lamp_channel: int) -> dict[str, IoPoint]:
    """Every point of a module, by name, in the order to show them."""
    found = [_output(profile, channel, channel == lamp_channel) for channel in range(profile.channels)]
    found += _bank("di", Kind.DIGITAL_INPUT, profile.digital_inputs)
    found += _bank("do", Kind.DIGITAL_OUTPUT, profile.digital_outputs)
    if profile.watchdog:
        found.append(IoPoint("trip", Kind.TRIP, 0, profile.watchdog.tripped.manual))
    return {point.name: point for point in found}


def read(module: ModbusModule, wanted: Iterable[IoPoint]) -> dict[str, str]:
    """What the points hold, as texts by name; a point that the module refuses says so. Raises BridgeError."""
    return {point.name: _read(module, point) for point in wanted}


def check(point: IoPoint, value: str) -> None:
    """Refuse a value that the point does not take. Raises OutOfRange."""
    _parsed(point, value)


def write(module: ModbusModule, point: IoPoint, value: str, tolerance_v: float) -> None:
    """Set the point to a value that :func:`check` lets pass, and read it back. Raises BridgeError."""
    parsed = _parsed(point, value)
    if point.kind is Kind.ANALOGUE_OUTPUT:
        _write_volts(module, point, parsed, tolerance_v)
    elif point.kind is Kind.DIGITAL_OUTPUT:
        module.write_output(point.channel, bool(parsed))
    else:
        module.clear_trip()


def _write_volts(module: ModbusModule, point: IoPoint, volts: float, tolerance_v: float) -> None:
    module.write_volts(point.channel, volts)
    module.check_trip()  # what a tripped module reads back is its safe value
    read_back_v = module.read_volts(point.channel)
    if not abs(read_back_v - volts) <= tolerance_v:
        what = f"set to {volts:g} V, reads back {read_back_v:.3f} V"
        raise ReadBackWrong(point.name, what, "check range, profile and wiring")


_WORDS = {Kind.DIGITAL_OUTPUT: {"off": 0.0, "on": 1.0, "0": 0.0, "1": 1.0}, Kind.TRIP: {"clear": 0.0}}


def _parsed(point: IoPoint, value: str) -> float:
    if point.kind is Kind.ANALOGUE_OUTPUT:
        try:
            volts = float(value)
        except ValueError:
            volts = float("nan")
        if 0.0 <= volts <= point.most_v:
            return volts
        allowed = f"0 to {point.most_v:g} (volts)"
    else:
        words = _WORDS.get(point.kind, {})
        if value in words:
            return words[value]
        allowed = " or ".join(list(words)[:2]) or "nothing: it is an input"
    raise OutOfRange(point.name, f"{value} is not possible", f"allowed: {allowed}")


def _read(module: ModbusModule, point: IoPoint) -> str:
    try:
        match point.kind:
            case Kind.ANALOGUE_OUTPUT:
                return f"{module.read_volts(point.channel):.3f} V"
            case Kind.DIGITAL_INPUT:
                return _on_off(module.read_inputs()[point.channel])
            case Kind.DIGITAL_OUTPUT:
                return _on_off(module.read_outputs()[point.channel])
            case Kind.TRIP:
                module.check_trip()
                return "clear"
    except WatchdogTripped:
        return "TRIPPED"
    except Refused as error:
        return f"refused ({error.message})"


def _on_off(on: bool) -> str:
    return "on" if on else "off"


def _output(profile: Profile, channel: int, lamp: bool) -> IoPoint:
    note, most_v = ("the lamp's level", CLAMP_V) if lamp else ("", profile.span.high_v)
    return IoPoint(f"ao{channel}", Kind.ANALOGUE_OUTPUT, channel, profile.read_back_of(channel).manual, note, most_v)


def _bank(prefix: str, kind: Kind, bank: Bank | None) -> list[IoPoint]:
    listed: tuple[Point, ...] = bank.points if bank else ()
    return [IoPoint(f"{prefix}{channel}", kind, channel, point.manual) for channel, point in enumerate(listed)]
