"""A Modbus master for one unit: table reads and writes, one hard deadline each, errors of the bridge's own tree."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING

from firmware_bridge.errors import DeviceGone, NoReply, Refused, ReplyWrong
from firmware_bridge.links.ports import Port, PortOpener
from firmware_bridge.wire.modbus import Table

if TYPE_CHECKING:
    from pymodbus.pdu import ModbusPDU

    from firmware_bridge.links.modbus_client import DeadlineClient

EXCEPTION_NAMES = {
    1: "illegal function",
    2: "illegal data address",
    3: "illegal data value",
    4: "device failure",
    5: "acknowledge, still working",
    6: "device busy",
    8: "memory parity error",
    10: "gateway path unavailable",
    11: "gateway target does not respond",
}
"""Exception codes of the MODBUS Application Protocol Specification V1.1b3, section 7."""


Timed = Callable[[float], None]
"""Is told how long something took, seconds; it must not wait."""


def untimed(_: float) -> None:
    """Nobody wants to know."""


class ModbusMaster:
    """Speaks to one unit over one port, which ``open_port`` opens. ``rtu``: RTU frames; else Modbus TCP.
    ``timed`` is told of each request, also of one that was not answered.

    Requests raise DeviceGone (port missing or closed), NoReply, ReplyWrong (damaged, another unit's or another
    request's) or Refused (a Modbus exception), all within ``deadline_s`` of the call on ``clock``. After the first
    two kinds, close and open again.
    """

    def __init__(
        self,
        device: str,
        unit: int,
        open_port: PortOpener,
        *,
        rtu: bool,
        deadline_s: float,
        clock: Callable[[], float] = time.monotonic,
        timed: Timed = untimed,
    ) -> None:
        self._device, self._unit, self._open_port, self._timed = device, unit, open_port, timed
        self._rtu, self._deadline_s, self._clock = rtu, deadline_s, clock
        self._port: Port | None = None
        self._client: DeadlineClient | None = None
        self._owed_until_s = clock()

    def open(self) -> None:
        """Open the port; an open one is closed first. Raises DeviceGone.

        An RTU answer does not say which request it answers: one that is still owed since the last time-out is
        waited out for ``deadline_s`` more, or a late "4 V" would be taken for what the module reads now.
        """
        from firmware_bridge.links.modbus_client import DeadlineClient  # pymodbus: 0.13 s that others need not wait

        self.close()
        self._port = self._open_port()
        self._client = DeadlineClient(
            self._device, self._port, rtu=self._rtu, deadline_s=self._deadline_s, clock=self._clock
        )
        if self._rtu:
            self._port.discard(self._owed_until_s - self._clock())

    def close(self) -> None:
        """Close the port; may be called twice, never raises."""
        if self._port:
            self._port.close()
        self._port = self._client = None

    def read(self, table: Table, address: int, count: int = 1) -> list[int]:
        """``count`` registers, or bits as 0 and 1, from ``address`` (zero-based) on."""
        with self._asking(f"reading {_where(table, address)}") as client:
            read = {
                Table.COILS: client.read_coils,
                Table.DISCRETE_INPUTS: client.read_discrete_inputs,
                Table.HOLDING_REGISTERS: client.read_holding_registers,
                Table.INPUT_REGISTERS: client.read_input_registers,
            }[table]
            reply = self._checked(read(address, count=count, device_id=self._unit), _READ_FUNCTION[table])
            values: Sequence[int]
            if table in (Table.COILS, Table.DISCRETE_INPUTS):
                values, expected = reply.bits, (count + 7) // 8 * 8  # bits come in whole bytes
            else:
                values, expected = reply.registers, count
            if len(values) != expected:
                raise self._wrong(f"{len(values)} values instead of {expected}")
            return [int(value) for value in values[:count]]

    def write(self, table: Table, address: int, value: int) -> None:
        """Write one coil (0 or 1) or one holding register, and check the echo."""
        with self._asking(f"writing {value} to {_where(table, address)}") as client:
            if table is Table.COILS:
                reply = self._checked(client.write_coil(address, bool(value), device_id=self._unit), 5)
                echo: Sequence[int] = (reply.address, *map(int, reply.bits[:1]))
            else:
                reply = self._checked(client.write_register(address, value, device_id=self._unit), 6)
                echo = (reply.address, *reply.registers[:1])
            if tuple(echo) != (address, value):
                raise self._wrong(f"the echo is of {tuple(echo)}, not of {(address, value)}")

    def write_many(self, address: int, values: Sequence[int]) -> None:
        """Write up to 123 holding registers in one request (function 16), and check what is answered."""
        with self._asking(f"writing {len(values)} holding registers from {address}") as client:
            reply = self._checked(client.write_registers(address, list(values), device_id=self._unit), 16)
            if (reply.address, reply.count) != (address, len(values)):
                raise self._wrong(f"the answer is of {reply.count} registers from {reply.address}")

    @contextlib.contextmanager
    def _asking(self, what: str) -> Iterator[DeadlineClient]:
        """One request: pymodbus' failures become ours, told apart by whether anything came."""
        from pymodbus.exceptions import ModbusException

        if self._client is None:
            raise DeviceGone(self._device, "not open", "open it first")
        began_s = self._clock()
        try:
            yield self._client
        except ModbusException as error:
            if self._client.received:
                raise self._wrong(f"{self._client.received} bytes that are no answer to {what}") from error
            self._owed_until_s = self._clock() + self._deadline_s
            raise NoReply(
                self._device,
                f"no answer in {self._deadline_s:g} s, {what} of unit {self._unit}",
                "check power, unit id, baud rate and wiring",
            ) from error
        finally:
            self._timed(self._clock() - began_s)

    def _checked(self, reply: ModbusPDU, function: int) -> ModbusPDU:
        """The reply, if it answers ``function``. Raises Refused for an exception, ReplyWrong for another's answer."""
        if reply.function_code & 0x7F != function:
            raise self._wrong(f"function {reply.function_code} answered, {function} asked")
        if reply.isError():
            code = reply.exception_code
            name = EXCEPTION_NAMES.get(code, "not in the specification")
            raise Refused(self._device, f"unit {self._unit} refused: exception {code}, {name}", "check the profile")
        return reply

    def _wrong(self, why: str) -> ReplyWrong:
        return ReplyWrong(self._device, f"wrong answer: {why}", "check unit ids, termination and shield")


_READ_FUNCTION = {
    Table.COILS: 1,
    Table.DISCRETE_INPUTS: 2,
    Table.HOLDING_REGISTERS: 3,
    Table.INPUT_REGISTERS: 4,
}


def _where(table: Table, address: int) -> str:
    return f"{table.name.lower().replace('_', ' ').removesuffix('s')} {address}"
