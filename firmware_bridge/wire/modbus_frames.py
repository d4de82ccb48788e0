"""Byte streams with Modbus in them: the TCP and the RTU side of a :class:`~firmware_bridge.wire.modbus.Slave`.

Both sessions take bytes in pieces of any size and give back the bytes to send. Neither knows a socket, a port or
a clock. Sources: MODBUS Messaging on TCP/IP Implementation Guide V1.0b (MBAP header); MODBUS over Serial Line
V1.02 (RTU frames, CRC16, broadcast).
"""

from __future__ import annotations

import struct

from firmware_bridge.wire.modbus import MEI_DEVICE_IDENTIFICATION, Slave

_PREFIX = struct.Struct(">HHH")
"""Transaction, protocol (0), length of all that follows: unit and PDU."""
_MBAP = struct.Struct(">HHHB")
"""The same, and the unit."""
MIN_MBAP_LENGTH, MAX_MBAP_LENGTH = 2, 254

MAX_RTU_BYTES = 256
MIN_RTU_BYTES = 4
BROADCAST = 0


class TcpSession:
    """One Modbus TCP connection. ``broken`` says why the stream can no longer be followed: close the connection.

    ``may_write``: whether this client's writes are carried out.
    """

    def __init__(self, slave: Slave, *, may_write: bool = True) -> None:
        self._slave, self.may_write = slave, may_write
        self._pending = b""
        self.broken: str | None = None

    @property
    def unfinished(self) -> bool:
        """Whether a request has begun and not ended."""
        return bool(self._pending)

    def receive(self, data: bytes) -> bytes:
        """Answers, in order, to the requests that ``data`` completes. After ``broken`` nothing is answered."""
        if self.broken:
            return b""
        stream = self._pending + data if self._pending else data
        answers = []
        start, end = 0, len(stream)
        while end - start >= _PREFIX.size:
            transaction, protocol, length = _PREFIX.unpack_from(stream, start)
            if protocol or not MIN_MBAP_LENGTH <= length <= MAX_MBAP_LENGTH:
                self.broken = f"not Modbus TCP: protocol id {protocol}, length {length}"
                self._slave.counters.errors += 1
                start = end
                break
            following = start + _PREFIX.size + length
            if following > end:
                break
            unit = stream[start + _PREFIX.size]
            pdu = self._slave.answer(unit, stream[start + _MBAP.size : following], may_write=self.may_write)
            answers.append(_MBAP.pack(transaction, 0, len(pdu) + 1, unit) + pdu)
            start = following
        self._pending = stream[start:]
        return answers[0] if len(answers) == 1 else b"".join(answers)


class RtuSession:
    """One slave, or several, on a serial line, among others' traffic.

    A request's length follows from its function, so frames are found without timing; after garbage the stream is
    searched for the next whole frame. Call :meth:`silence` when the line has been quiet for 3.5 characters or
    more: what is unfinished then never will be.
    """

    def __init__(self, slave: Slave, *, may_write: bool = True) -> None:
        self._slave, self._may_write = slave, may_write
        self._buffer = bytearray()
        self._in_noise = False

    @property
    def unfinished(self) -> bool:
        """Whether something came that is no whole frame yet."""
        return bool(self._buffer)

    def receive(self, data: bytes) -> bytes:
        """Answers to the requests for our units that ``data`` completes; empty if there are none."""
        self._buffer += data
        answers = b""
        while self._buffer:
            size = self._frame_bytes()
            if size is None:
                break
            answers += self._take(size)
        return answers

    def silence(self) -> bytes:
        """Drop the unfinished frame, and answer any whole request that was hidden behind it."""
        answers = b""
        while self._buffer:
            answers += self._take(self._frame_bytes() or 0)
        self._in_noise = False
        return answers

    def _frame_bytes(self) -> int | None:
        """Size of the whole frame at the head; 0 if none can begin there; None if more bytes must tell."""
        buffer = self._buffer
        if len(buffer) < MIN_RTU_BYTES:
            return None
        unfinished = False
        for size in _possible_sizes(buffer, foreign=buffer[0] not in self._slave.models):
            if size > len(buffer):
                unfinished = True
            elif crc16(buffer[:size]) == 0:
                return size
        return None if unfinished else 0

    def _take(self, size: int) -> bytes:
        """Remove the frame at the head, or one byte if there is none; answer it if it is for us."""
        frame = bytes(self._buffer[:size])
        del self._buffer[: size or 1]
        if not frame:
            self._slave.counters.errors += not self._in_noise  # once for bytes in a row
            self._in_noise = True
            return b""
        self._in_noise = False
        unit, pdu = frame[0], frame[1:-2]
        if unit == BROADCAST:
            self._slave.broadcast(pdu, may_write=self._may_write)
            return b""
        if unit not in self._slave.models:
            self._slave.counters.overheard += 1
            return b""
        return rtu_frame(unit, self._slave.answer(unit, pdu, may_write=self._may_write))


