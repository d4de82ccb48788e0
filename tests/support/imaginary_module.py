"""A module that nobody makes, as a row of the table and nothing else; importing this adds it.

It differs from every real one where the table lets it: scale, tables, addresses, channels, clear value, time's unit.
"""

from __future__ import annotations

from firmware_bridge.wire.modbus import Table
from firmware_bridge.wire.profiles import PROFILES, Bank, LinkKind, Point, Profile, Setup, Span, Watchdog, holding

NAME = "imaginary-3ao"

PROFILES[NAME] = Profile(
    name=NAME,
    model="Imaginary 3 AO",
    links=(LinkKind.SERIAL, LinkKind.TCP),
    channels=3,
    output=holding(0x0200),
    span=Span(-2.5, 7.5, 33000, counts_low=1000),
    read_back=Point(Table.INPUT_REGISTERS, 0x0100),
    setup=(Setup(holding(0x0300), 7, "range 7: -2.5 to 7.5 V", writable=True, per_channel=True),),
    safe_value=holding(0x0210),
    power_on_value=holding(0x0220),
    watchdog=Watchdog(
        tripped=Point(Table.DISCRETE_INPUTS, 0x0400),
        clear=Point(Table.COILS, 0x0500),
        enable=Point(Table.COILS, 0x0600),
        timeout=holding(0x0230),
        timeout_s_per_count=1.0,
        timeout_counts_max=60,
        per_channel=True,
    ),
    digital_inputs=Bank(Point(Table.DISCRETE_INPUTS, 0), 6),
    digital_outputs=Bank(Point(Table.COILS, 16), 2),
    if_silent="its switch stands at OFF",
    unconfirmed=("the whole row: nobody makes it",),
)
