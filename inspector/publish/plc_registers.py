"""The registers as the PLC server serves them: the published image, and the blocks that clients write.

Coils and discrete inputs are the registers' bits: bit b of register r is number 16 * r + b, in both tables.
"""

from __future__ import annotations

import logging
import struct
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext

from firmware_bridge.wire.modbus import DeviceFailure, IllegalAddress, ModbusError, Table, pack_bits
from inspector.publish.published_image import PublishedImage
from inspector.publish.registers import CONTROL_WORDS, REGISTER_BITS, WRITTEN

log = logging.getLogger(__name__)

OnControl = Callable[[int, Sequence[int]], None]
"""Told of each write into the control block or the operator's: its first address and its words. It shows what it took,
before it returns, or refuses by raising a ModbusError. Called in any thread of the server."""


class ServedRegisters:
    """What is published as a Modbus data model: holding registers mirror input registers; the blocks of control words
    can be written. Without ``on_control`` nothing can. ``writing``: a lock that may be taken twice, held while bits are
    read and written back, and in each write; None: all
    writes come in one thread.
    """

    def __init__(
        self,
        published: PublishedImage,
        on_control: OnControl | None = None,
        writing: AbstractContextManager[object] | None = None,
    ) -> None:
        self._published, self._on_control = published, on_control
        self._writing = writing or nullcontext()

    def read_registers(self, table: Table, address: int, count: int) -> bytes:
        """From one image, so never torn."""
        data = self._published.read(address, count)
        if data is None:
            raise IllegalAddress
        return data

    def write_registers(self, address: int, data: bytes) -> None:
        """Into one block, whole."""
        words = struct.unpack(f">{len(data) // 2}H", data)
        room = CONTROL_WORDS - len(words)
        if self._on_control is None or not any(first <= address <= first + room for first in WRITTEN):
            raise IllegalAddress
        try:
            with self._writing:
                self._on_control(address, words)
        except ModbusError:
            raise
        except Exception as error:
            log.exception("a write of %d registers at %d met a fault", len(words), address)
            raise DeviceFailure from error

    def read_bits(self, table: Table, address: int, count: int) -> Sequence[bool]:
        """Of registers within one area, from one image."""
        first, skipped, words = _around(address, count)
        return _bits(self.read_registers(Table.HOLDING_REGISTERS, first, words))[skipped : skipped + count]

    def write_bits(self, address: int, bits: Sequence[bool]) -> None:
        """Into one block, whole; the other bits of its registers stay as they are."""
        first, skipped, words = _around(address, len(bits))
        with self._writing:
            all_bits = _bits(self.read_registers(Table.HOLDING_REGISTERS, first, words))
            all_bits[skipped : skipped + len(bits)] = bits
            packed = pack_bits(all_bits)
            self.write_registers(first, struct.pack(f">{words}H", *struct.unpack(f"<{words}H", packed)))


def _around(address: int, count: int) -> tuple[int, int, int]:
    """The registers that hold these bits: the first one, how many of its bits come before, and how many registers."""
    first, skipped = divmod(address, REGISTER_BITS)
    return first, skipped, -(-(skipped + count) // REGISTER_BITS)


def _bits(registers: bytes) -> list[bool]:
    words = struct.unpack(f">{len(registers) // 2}H", registers)
    return [bool(word >> bit & 1) for word in words for bit in range(REGISTER_BITS)]
