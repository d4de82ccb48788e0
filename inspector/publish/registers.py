"""The register map: one table from which the server's image, the decoder, the lists and the manual's page come.

Addresses are zero-based, as on the wire. The *result block* is one read of 125 registers at address 0; the *control
block*, which the PLC writes, is at 500; the *operator's block*, which the page for people writes, at 600; the *defect
list* begins at 1000, the *statistics* at 2000. All are packed from one :class:`~inspector.model.Snapshot` into one
:class:`Image`, which is swapped whole, so no reader can see half of it.

How numbers lie in registers: :mod:`inspector.publish.wire_fields`. A measured value that does not fit its register sets
the status bit SATURATED_VALUE.
"""

from __future__ import annotations

import enum
import math
import struct
from bisect import bisect_left
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from inspector.handshake import ControlBlock
from inspector.handshake_table import OPERATOR_CONTROL, Control
from inspector.model import Defect, PlcSide, Snapshot, State, Verdict
from inspector.publish.statistics_registers import STATISTICS_ADDRESS, STATISTICS_FIELDS, Shown, encode_statistics
from inspector.publish.wire_fields import EXACT_UNITS, TYPES, Field, Layout, Number, SourceT
from inspector.publish.wire_fields import WordOrder as WordOrder

MAP_VERSION = 1
"""Raised when a register's meaning or place changes; a new register in a gap does not raise it."""

REGISTER_BITS = 16
"""Bit b of register r is coil and discrete input number REGISTER_BITS * r + b."""
RESULT_ADDRESS, RESULT_WORDS = 0, 125
CONTROL_ADDRESS, CONTROL_WORDS = 500, 16
OPERATOR_ADDRESS, OPERATOR_WORDS = 600, 32
"""The first :data:`CONTROL_WORDS` of the operator's block are written, the others answer."""
WRITTEN = (CONTROL_ADDRESS, OPERATOR_ADDRESS)
"""Where each block of :data:`CONTROL_WORDS` begins that can be written."""
LIST_ADDRESS = 1000
BLOCK_DEFECTS = 12
LIST_DEFECTS = 64
DEFECT_WORDS = 5
FIRST_BLOCK_DEFECT = RESULT_WORDS - 1 - BLOCK_DEFECTS * DEFECT_WORDS
FIRST_LIST_DEFECT = 10
LIST_END = FIRST_LIST_DEFECT + LIST_DEFECTS * DEFECT_WORDS
LIST_WORDS = LIST_END + 1


class Status(enum.IntFlag):
    """The bits of the `status` register."""

    READY = 1 << 0
    RESULTS_VALID = 1 << 1
    FAULT = 1 << 2
    SIMULATED = 1 << 3
    LAMP_OK = 1 << 4
    CAMERA_OK = 1 << 5
    SATURATED_VALUE = 1 << 6
    DEFECTS_TRUNCATED = 1 << 7
    LIST_TRUNCATED = 1 << 8
    SETTINGS_REFUSED = 1 << 9
    LAMP_WEAK = 1 << 10
    STORE_DEGRADED = 1 << 11
    STORE_DAMAGED = 1 << 12
    CLOCK_UNSYNCHRONISED = 1 << 13


STATUS_MEANINGS = {
    Status.READY: "Inspecting, or will at once when asked to; no fault",
    Status.RESULTS_VALID: "There is a result and its verdict is PASS or FAIL",
    Status.FAULT: "fault_code is not 0",
    Status.SIMULATED: "Camera, lamp or module is simulated or replays a recording: never act on a real panel",
    Status.LAMP_OK: "The lamp reads back the level set",
    Status.CAMERA_OK: "The camera gives frames",
    Status.SATURATED_VALUE: "Some measured value is outside its register's range and stands at the range's end",
    Status.DEFECTS_TRUNCATED: "More defects than the result block shows: read the defect list",
    Status.LIST_TRUNCATED: "More defects than the defect list shows",
    Status.SETTINGS_REFUSED: "New settings were refused or taken back (503); inspection goes on with the old ones",
    Status.LAMP_WEAK: "The lamp is near the end of what its level may be raised by (203): change the bulb soon",
    Status.STORE_DEGRADED: "A result that is shown, or the next, may not be on the disk (601); inspection goes on",
    Status.STORE_DAMAGED: "The results' store was damaged, and a new one begun (602); until CLEAR_FAULT",
    Status.CLOCK_UNSYNCHRONISED: "Nothing is known to keep the station's clock right: its records' times may be wrong",
}


