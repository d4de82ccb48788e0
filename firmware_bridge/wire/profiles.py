"""The I/O modules this bridge knows, as data: a new module is a new row here and a test run.

Points are written as the makers' manuals write them (one-based 0xxxx, 1xxxx, 3xxxx, 4xxxx) or as addresses on the
wire (zero-based); both end as :class:`Point`, zero-based. What no manual confirmed is listed in ``unconfirmed``
with where it came from, so that a bench check changes one row.
"""

from __future__ import annotations

import enum
import struct
from dataclasses import dataclass

from firmware_bridge.wire.modbus import Table


class LinkKind(enum.StrEnum):
    """The lines a module can be reached over."""

    SERIAL = "serial"
    TCP = "tcp"


@dataclass(frozen=True, slots=True)
class Point:
    """One address of one Modbus table, zero-based as on the wire."""

    table: Table
    address: int

    def plus(self, offset: int) -> Point:
        """The point ``offset`` addresses further on."""
        return Point(self.table, self.address + offset)

    @property
    def manual(self) -> str:
        """The address as manuals write it: table digit and five-digit one-based number."""
        return f"{self.table.value}{self.address + 1:0{4 if self.address < 9999 else 5}d}"


@dataclass(frozen=True, slots=True)
class Bank:
    """Digital points that follow on from ``first``; 1 is on."""

    first: Point
    count: int

    @property
    def points(self) -> tuple[Point, ...]:
        """Every point, by its channel."""
        return tuple(self.first.plus(channel) for channel in range(self.count))


@dataclass(frozen=True, slots=True)
class Span:
    """Output volts against counts, a straight line from (counts_low, low_v) to (counts_high, high_v)."""

    low_v: float
    high_v: float
    counts_high: int
    counts_low: int = 0

    @property
    def step_v(self) -> float:
        """Volts of one count."""
        return (self.high_v - self.low_v) / (self.counts_high - self.counts_low)

    def counts(self, volts: float) -> int:
        """Counts for a level in volts, clamped to the span; rounded down, so that no output exceeds what was asked.

        A level that is a whole number of counts, but for the rounding of floats, gives that number. NaN gives
        counts_low: an unknown level is no reason to light a lamp.
        """
        if not volts >= self.low_v:
            return self.counts_low
        steps = (min(volts, self.high_v) - self.low_v) / self.step_v
        return self.counts_low + int(steps + 1e-6)

    def volts(self, counts: int) -> float:
        """Level in volts of a number of counts (not clamped: a module may report what it should not)."""
        return self.low_v + (counts - self.counts_low) * self.step_v


class ReadBack(enum.Enum):
    """What a module's read-back registers hold."""

    COUNTS = "counts"
    FLOAT_V = "two registers a channel, high word first: IEEE 754 single, volts"

    @property
    def words(self) -> int:
        """Registers a channel."""
        return 2 if self is ReadBack.FLOAT_V else 1


@dataclass(frozen=True, slots=True)
class Setup:
    """A point that must hold ``value`` (else counts mean other volts); ``writable``: the driver may put it right."""

    point: Point
    value: int
    meaning: str
    writable: bool
    per_channel: bool = False
    """True: ``point`` is the first channel's, the others' follow on."""


@dataclass(frozen=True, slots=True)
class Watchdog:
    """A module's host watchdog. Points are None where the module has none, or only by its maker's own tool.

    ``tripped`` is not 0 after a trip, when writes are ignored until ``clear`` is written with ``clear_value``
    (None: power must be cycled, or the maker's tool used). ``timeout_s_per_count`` scales ``timeout``.
    """

    tripped: Point
    clear: Point | None = None
    clear_value: int = 1
    enable: Point | None = None
    write_clears: Point | None = None
    """Holds 0: a trip lasts until it is cleared; 1: the next write to an output clears it, and nobody notices."""
    timeout: Point | None = None
    timeout_s_per_count: float = 0.1
    timeout_counts_max: int = 255
    per_channel: bool = False
    """True: ``tripped`` and ``clear`` are the first channel's, the others' follow on."""
    survives_power: bool = False
    """True: a trip is still there after the module's power was off and on again."""


@dataclass(frozen=True, slots=True)
class Profile:
    """One module: its first analogue output, how many follow, its scale, its read-back, its safety."""

    name: str
    model: str
    links: tuple[LinkKind, ...]
    channels: int
    output: Point
    span: Span
    read_back: Point
    read_back_holds: ReadBack = ReadBack.COUNTS
    setup: tuple[Setup, ...] = ()
    safe_value: Point | None = None
    """First channel's level after a trip, in counts; the others' follow on."""
    power_on_value: Point | None = None
    """First channel's level at power-on, in counts; the others' follow on."""
    watchdog: Watchdog | None = None
    digital_inputs: Bank | None = None
    digital_outputs: Bank | None = None
    if_silent: str = ""
    """Why a module that is wired right may not answer, and what to do; for errors."""
    unconfirmed: tuple[str, ...] = ()
    """What no manual at hand confirms, and what it rests on."""

    @property
    def has_serial(self) -> bool:
        """True if the module has a serial line (Modbus RTU); else it has TCP only."""
        return LinkKind.SERIAL in self.links

    def output_of(self, channel: int) -> Point:
        """Where a channel's level is written."""
        return self.output.plus(channel)

    def read_back_of(self, channel: int) -> Point:
        """Where a channel's level is read back."""
        return self.read_back.plus(channel * self.read_back_holds.words)

    def decode_read_back(self, registers: list[int]) -> float:
        """Volts from the read-back registers of one channel."""
        if self.read_back_holds is ReadBack.FLOAT_V:
            return float(struct.unpack(">f", struct.pack(">2H", *registers))[0])
        return self.span.volts(registers[0])

    def encode_read_back(self, counts: int) -> list[int]:
        """The read-back registers of one channel that stands at ``counts``."""
        if self.read_back_holds is ReadBack.FLOAT_V:
            return list(struct.unpack(">2H", struct.pack(">f", self.span.volts(counts))))
        return [counts]


