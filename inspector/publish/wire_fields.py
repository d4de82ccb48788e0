"""How numbers lie in registers: types, fields, and areas packed from them in one step. Pure.

Numbers come in two kinds. *Exact* ones (ids, codes, bits, the sequence) are taken modulo their range. *Measured* ones
are divided by their scale and rounded; out of range they saturate and are named; None and NaN have an encoding of their
own (:class:`WireType`), so an absent value is never a small one.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, Literal, TypeVar

WordOrder = Literal["high_first", "low_first"]
Number = float | int | None
SourceT = TypeVar("SourceT")

EXACT_UNITS = ("id", "tick", "code", "bits")
"""Units of exact values; every other unit measures or counts."""


@dataclass(frozen=True, slots=True)
class WireType:
    """How a number lies in registers: ``struct`` format, range of measured values, and what stands for no value."""

    words: int
    format: str
    lowest: float
    highest: float
    nothing: float


LARGEST_F32 = 3.4028234663852886e38
TYPES = {
    "u16": WireType(1, "H", 0, 0xFFFE, 0xFFFF),
    "i16": WireType(1, "h", -0x7FFF, 0x7FFF, -0x8000),
    "u32": WireType(2, "I", 0, 0xFFFF_FFFE, 0xFFFF_FFFF),
    "f32": WireType(2, "f", -LARGEST_F32, LARGEST_F32, math.nan),
}


@dataclass(frozen=True)
class Field(Generic[SourceT]):
    """One register or pair of registers: where in its area, how, and what it tells.

    ``scale``: value = register * scale. Values in one of :data:`EXACT_UNITS` wrap, others saturate.
    """

    address: int
    name: str
    type: str
    unit: str
    meaning: str
    value: Callable[[SourceT], Number]
    scale: float = 1


class Layout(Generic[SourceT]):
    """Packs fields into an area of ``words`` registers in one step; gaps are zero."""

    def __init__(self, fields: Sequence[Field[SourceT]], words: int) -> None:
        self._fields = fields
        parts, position = [">"], 0
        for field in fields:
            wire = TYPES[field.type]
            parts += [f"{2 * (field.address - position)}x", wire.format]
            position = field.address + wire.words
        self._struct = struct.Struct("".join([*parts, f"{2 * (words - position)}x"]))
        self._doubles = [2 * f.address for f in fields if TYPES[f.type].words == 2]

    def pack(self, source: SourceT, order: WordOrder, overflow: list[str], filling: bytes = b"", at: int = 0) -> bytes:
        """The area's bytes, with ``filling`` laid in at word ``at``; names of saturated fields go to ``overflow``."""
        numbers = [wire_number(field, source, overflow) for field in self._fields]
        area = bytearray(self._struct.pack(*numbers))
        area[2 * at : 2 * at + len(filling)] = filling
        if order == "low_first":
            for byte in self._doubles:
                area[byte : byte + 4] = area[byte + 2 : byte + 4] + area[byte : byte + 2]
        return bytes(area)


def wire_number(field: Field[SourceT], source: SourceT, overflow: list[str]) -> float | int:
    """The number as it is packed: wrapped if exact, else scaled, rounded and saturated."""
    value, wire = field.value(source), TYPES[field.type]
    if field.unit in EXACT_UNITS:
        return int(value or 0) % (1 << 16 * wire.words)
    if value is None or math.isnan(value):
        return wire.nothing
    scaled = value / field.scale
    if not wire.lowest - 0.5 <= scaled < wire.highest + 0.5:
        overflow.append(field.name)
    within = min(max(scaled, wire.lowest), wire.highest)
    return within if field.type == "f32" else round(within)