@dataclass(frozen=True, slots=True)
class Publication:
    """What register values are taken from. ``defects`` are the snapshot's, highest first."""

    snapshot: Snapshot
    now_s: float
    heartbeat: int
    defects: tuple[Defect, ...]
    saturated: bool = False
    """Some measured value of this publication does not fit its register."""


def _age_ms(p: Publication) -> Number:
    at_s = p.snapshot.result_at_s
    return None if at_s is None else max(0.0, p.now_s - at_s) * 1000


def _largest_height_um(p: Publication) -> Number:
    return p.defects[0].height_um if p.defects else 0.0


def _area_cm2(p: Publication) -> Number:
    return None if p.snapshot.extent is None else p.snapshot.extent.area_m2 * 1e4


def _status(p: Publication) -> Number:
    s = p.snapshot
    running = s.state in (State.READY, State.SINGLE_EXECUTION, State.CONTINUOUS_EXECUTION)
    bits = {
        Status.READY: running and not s.fault_code,
        Status.RESULTS_VALID: s.result_at_s is not None and s.verdict is not Verdict.NOT_INSPECTED,
        Status.FAULT: s.fault_code != 0,
        Status.SIMULATED: s.simulated,
        Status.LAMP_OK: s.lamp_ok,
        Status.CAMERA_OK: s.camera_ok,
        Status.SATURATED_VALUE: p.saturated,
        Status.DEFECTS_TRUNCATED: len(p.defects) > BLOCK_DEFECTS,
        Status.LIST_TRUNCATED: len(p.defects) > LIST_DEFECTS,
        Status.SETTINGS_REFUSED: s.settings_refused,
        Status.LAMP_WEAK: s.lamp_weak,
        Status.STORE_DEGRADED: s.store_degraded,
        Status.STORE_DAMAGED: s.store_damaged,
        Status.CLOCK_UNSYNCHRONISED: s.clock_unsynchronised,
    }
    return sum(bit for bit, is_set in bits.items() if is_set)


