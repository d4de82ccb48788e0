"""The registers as the PLC server serves them: the image, swapped whole, and the blocks that clients write."""

from __future__ import annotations

import logging
import struct
from collections.abc import Callable, Sequence

from firmware_bridge.wire.modbus import DeviceFailure, IllegalAddress, ModbusError, Table
from inspector.publish.registers import CONTROL_WORDS, WRITTEN, Image

log = logging.getLogger(__name__)

OnControl = Callable[[int, Sequence[int]], None]
"""Told of each write into the control block or the operator's: its first address and its words. It shows what it took,
before it returns, or refuses by raising a ModbusError. Called in any thread of the server."""


class ServedRegisters:
    """The image as a Modbus data model: holding registers mirror input registers; the blocks of control words can be
    written. Without ``on_control`` nothing can.
    """

    def __init__(self, on_control: OnControl | None = None) -> None:
        self._image = Image(())
        self._on_control = on_control

    def show(self, image: Image) -> None:
        """Serve this from now on."""
        self._image = image

    def read_registers(self, table: Table, address: int, count: int) -> bytes:
        """From one image, so never torn."""
        for first, data in self._image.areas:
            start = 2 * (address - first)
            end = start + 2 * count
            if start >= 0 and end <= len(data):
                return data[start:end]
        raise IllegalAddress

    def write_registers(self, address: int, data: bytes) -> None:
        """Into one block, whole."""
        words = struct.unpack(f">{len(data) // 2}H", data)
        room = CONTROL_WORDS - len(words)
        if self._on_control is None or not any(first <= address <= first + room for first in WRITTEN):
            raise IllegalAddress
        try:
            self._on_control(address, words)
        except ModbusError:
            raise
        except Exception as error:
            log.exception("a write of %d registers at %d met a fault", len(words), address)
            raise DeviceFailure from error

    def read_bits(self, table: Table, address: int, count: int) -> Sequence[bool]:
        """There are none."""
        raise IllegalAddress

    def write_bits(self, address: int, bits: Sequence[bool]) -> None:
        """There are none."""
        raise IllegalAddress
