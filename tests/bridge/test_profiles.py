"""The module table: every row holds together, and counts never stand for more volts than were asked for."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_bridge.wire.modbus import Table
from firmware_bridge.wire.profiles import PROFILES, Point, Profile, ReadBack, Span, manual

rows = pytest.mark.parametrize("profile", PROFILES.values(), ids=PROFILES)
any_profile = st.sampled_from(list(PROFILES.values()))


@given(any_profile, st.floats(0, 1))
def test_counts_are_the_nearest_level_not_above(profile: Profile, share: float) -> None:
    span = profile.span
    volts = span.low_v + share * (span.high_v - span.low_v)
    reached_v = span.volts(span.counts(volts))
    assert volts - span.step_v < reached_v <= volts + 1e-5 * span.step_v


@given(any_profile, st.data())
def test_counts_survive_the_round_trip(profile: Profile, data: st.DataObject) -> None:
    counts = data.draw(st.integers(profile.span.counts_low, profile.span.counts_high))
    assert profile.span.counts(profile.span.volts(counts)) == counts


@given(any_profile, st.floats(allow_nan=True, allow_infinity=True))
def test_counts_are_clamped_to_the_span_whatever_comes(profile: Profile, volts: float) -> None:
    assert profile.span.counts_low <= profile.span.counts(volts) <= profile.span.counts_high


def test_an_unknown_level_is_the_lowest() -> None:
    assert Span(0.0, 10.0, 4095).counts(math.nan) == 0


@given(any_profile, st.data())
def test_read_back_registers_mean_the_level_written(profile: Profile, data: st.DataObject) -> None:
    counts = data.draw(st.integers(profile.span.counts_low, profile.span.counts_high))
    registers = profile.encode_read_back(counts)
    assert len(registers) == profile.read_back_holds.words
    assert profile.decode_read_back(registers) == pytest.approx(profile.span.volts(counts), abs=1e-5)


# The table of the makers' manuals, written down a second time: profile, output, volts, counts.
LEVELS = [
    ("adam-4024", Point(Table.HOLDING_REGISTERS, 0), 5.0, 3071),
    ("adam-4024", Point(Table.HOLDING_REGISTERS, 0), -10.0, 0),
    ("adam-4021", Point(Table.HOLDING_REGISTERS, 0), 10.0, 4095),
    ("tm-da1p1r1", Point(Table.HOLDING_REGISTERS, 32), 5.0, 5000),
    ("iologik-r1241", Point(Table.HOLDING_REGISTERS, 0x04A0), 5.0, 2047),
    ("iologik-e1241", Point(Table.HOLDING_REGISTERS, 0x0400), 5.0, 2047),
    ("waveshare-ao-8ch-b", Point(Table.HOLDING_REGISTERS, 0), 4.321, 4321),
    ("ato-4ch", Point(Table.HOLDING_REGISTERS, 0), 5.0, 4095),
]


@pytest.mark.parametrize(("name", "output", "volts", "counts"), LEVELS)
def test_levels_of_the_manuals(name: str, output: Point, volts: float, counts: int) -> None:
    assert PROFILES[name].output_of(0) == output
    assert PROFILES[name].span.counts(volts) == counts


def test_floats_are_read_back_high_word_first() -> None:
    profile = PROFILES["iologik-e1241"]
    assert profile.read_back_holds is ReadBack.FLOAT_V
    assert profile.decode_read_back([0x40A0, 0x0000]) == 5.0
    assert profile.read_back_of(2) == Point(Table.INPUT_REGISTERS, 4)


@pytest.mark.parametrize(("number", "table", "address", "text"), [
    (1, Table.COILS, 0, "00001"),
    (269, Table.COILS, 268, "00269"),
    (10033, Table.DISCRETE_INPUTS, 32, "10033"),
    (30065, Table.INPUT_REGISTERS, 64, "30065"),
    (40489, Table.HOLDING_REGISTERS, 488, "40489"),
])  # fmt: skip
def test_manual_addresses_are_one_based(number: int, table: Table, address: int, text: str) -> None:
    point = manual(number)
    assert point == Point(table, address)
    assert point.manual == text


@rows
def test_a_row_reaches_the_lamps_whole_range(profile: Profile) -> None:
    assert profile.span.low_v <= 0.0
    assert profile.span.high_v >= 5.0
    assert profile.span.step_v < 0.01
    assert profile.links