_F = Field[Publication]
SEQUENCE = "Rises by one with each result; 0 before the first, and again after 65535"
RESULT_FIELDS = (
    _F(0, "sequence", "u16", "id", SEQUENCE, lambda p: p.snapshot.sequence),
    _F(1, "map_version", "u16", "id", "Version of this register map", lambda p: MAP_VERSION),
    _F(2, "heartbeat", "u16", "tick", "Rises once a second while the station serves", lambda p: p.heartbeat),
    _F(3, "state", "u16", "code", "Station state, see States", lambda p: p.snapshot.state),
    _F(4, "status", "u16", "bits", "See Status bits", _status),
    _F(5, "fault_code", "u16", "code", "0 no fault, see Fault codes", lambda p: p.snapshot.fault_code),
    _F(6, "verdict", "u16", "code", "0 NOT_INSPECTED, 1 PASS, 2 FAIL", lambda p: p.snapshot.verdict),
    _F(7, "reasons", "u16", "bits", "Why, bits 0-15, see Reason bits", lambda p: p.snapshot.reasons),
    _F(8, "reasons_high", "u16", "bits", "Why, bits 16-31", lambda p: p.snapshot.reasons >> 16),
    _F(9, "defect_count", "u16", "count", "Defects found", lambda p: len(p.defects)),
    _F(10, "unpaired_count", "u16", "count", "Highlights left without a partner", lambda p: p.snapshot.unpaired_count),
    _F(11, "largest_height_um", "u16", "um", "Height of the highest defect; 0 if there is none", _largest_height_um),
    _F(12, "largest_height_um_f32", "f32", "um", "The same, not rounded", _largest_height_um),
    _F(14, "acquisition_id", "u32", "id", "The camera's frame number", lambda p: p.snapshot.acquisition_id),
    _F(16, "panel_id", "u32", "id", "The panel's number", lambda p: p.snapshot.panel_id),
    _F(18, "recipe_id", "u16", "id", "Recipe in use; with a held result, its own", lambda p: p.snapshot.recipe_id),
    _F(19, "handshake", "u16", "bits", "The station's answers, see Handshake bits", lambda p: p.snapshot.plc.answers),
    _F(20, "result_age_ms", "u32", "ms", "Time since the result was published", _age_ms),
    _F(22, "elapsed_us", "u32", "us", "Time the inspection of the frame took", lambda p: p.snapshot.elapsed_us),
    _F(24, "cycle_us", "u32", "us", "Time the cycle took, from lamp to result", lambda p: p.snapshot.cycle_us),
    _F(26, "panels_passed", "u32", "count", "Results PASS since start", lambda p: p.snapshot.panels_passed),
    _F(28, "panels_failed", "u32", "count", "Results FAIL since start", lambda p: p.snapshot.panels_failed),
    _F(30, "panels_not_inspected", "u32", "count", "Results NOT_INSPECTED", lambda p: p.snapshot.panels_not_inspected),
    _F(32, "missed_triggers", "u32", "count", "Triggers while not ready", lambda p: p.snapshot.missed_triggers),
    _F(34, "overruns", "u32", "count", "Results lost because nobody took them", lambda p: p.snapshot.overruns),
    _F(36, "lamp_set_mv", "u16", "mV", "Lamp level set", lambda p: p.snapshot.lamp_set_v * 1000),
    _F(37, "lamp_read_mv", "u16", "mV", "Lamp level read back", lambda p: p.snapshot.lamp_read_v * 1000),
    _F(38, "exposure_us", "u32", "us", "Exposure the frame was taken at", lambda p: p.snapshot.exposure_us),
    _F(40, "configuration_hash", "u32", "id", "Changes when any setting does", lambda p: p.snapshot.configuration_hash),
    _F(42, "sequence_u32", "u32", "id", "The sequence in 32 bits", lambda p: p.snapshot.sequence),
    _F(44, "late_triggers", "u32", "count", "Cycles begun late", lambda p: p.snapshot.late_triggers),
    _F(46, "results_waiting", "u16", "count", "In the FIFO, not yet shown", lambda p: p.snapshot.plc.results_waiting),
    _F(47, "command_echo", "u16", "code", "Command begun last", lambda p: p.snapshot.plc.command_echo),
    _F(48, "command_result", "u16", "code", "How it ended, see Commands", lambda p: p.snapshot.plc.command_result),
    _F(50, "recipe_hash", "u32", "id", "Changes when what the recipe says does", lambda p: p.snapshot.recipe_hash),
    _F(52, "panel_frames", "u16", "count", "Frames of the result's panel", lambda p: p.snapshot.panel_frames),
    _F(53, "panel_frames_so_far", "u16", "count", "Frames of the one under way", lambda p: p.snapshot.frames_so_far),
    _F(54, "panel_area_cm2", "u32", "cm2", "Of the result's panel seen, where it has several frames; else unknown",
       _area_cm2),
    _F(56, "store_waiting", "u16", "count", "Entries not yet on the disk", lambda p: p.snapshot.store_waiting),
    _F(58, "response_us", "u32", "us", "Time from the trigger of the last frame until the result was shown",
       lambda p: p.snapshot.response_us),
    _F(124, "sequence_end", "u16", "id", "Equals sequence; compare if read in pieces", lambda p: p.snapshot.sequence),
)  # fmt: skip

LIST_FIELDS = (
    _F(0, "list_sequence", "u16", "id", "Sequence of the result listed", lambda p: p.snapshot.sequence),
    _F(1, "list_defect_count", "u16", "count", "Defects listed", lambda p: min(len(p.defects), LIST_DEFECTS)),
    _F(LIST_END, "list_sequence_end", "u16", "id", "Equals list_sequence, or reread", lambda p: p.snapshot.sequence),
)  # fmt: skip

_C = Field[ControlBlock]
CONTROL_FIELDS = (
    _C(0, "control", "u16", "bits", "What is asked of the station, see Control bits", lambda c: c.bits),
    _C(1, "acknowledged_sequence", "u16", "id", "sequence of the result taken", lambda c: c.acknowledged_sequence),
    _C(2, "control_panel_id", "u32", "id", "Of the panel at TRIGGER or PANEL_START; 0: none", lambda c: c.panel_id),
    _C(4, "command", "u16", "code", "What EXECUTE carries out, see Commands", lambda c: c.command),
    _C(6, "command_argument", "u32", "id", "Its argument, as a recipe's id", lambda c: c.argument),
)  # fmt: skip

