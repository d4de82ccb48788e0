"""Modbus slave without I/O: a request PDU in, the answer PDU out, right to the byte.

Source: MODBUS Application Protocol Specification V1.1b3. Function codes 1-6, 8 (what it counts), 15, 16, 22, 23 and
43/14. A PDU is the function code and its data, big-endian, without address, transaction or checksum: those belong to
:mod:`firmware_bridge.wire.modbus_frames`, which puts a :class:`Slave` behind a TCP or an RTU byte stream.

Addresses are zero-based, as on the wire. What lies at them is the business of a :class:`DataModel`.
"""

from __future__ import annotations

import contextlib
import enum
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Protocol

ADDRESS_SPACE = 0x10000
MAX_READ_BITS = 2000
MAX_WRITE_BITS = 1968
MAX_READ_REGISTERS = 125
MAX_WRITE_REGISTERS = 123
MAX_READ_WRITE_REGISTERS = 121
MAX_PDU_BYTES = 253
MAX_IDENTITY_BYTES = MAX_PDU_BYTES - 9
COIL_ON = 0xFF00
DIAGNOSTICS, ENCAPSULATED = 8, 0x2B
MEI_DEVICE_IDENTIFICATION = 0x0E
WRITE_FUNCTIONS = frozenset((5, 6, 15, 16, 22, 23))


class Table(enum.Enum):
    """The four primary tables; the value is the digit that manuals put before a one-based address."""

    COILS = 0
    DISCRETE_INPUTS = 1
    INPUT_REGISTERS = 3
    HOLDING_REGISTERS = 4


class ModbusError(Exception):
    """A slave's considered no: ``code`` is the exception code on the wire."""

    code: ClassVar[int] = 4


class IllegalFunction(ModbusError):
    """The slave does not have this function (exception 1)."""

    code = 1


class IllegalAddress(ModbusError):
    """Some address of the request does not exist, or does not take this access (exception 2)."""

    code = 2


class IllegalValue(ModbusError):
    """A count, a length or a value of the request is not allowed (exception 3)."""

    code = 3


class DeviceFailure(ModbusError):
    """The slave could not do what was asked of it (exception 4)."""

    code = 4


class DeviceBusy(ModbusError):
    """The slave is busy; the master may ask again later (exception 6)."""

    code = 6


class NoSuchUnit(ModbusError):
    """Nobody answers to this unit id here (exception 11, gateway target failed to respond)."""

    code = 11


class DataModel(Protocol):
    """What lies behind a unit's addresses. Counts are at least 1 and ``address + count`` at most 65536.

    Every method may raise any :class:`ModbusError`; a write either happens whole or raises with nothing written.
    """

    def read_registers(self, table: Table, address: int, count: int) -> bytes:
        """``2 * count`` bytes, each register big-endian."""
        ...

    def write_registers(self, address: int, data: bytes) -> None:
        """Write ``len(data) // 2`` holding registers."""
        ...

    def read_bits(self, table: Table, address: int, count: int) -> Sequence[bool]:
        """``count`` coils or discrete inputs."""
        ...

    def write_bits(self, address: int, bits: Sequence[bool]) -> None:
        """Write ``len(bits)`` coils."""
        ...


@dataclass(slots=True)
class Counters:
    """What happened since the start, or since a master cleared it (function 8, sub-function 10). They never wrap."""

    requests: int = 0
    """Messages for this slave, broadcasts among them."""
    overheard: int = 0
    """Whole messages on the line for others."""
    errors: int = 0
    """Stretches of the line that were no message: a wrong checksum, noise, a stream out of step."""
    unanswered: int = 0
    """Broadcasts: carried out, and not answered."""
    exceptions: dict[int, int] = field(default_factory=dict)
    """How often each exception code was answered."""

    def clear(self) -> None:
        """Begin anew."""
        self.requests = self.overheard = self.errors = self.unanswered = 0
        self.exceptions = {}