def manual(number: int) -> Point:
    """The point that a manual calls ``number``: 40001 is the first holding register, 269 the coil 00269."""
    digit, one_based = divmod(number, 10000)
    return Point(Table(digit), one_based - 1)


def holding(address: int) -> Point:
    """A holding register by its address on the wire."""
    return Point(Table.HOLDING_REGISTERS, address)


_ADAM_SHIPS_IN_ASCII = (
    "an ADAM-4000 leaves its maker speaking ASCII: set protocol Modbus with Advantech's utility (switch on INIT, power "
    "off and on, set, switch back, power off and on)"
)

_ROWS = (
    Profile(
        name="adam-4024",
        model="Advantech ADAM-4024",
        links=(LinkKind.SERIAL,),
        channels=4,
        output=manual(40001),
        span=Span(-10.0, 10.0, 4095),
        read_back=manual(40001),
        setup=(Setup(manual(40201), 0x32, "type code 0x32: -10 to 10 V", writable=False, per_channel=True),),
        watchdog=Watchdog(tripped=manual(40216)),
        digital_inputs=Bank(manual(1), 4),
        if_silent=_ADAM_SHIPS_IN_ASCII,
        unconfirmed=(
            "counts 0-4095 over -10 to 10 V: by analogy with the maker's other 12-bit outputs",
            "40215 (safety enable) and 40216 (flag) are read-only in the ADAM-4000 manual, appendix G: "
            "the safety is set, and a trip cleared, with the maker's tool",
        ),
    ),
    Profile(
        name="adam-4021",
        model="Advantech ADAM-4021",
        links=(LinkKind.SERIAL,),
        channels=1,
        output=manual(40001),
        span=Span(0.0, 10.0, 4095),
        read_back=manual(40001),
        power_on_value=manual(40221),
        watchdog=Watchdog(tripped=manual(40216)),
        if_silent=_ADAM_SHIPS_IN_ASCII,
        unconfirmed=("the whole row: from integrators' notes; span 0-10 V is the factory's type code",),
    ),
    Profile(
        name="tm-da1p1r1",
        model="ICP DAS tM-DA1P1R1",
        links=(LinkKind.SERIAL,),
        channels=1,
        output=manual(40033),
        span=Span(0.0, 10.0, 10000),
        read_back=manual(30065),
        setup=(Setup(manual(269), 1, "data format: engineering units (millivolt)", writable=True),),
        safe_value=manual(40097),
        power_on_value=manual(40193),
        watchdog=Watchdog(
            tripped=manual(270),
            clear=manual(270),
            enable=manual(261),
            write_clears=manual(260),
            timeout=manual(40489),
            survives_power=True,
        ),
        digital_inputs=Bank(manual(33), 1),
        digital_outputs=Bank(manual(1), 1),
        if_silent="it may be set to the DCON protocol: choose Modbus RTU with ICP DAS' DCON Utility (coil 257 is 1)",
        unconfirmed=(
            "engineering units of 1 mV on the 0-10 V range: by analogy with the maker's M-7024",
            "every request feeds the watchdog: by analogy with the maker's M-7000 over Modbus",
        ),
    ),
    Profile(
        name="iologik-r1241",
        model="Moxa ioLogik R1241",
        links=(LinkKind.SERIAL,),
        channels=4,
        output=holding(0x04A0),
        span=Span(0.0, 10.0, 4095),
        read_back=holding(0x04A0),
        unconfirmed=("counts 0-4095 over 0-10 V: the converter's 12 bits", "the watchdog is set by the maker's tool"),
    ),
    Profile(
        name="iologik-e1241",
        model="Moxa ioLogik E1241",
        links=(LinkKind.TCP,),
        channels=4,
        output=holding(0x0400),
        span=Span(0.0, 10.0, 4095),
        read_back=Point(Table.INPUT_REGISTERS, 0x0000),
        read_back_holds=ReadBack.FLOAT_V,
        watchdog=Watchdog(tripped=Point(Table.COILS, 0x1010), clear=Point(Table.COILS, 0x1020), per_channel=True),
        unconfirmed=(
            "counts 0-4095 over 0-10 V: the converter's 12 bits",
            "floats at 0, 2, 4, 6, high word first: the manual of the E1200 series gives 0, 1, 2, 3 for two-word "
            "values, which would overlap, and names the high word first for the E1242",
        ),
    ),
    Profile(
        name="waveshare-ao-8ch-b",
        model="Waveshare Modbus RTU Analog Output 8CH (B)",
        links=(LinkKind.SERIAL,),
        channels=8,
        output=holding(0),
        span=Span(0.0, 10.0, 10000),
        read_back=holding(0),
    ),
    Profile(
        name="ato-4ch",
        model="ATO 4-channel analogue output",
        links=(LinkKind.SERIAL,),
        channels=4,
        output=holding(0),
        span=Span(0.0, 5.0, 4095),
        read_back=holding(0),
    ),
)

PROFILES = {profile.name: profile for profile in _ROWS}
"""Every known module by the name that settings use."""