def rtu_frame(unit: int, pdu: bytes) -> bytes:
    """Address, PDU and checksum, as sent on a serial line."""
    body = bytes((unit,)) + pdu
    return body + crc16(body).to_bytes(2, "little")


def rtu_answer(stream: bytes, unit: int, function: int) -> bytes:
    """The first whole frame in ``stream`` with which ``unit`` answers ``function``; empty if there is none (yet).

    What stands before it is skipped: RS-485 drivers that turn round often put a stray byte there.
    """
    for start in range(len(stream) - MIN_RTU_BYTES):
        rest = stream[start : start + MAX_RTU_BYTES]
        if rest[0] != unit or rest[1] & 0x7F != function:
            continue
        size = _answer_size(rest)
        if size <= len(rest) and crc16(rest[:size]) == 0:
            return rest[:size]
    return b""


def crc16(data: bytes | bytearray) -> int:
    """CRC-16/MODBUS: polynomial 0xA001 reflected, start 0xFFFF; 0 over a whole frame with its own checksum."""
    crc = 0xFFFF
    for byte in data:
        crc = (crc >> 8) ^ _CRC_TABLE[(crc ^ byte) & 0xFF]
    return crc


def _crc_entry(byte: int) -> int:
    for _ in range(8):
        byte = (byte >> 1) ^ (0xA001 if byte & 1 else 0)
    return byte


_CRC_TABLE = tuple(_crc_entry(byte) for byte in range(256))

# Where a frame's byte count stands (frame index), or how long the frame is: requests, then answers.
_REQUEST_COUNT_AT = {15: 6, 16: 6, 23: 10}
_REQUEST_BYTES = dict.fromkeys((1, 2, 3, 4, 5, 6), 8) | {22: 10}
_ANSWER_COUNT_AT = dict.fromkeys((1, 2, 3, 4, 23), 2)
_ANSWER_BYTES = dict.fromkeys((5, 6, 15, 16), 8) | {22: 10}
_EXCEPTION_BYTES = 5
_IDENTIFY_BYTES = 7


def _possible_sizes(buffer: bytearray, *, foreign: bool) -> tuple[int, ...]:
    """How long the frame at the head may be: as a request and, from a foreign unit, as an answer too.

    A function of unknown length may end wherever the bytes so far end, or later.
    """
    function = buffer[1]
    if function & 0x80:
        return (_EXCEPTION_BYTES,) if foreign else ()
    if function == 0x2B and buffer[2] == MEI_DEVICE_IDENTIFICATION and not foreign:
        return (_IDENTIFY_BYTES,)
    if function not in _REQUEST_BYTES and function not in _REQUEST_COUNT_AT:
        return (len(buffer), len(buffer) + 1) if len(buffer) < MAX_RTU_BYTES else ()
    request = _REQUEST_BYTES.get(function) or _counted_size(buffer, _REQUEST_COUNT_AT[function])
    if not foreign:
        return (request,)
    return request, _ANSWER_BYTES.get(function) or _counted_size(buffer, _ANSWER_COUNT_AT[function])


def _answer_size(frame: bytes) -> int:
    if frame[1] & 0x80:
        return _EXCEPTION_BYTES
    return _ANSWER_BYTES.get(frame[1]) or _counted_size(frame, _ANSWER_COUNT_AT[frame[1]])


def _counted_size(buffer: bytes | bytearray, count_at: int) -> int:
    """Size from the byte count at ``count_at``; one byte more than there is while the count has not come."""
    if count_at >= len(buffer):
        return len(buffer) + 1
    return min(count_at + 1 + buffer[count_at] + 2, MAX_RTU_BYTES)
