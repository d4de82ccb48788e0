"""What a module must hold before its outputs mean what the station thinks: one list of points and values. Pure."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from firmware_bridge.wire.profiles import Point, Profile, Watchdog


@dataclass(frozen=True, slots=True)
class Safety:
    """What a station asks of a module's outputs when the station is gone; None: as the module was set up before.

    ``safe_v`` stands after the watchdog tripped, ``power_on_v`` after the module's power was off and on, and the
    watchdog trips ``watchdog_s`` after the last request.
    """

    safe_v: float | None = None
    power_on_v: float | None = None
    watchdog_s: float | None = None


AS_SET_UP = Safety()
"""Nothing asked: the module keeps what it has."""


@dataclass(frozen=True, slots=True)
class Held:
    """A point, the value it must hold (None: whatever was set, for information), and whether a driver may write it."""

    point: Point
    value: int | None
    meaning: str
    writable: bool = True


def held(profile: Profile, channels: Sequence[int], safety: Safety) -> list[Held]:
    """What the profile's module must hold for these channels, in the order it is to be set.

    What decides the meaning of counts comes first. Of the watchdog the time comes before what switches it on:
    enabled earlier, it could trip on the time it had.
    """
    return [
        *_setup(profile, channels),
        *_levels(profile, profile.safe_value, channels, safety.safe_v, "safe value"),
        *_levels(profile, profile.power_on_value, channels, safety.power_on_v, "power-on value"),
        *(_watchdog(profile.watchdog, safety.watchdog_s) if profile.watchdog else ()),
    ]


def most_requests(profile: Profile, channels: Sequence[int], safety: Safety) -> int:
    """Requests that opening a module may take: each trip read, cleared and read again; each point that is to hold a
    value read, written and read back."""
    trips = len(trip_points(profile, channels))
    asked = sum(wanted.value is not None for wanted in held(profile, channels, safety))
    return 3 * (trips + asked)


def trip_points(profile: Profile, channels: Sequence[int]) -> list[Point]:
    """Where a trip can be read: one point for the module, or one for each channel; none if it has no watchdog."""
    watchdog = profile.watchdog
    return _points(watchdog.tripped, channels, watchdog.per_channel) if watchdog else []


def clear_points(profile: Profile, channels: Sequence[int]) -> list[Point]:
    """Where each of :func:`trip_points` is cleared; none if that needs the power or the maker's tool."""
    watchdog = profile.watchdog
    return _points(watchdog.clear, channels, watchdog.per_channel) if watchdog and watchdog.clear else []


def _points(first: Point, channels: Sequence[int], per_channel: bool) -> list[Point]:
    return [first.plus(channel) for channel in channels] if per_channel else [first]


def _setup(profile: Profile, channels: Sequence[int]) -> Iterator[Held]:
    for setup in profile.setup:
        for point in _points(setup.point, channels, setup.per_channel):
            yield Held(point, setup.value, setup.meaning, setup.writable)


def _levels(
    profile: Profile, first: Point | None, channels: Sequence[int], volts: float | None, meaning: str
) -> Iterator[Held]:
    if first is None:
        return
    counts = None if volts is None else profile.span.counts(volts)
    for channel in channels:
        yield Held(first.plus(channel), counts, f"{meaning}, output {channel}")


def _watchdog(watchdog: Watchdog, watchdog_s: float | None) -> Iterator[Held]:
    asked = watchdog_s is not None
    if watchdog.timeout:
        counts = max(1, round((watchdog_s or 0.0) / watchdog.timeout_s_per_count))
        yield Held(watchdog.timeout, counts if asked else None, "watchdog time")
    if watchdog.write_clears:
        yield Held(watchdog.write_clears, 0 if asked else None, "a trip lasts until it is cleared")
    if watchdog.enable:
        yield Held(watchdog.enable, 1 if asked else None, "watchdog on")