class Slave:
    """Answers requests for one or more unit ids, and counts in ``counters`` what it answered.

    ``models`` maps unit ids to what lies behind them (several ids may share one model). ``identity`` maps object
    ids (0 vendor name, 1 product code, 2 revision, ...) to ASCII text for function 43/14; without it that
    function is unknown. Raises ValueError for an identity that no answer can hold.
    """

    def __init__(self, models: Mapping[int, DataModel], identity: Mapping[int, str] | None = None) -> None:
        self.models = dict(models)
        self.counters = Counters()
        self._identity = {key: value.encode("ascii") for key, value in sorted((identity or {}).items())}
        if any(len(value) > MAX_IDENTITY_BYTES for value in self._identity.values()):
            raise ValueError(f"an identity's text has at most {MAX_IDENTITY_BYTES} characters")

    def answer(self, unit: int, pdu: bytes, *, may_write: bool = True) -> bytes:
        """The answer to one request PDU of at least one byte; an exception PDU if it is refused.

        Who may not write is told exception 1, "not an allowable action for the server": Modbus/TCP Security answers
        so to a role without the right, and 2 would send its reader to look for a wrong address.
        """
        function, counters = pdu[0], self.counters
        counters.requests += 1
        try:
            model = self.models.get(unit)
            if model is None:
                raise NoSuchUnit
            if function in WRITE_FUNCTIONS and not may_write:
                raise IllegalFunction
            if function == ENCAPSULATED:
                return _identify(self._identity, pdu)
            if function == DIAGNOSTICS:
                return _diagnose(counters, pdu, may_write)
            handler = _HANDLERS.get(function)
            if handler is None:
                raise IllegalFunction
            return handler(model, pdu)
        except ModbusError as error:
            counters.exceptions[error.code] = counters.exceptions.get(error.code, 0) + 1
            return bytes((function | 0x80, error.code))

    def broadcast(self, pdu: bytes, *, may_write: bool = True) -> None:
        """Carry out a write sent to every unit; nobody answers, and no refusal is told or counted."""
        self.counters.requests += 1
        self.counters.unanswered += 1
        if pdu[0] in WRITE_FUNCTIONS and may_write:
            for model in {id(model): model for model in self.models.values()}.values():
                with contextlib.suppress(ModbusError):
                    _HANDLERS[pdu[0]](model, pdu)