_O = Field[PlcSide]
_OPERATOR_ANSWERS = (
    _O(16, "operator_handshake", "u16", "bits", "COMMAND bits alone, see Handshake bits", lambda o: o.answers),
    _O(17, "operator_command_echo", "u16", "code", "Command begun last", lambda o: o.command_echo),
    _O(18, "operator_command_result", "u16", "code", "How it ended, see Commands", lambda o: o.command_result),
)  # fmt: skip

_D = Field[Defect]
DEFECT_FIELDS = (
    _D(0, "x_mm", "i16", "mm", "x on the panel", lambda d: d.x_mm, scale=0.01),
    _D(1, "y_mm", "i16", "mm", "y on the panel", lambda d: d.y_mm, scale=0.01),
    _D(2, "height_um", "u16", "um", "height; 65535 not measured", lambda d: d.height_um),
    _D(3, "height_sigma_um", "u16", "um", "standard uncertainty; 65535 unknown", lambda d: d.height_sigma_um),
    _D(4, "flags", "u16", "bits", "see Defect flags", lambda d: d.flags),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Register:
    """A row of the map as the integrator reads it; ``address`` is the wire's."""

    name: str
    address: int
    type: str
    words: int
    scale: float
    unit: str
    access: str
    meaning: str


def _row(field: Field[SourceT], offset: int, name: str, meaning: str, access: str = "R") -> Register:
    words = TYPES[field.type].words
    return Register(name, offset + field.address, field.type, words, field.scale, field.unit, access, meaning)


def _area_rows(
    offset: int, fields: Iterable[Field[Publication]], prefix: str, first: int, count: int
) -> list[Register]:
    rows = [_row(field, offset, field.name, field.meaning) for field in fields]
    for slot in range(count):
        at = offset + first + slot * DEFECT_WORDS
        rows += [_row(f, at, f"{prefix}_{slot + 1}_{f.name}", f"Defect {slot + 1}: {f.meaning}") for f in DEFECT_FIELDS]
    return sorted(rows, key=lambda row: row.address)


RESULT_REGISTERS = tuple(_area_rows(RESULT_ADDRESS, RESULT_FIELDS, "defect", FIRST_BLOCK_DEFECT, BLOCK_DEFECTS))
LIST_REGISTERS = tuple(_area_rows(LIST_ADDRESS, LIST_FIELDS, "list_defect", FIRST_LIST_DEFECT, LIST_DEFECTS))
_CONTROL_BITS = sum(bit.value for bit in Control)
_CONTROL_RESERVED = set(range(CONTROL_WORDS)) - {
    field.address + i for field in CONTROL_FIELDS for i in range(TYPES[field.type].words)
}
CONTROL_REGISTERS = tuple(_row(field, CONTROL_ADDRESS, field.name, field.meaning, "RW") for field in CONTROL_FIELDS)
OPERATOR_REGISTERS = (
    *(
        replace(
            row,
            name=f"operator_{row.name.removeprefix('command_')}",
            address=row.address + OPERATOR_ADDRESS - CONTROL_ADDRESS,
        )
        for row in CONTROL_REGISTERS
        if row.name in ("control", "command", "command_argument")
    ),
    *(_row(field, OPERATOR_ADDRESS, field.name, field.meaning) for field in _OPERATOR_ANSWERS),
)
"""Commands lie where the control block has them; what is left out there is reserved here."""
STATISTICS_REGISTERS = tuple(_row(field, STATISTICS_ADDRESS, field.name, field.meaning) for field in STATISTICS_FIELDS)
REGISTERS = RESULT_REGISTERS + CONTROL_REGISTERS + OPERATOR_REGISTERS + LIST_REGISTERS + STATISTICS_REGISTERS
"""Every register there is, by address. Words between them inside an area are reserved and read 0."""
_ADDRESSES = [row.address for row in REGISTERS]


@dataclass(frozen=True, slots=True)
class Image:
    """All areas of one publication: first address and bytes, big-endian registers."""

    areas: tuple[tuple[int, bytes], ...]


_RESULT_LAYOUT = Layout(RESULT_FIELDS, RESULT_WORDS)
_LIST_LAYOUT = Layout(LIST_FIELDS, LIST_WORDS)
_DEFECT_LAYOUT = Layout(DEFECT_FIELDS, DEFECT_WORDS)
_OPERATOR_LAYOUT = Layout(_OPERATOR_ANSWERS, OPERATOR_WORDS)


def _rank(defect: Defect) -> float:
    """Highest first; a seed without a height might be the highest."""
    return -math.inf if math.isnan(defect.height_um) else -defect.height_um


def encode_image(snapshot: Snapshot, now_s: float, heartbeat: int, word_order: WordOrder = "high_first") -> Image:
    """All areas of one snapshot. ``now_s`` is monotonic time, as ``snapshot.result_at_s``; never raises on values."""
    defects = tuple(sorted(snapshot.defects, key=_rank))
    source = Publication(snapshot, now_s, heartbeat, defects)
    overflow: list[str] = []
    rows = [_DEFECT_LAYOUT.pack(defect, word_order, overflow) for defect in defects[:LIST_DEFECTS]]
    listed = _LIST_LAYOUT.pack(source, word_order, overflow, b"".join(rows), FIRST_LIST_DEFECT)
    largest = b"".join(rows[:BLOCK_DEFECTS])
    block = _RESULT_LAYOUT.pack(source, word_order, overflow, largest, FIRST_BLOCK_DEFECT)
    if overflow:
        source = replace(source, saturated=True)
        block = _RESULT_LAYOUT.pack(source, word_order, overflow, largest, FIRST_BLOCK_DEFECT)
    control = (CONTROL_ADDRESS, _as_written(snapshot.plc))
    asked = _OPERATOR_LAYOUT.pack(snapshot.operator, word_order, overflow, _as_written(snapshot.operator))
    operator = (OPERATOR_ADDRESS, asked)
    shown = Shown(snapshot.statistics, snapshot.statistics_sequence, now_s)
    statistics = (STATISTICS_ADDRESS, encode_statistics(shown, word_order))
    return Image(((RESULT_ADDRESS, block), (LIST_ADDRESS, listed), control, operator, statistics))


def _as_written(side: PlcSide) -> bytes:
    """A block as it was written, read back."""
    return struct.pack(f">{CONTROL_WORDS}H", *side.control, *[0] * (CONTROL_WORDS - len(side.control)))


def encode(snapshot: Snapshot, now_s: float, heartbeat: int, word_order: WordOrder = "high_first") -> bytes:
    """The result block alone: 250 bytes, big-endian registers."""
    return encode_image(snapshot, now_s, heartbeat, word_order).areas[0][1]


def decode_control(words: Sequence[int], word_order: WordOrder = "high_first") -> ControlBlock:
    """The whole control block's words decoded. Raises ValueError for a bit or a reserved word that means nothing."""
    if words[0] & ~_CONTROL_BITS or any(words[i] for i in _CONTROL_RESERVED):
        raise ValueError("reserved bits and words of the control block are to be 0")
    rows = ((row, row.address - CONTROL_ADDRESS) for row in CONTROL_REGISTERS)
    numbers = (int(_value(row, words[at : at + row.words], word_order) or 0) for row, at in rows)
    bits, sequence, panel_id, command, argument = numbers
    return ControlBlock(Control(bits), sequence, panel_id, command, argument)


def decode_operator(words: Sequence[int], word_order: WordOrder = "high_first") -> ControlBlock:
    """The written words of the operator's block, as :func:`decode_control`; what belongs to panels and results means
    nothing there."""
    block = decode_control(words, word_order)
    if block.bits & ~OPERATOR_CONTROL or block.acknowledged_sequence or block.panel_id:
        raise ValueError("the operator's block has commands and CLEAR_FAULT alone")
    return block


def decode(
    words: Sequence[int], address: int = RESULT_ADDRESS, word_order: WordOrder = "high_first"
) -> dict[str, Number]:
    """Values by name of the registers that lie whole within ``words``, which were read at ``address``.

    In the units of the table; None where the register says there is no value.
    """
    end = address + len(words)
    first, last = bisect_left(_ADDRESSES, address), bisect_left(_ADDRESSES, end)
    return {
        row.name: _value(row, words[row.address - address :][: row.words], word_order)
        for row in REGISTERS[first:last]
        if row.address + row.words <= end
    }


def _value(row: Register, words: Sequence[int], order: WordOrder) -> Number:
    wire = TYPES[row.type]
    ordered = words if order == "high_first" else words[::-1]
    number = struct.unpack(">" + wire.format, struct.pack(f">{row.words}H", *ordered))[0]
    if row.unit not in EXACT_UNITS and (number == wire.nothing or math.isnan(number)):
        return None
    return number if row.scale == 1 else float(number * row.scale)
