"""The manual's page on I/O modules, from the profile table."""

from __future__ import annotations

from collections.abc import Iterable

from firmware_bridge.wire.profiles import PROFILES, Bank, Point, Profile, ReadBack

HEADINGS = ("profile", "module", "line", "analogue out", "scale", "read-back", "safe, power-on value", "watchdog",
            "digital in, out")  # fmt: skip


def markdown() -> str:
    """The page: one row a module, what must be set up, and what no manual at hand confirms."""
    return _PAGE.format(
        headings=" | ".join(HEADINGS),
        rule=" | ".join(["---"] * len(HEADINGS)),
        rows="\n".join("| " + " | ".join(row) + " |" for row in rows()),
        notes="\n".join(line for profile in PROFILES.values() for line in _notes(profile)),
    )


def rows() -> list[tuple[str, ...]]:
    """One tuple of texts a module, in the order of :data:`HEADINGS`."""
    return [
        (
            profile.name,
            profile.model,
            ", ".join({"serial": "RTU", "tcp": "TCP"}[link.value] for link in profile.links),
            _span_of(profile.output, profile.channels),
            _scale(profile),
            _read_back(profile),
            _first_points((("safe", profile.safe_value), ("power-on", profile.power_on_value))),
            _watchdog(profile),
            _digital(profile),
        )
        for profile in PROFILES.values()
    ]


def _span_of(first: Point, count: int) -> str:
    return first.manual if count == 1 else f"{first.manual}-{first.plus(count - 1).manual}"


def _scale(profile: Profile) -> str:
    span = profile.span
    return f"{span.counts_low}-{span.counts_high} = {span.low_v:g} to {span.high_v:g} V"


def _read_back(profile: Profile) -> str:
    words = profile.channels * profile.read_back_holds.words
    text = _span_of(profile.read_back, words)
    return f"{text}, floats" if profile.read_back_holds is ReadBack.FLOAT_V else text


def _first_points(named: Iterable[tuple[str, Point | None]]) -> str:
    return ", ".join(f"{name} {point.manual}" for name, point in named if point) or "by its own tool, if any"


def _watchdog(profile: Profile) -> str:
    watchdog = profile.watchdog
    if watchdog is None:
        return "none known"
    count = profile.channels if watchdog.per_channel else 1
    parts = [f"trip {_span_of(watchdog.tripped, count)}"]
    parts.append(f"clear {_span_of(watchdog.clear, count)}" if watchdog.clear else "cleared by the maker's tool")
    if watchdog.enable:
        parts.append(f"on {watchdog.enable.manual}")
    if watchdog.timeout:
        parts.append(f"time {watchdog.timeout.manual} x {watchdog.timeout_s_per_count:g} s")
    if watchdog.survives_power:
        parts.append("a trip survives power-off")
    return ", ".join(parts)


def _digital(profile: Profile) -> str:
    return f"{_bank(profile.digital_inputs)}, {_bank(profile.digital_outputs)}"


def _bank(bank: Bank | None) -> str:
    return _span_of(bank.first, bank.count) if bank else "-"


def _notes(profile: Profile) -> Iterable[str]:
    for setup in profile.setup:
        how = "set by the program" if setup.writable else "to be set with the maker's tool"
        yield f"- **{profile.name}**: {setup.point.manual} must hold {setup.value:#x} ({setup.meaning}), {how}."
    if profile.if_silent:
        yield f"- **{profile.name}**, no answer: {profile.if_silent}."
    for doubt in profile.unconfirmed:
        yield f"- **{profile.name}**, to be checked at the bench: {doubt}."


_PAGE = """\
# I/O modules

Made from `firmware_bridge/wire/profiles.py` by `inspector io profiles --format markdown`; a test fails when this page
is stale. A module that is not listed is a new row of that table and a run of `tests/bridge`.

Addresses are as manuals write them: table digit and one-based number. An RTU module can also be reached over TCP,
through a gateway. Levels are rounded down to the module's step, and nothing above 5.0 V ever goes to the lamp.

| {headings} |
| {rule} |
{rows}

## What to set up, what to know, what to check

{notes}

## Digital inputs

Inputs are asked for, again and again: a pulse that is shorter than the time between two looks leaves no trace, and
while a panel is inspected there is one look only. No manual at hand says that a module of the table counts or latches
pulses where Modbus could read them. Signals shorter than a cycle belong on the camera's own line, where none is missed.

## At the cabinet

    inspector io list  --config FILE            the module's points, without touching it
    inspector io read  --config FILE            every point, and whether the module is set up as the station needs
    inspector io watch --config FILE            every change, until Ctrl-C
    inspector io write --config FILE ao0 2.5    asks first; --yes does not ask
    inspector io write --config FILE trip clear

They refuse while the service has the module: two masters would read each other's answers.
"""