def pack_bits(bits: Sequence[bool]) -> bytes:
    """Bits to bytes, first bit lowest, padded with zeros."""
    return sum(1 << i for i, bit in enumerate(bits) if bit).to_bytes((len(bits) + 7) // 8, "little")


def unpack_bits(data: bytes, count: int) -> list[bool]:
    """The first ``count`` bits of ``data``, lowest first."""
    number = int.from_bytes(data, "little")
    return [bool(number >> i & 1) for i in range(count)]


def _fields(layout: struct.Struct, pdu: bytes) -> tuple[int, ...]:
    if len(pdu) != layout.size:
        raise IllegalValue
    return layout.unpack(pdu)


def _check_span(address: int, count: int, most: int) -> None:
    """Counts are judged before addresses, as in the specification's state diagrams."""
    if not 1 <= count <= most:
        raise IllegalValue
    if address + count > ADDRESS_SPACE:
        raise IllegalAddress


_TWO_WORDS = struct.Struct(">BHH")
_WRITE_MANY = struct.Struct(">BHHB")
_MASK_WRITE = struct.Struct(">BHHH")
_READ_WRITE = struct.Struct(">BHHHHB")


def _read_registers(model: DataModel, pdu: bytes) -> bytes:
    function, address, count = _fields(_TWO_WORDS, pdu)
    _check_span(address, count, MAX_READ_REGISTERS)
    table = Table.HOLDING_REGISTERS if function == 3 else Table.INPUT_REGISTERS
    return bytes((function, 2 * count)) + model.read_registers(table, address, count)


def _read_bits(model: DataModel, pdu: bytes) -> bytes:
    function, address, count = _fields(_TWO_WORDS, pdu)
    _check_span(address, count, MAX_READ_BITS)
    table = Table.COILS if function == 1 else Table.DISCRETE_INPUTS
    packed = pack_bits(model.read_bits(table, address, count))
    return bytes((function, len(packed))) + packed


def _write_coil(model: DataModel, pdu: bytes) -> bytes:
    _, address, value = _fields(_TWO_WORDS, pdu)
    if value not in (0, COIL_ON):
        raise IllegalValue
    model.write_bits(address, [value == COIL_ON])
    return pdu


def _write_register(model: DataModel, pdu: bytes) -> bytes:
    _, address, _ = _fields(_TWO_WORDS, pdu)
    model.write_registers(address, pdu[3:])
    return pdu


def _counted_data(layout: struct.Struct, pdu: bytes) -> tuple[tuple[int, ...], bytes]:
    """Fixed fields, the last of which counts the bytes of data that follow and end the PDU."""
    if len(pdu) < layout.size:
        raise IllegalValue
    fields = layout.unpack_from(pdu)
    data = pdu[layout.size :]
    if len(data) != fields[-1]:
        raise IllegalValue
    return fields, data


def _write_coils(model: DataModel, pdu: bytes) -> bytes:
    (_, address, count, size), data = _counted_data(_WRITE_MANY, pdu)
    if size != (count + 7) // 8:
        raise IllegalValue
    _check_span(address, count, MAX_WRITE_BITS)
    model.write_bits(address, unpack_bits(data, count))
    return pdu[:5]


def _write_registers(model: DataModel, pdu: bytes) -> bytes:
    (_, address, count, size), data = _counted_data(_WRITE_MANY, pdu)
    if size != 2 * count:
        raise IllegalValue
    _check_span(address, count, MAX_WRITE_REGISTERS)
    model.write_registers(address, data)
    return pdu[:5]


def _mask_write(model: DataModel, pdu: bytes) -> bytes:
    _, address, and_mask, or_mask = _fields(_MASK_WRITE, pdu)
    now = int.from_bytes(model.read_registers(Table.HOLDING_REGISTERS, address, 1), "big")
    masked = (now & and_mask) | (or_mask & ~and_mask & 0xFFFF)
    model.write_registers(address, masked.to_bytes(2, "big"))
    return pdu


def _read_write(model: DataModel, pdu: bytes) -> bytes:
    fields, data = _counted_data(_READ_WRITE, pdu)
    function, read_address, read_count, write_address, write_count, size = fields
    if size != 2 * write_count:
        raise IllegalValue
    _check_span(read_address, read_count, MAX_READ_REGISTERS)
    _check_span(write_address, write_count, MAX_READ_WRITE_REGISTERS)
    # Read once beforehand, so that a bad read address is refused with nothing written.
    model.read_registers(Table.HOLDING_REGISTERS, read_address, read_count)
    model.write_registers(write_address, data)
    return bytes((function, 2 * read_count)) + model.read_registers(Table.HOLDING_REGISTERS, read_address, read_count)


_HANDLERS: dict[int, Callable[[DataModel, bytes], bytes]] = {
    1: _read_bits,
    2: _read_bits,
    3: _read_registers,
    4: _read_registers,
    5: _write_coil,
    6: _write_register,
    15: _write_coils,
    16: _write_registers,
    22: _mask_write,
    23: _read_write,
}

_QUERY_DATA, _DIAGNOSTIC_REGISTER, _CLEAR_COUNTERS = 0, 2, 10
_COUNTS: dict[int, Callable[[Counters], int]] = {
    _DIAGNOSTIC_REGISTER: lambda counters: 0,
    11: lambda counters: counters.requests + counters.overheard,
    12: lambda counters: counters.errors,
    13: lambda counters: sum(counters.exceptions.values()),
    14: lambda counters: counters.requests,
    15: lambda counters: counters.unanswered,
    16: lambda counters: 0,  # nothing here answers exception 7
    17: lambda counters: counters.exceptions.get(DeviceBusy.code, 0),
    18: lambda counters: 0,  # a character overrun is the port's, which does not tell
}
"""What function 8 reads by sub-function: a number of 16 bits, which wraps."""


def _diagnose(counters: Counters, pdu: bytes, may_write: bool) -> bytes:
    """Function 8: the echo, and the counters. What would disturb the line (restart, listen only) is unknown."""
    if len(pdu) < 3:
        raise IllegalValue
    wanted = int.from_bytes(pdu[1:3], "big")
    if wanted == _QUERY_DATA:
        if len(pdu) < 5 or len(pdu) % 2 == 0 or len(pdu) > MAX_PDU_BYTES:
            raise IllegalValue
        return pdu
    if wanted not in _COUNTS and not (wanted == _CLEAR_COUNTERS and may_write):
        raise IllegalFunction
    if len(pdu) != 5 or pdu[3] or pdu[4]:
        raise IllegalValue
    if wanted == _CLEAR_COUNTERS:
        counters.clear()
        return pdu
    return pdu[:3] + (_COUNTS[wanted](counters) & 0xFFFF).to_bytes(2, "big")


_LAST_OBJECT_OF_STREAM = {1: 0x02, 2: 0x7F, 3: 0xFF}
"""Read-device-id code to the last object it covers: basic, regular, extended."""


def _identify(identity: Mapping[int, bytes], pdu: bytes) -> bytes:
    """Function 43/14, read device identification."""
    if not identity or len(pdu) < 2 or pdu[1] != MEI_DEVICE_IDENTIFICATION:
        raise IllegalFunction
    if len(pdu) != 4 or not 1 <= pdu[2] <= 4:
        raise IllegalValue
    code, first = pdu[2], pdu[3]
    if code == 4:
        if first not in identity:
            raise IllegalAddress
        wanted = [first]
    else:
        wanted = _stream(identity, code, first)
    return _identity_answer(identity, code, wanted)


def _stream(identity: Mapping[int, bytes], code: int, first: int) -> list[int]:
    """Objects of a stream access from ``first`` on; an unknown ``first`` starts over, as specified."""
    covered = [key for key in identity if key <= _LAST_OBJECT_OF_STREAM[code]]
    return [key for key in covered if key >= first] if first in covered else covered


def _identity_answer(identity: Mapping[int, bytes], code: int, wanted: Sequence[int]) -> bytes:
    """As many whole objects as fit; the rest are announced with the id to ask for next."""
    objects, taken = b"", 0
    for key in wanted:
        item = bytes((key, len(identity[key]))) + identity[key]
        if 7 + len(objects) + len(item) > MAX_PDU_BYTES:
            break
        objects, taken = objects + item, taken + 1
    more = taken < len(wanted)
    conformity = 0x81 if max(identity) <= 0x02 else 0x82 if max(identity) <= 0x7F else 0x83
    head = (0x2B, MEI_DEVICE_IDENTIFICATION, code, conformity, 0xFF if more else 0, wanted[taken] if more else 0, taken)
    return bytes(head) + objects
