"""The registers as the PLC server serves them: the published image, and the blocks that clients write."""

from __future__ import annotations

import logging
import struct
from collections.abc import Callable, Sequence

from firmware_bridge.wire.modbus import DeviceFailure, IllegalAddress, ModbusError, Table
from inspector.publish.published_image import PublishedImage
from inspector.publish.registers import CONTROL_WORDS, WRITTEN

log = logging.getLogger(__name__)

OnControl = Callable[[int, Sequence[int]], None]
"""Told of each write into the control block or the operator's: its first address and its words. It shows what it took,
before it returns, or refuses by raising a ModbusError. Called in any thread of the server."""


class ServedRegisters:
    """What is published as a Modbus data model: holding registers mirror input registers; the blocks of control words
    can be written. Without ``on_control`` nothing can.
    """

    def __init__(self, published: PublishedImage, on_control: OnControl | None = None) -> None:
        self._published, self._on_control = published, on_control

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
