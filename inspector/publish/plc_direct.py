"""Reads of registers answered in C (`_plc.c`), so that no poll waits for the interpreter; the rest comes to Python."""

from __future__ import annotations

import ctypes
import enum
from collections.abc import Iterable

from firmware_bridge import native
from firmware_bridge.wire.modbus import Counters
from inspector.publish.published_image import MODULE, PublishedImage

_bytes = native.function(MODULE, "plc_bytes", "")
_begin = native.function(MODULE, "plc_begin", "pp")
_wait = native.function(MODULE, "plc_wait", "pid")

DESCRIPTORS, RECEIVE_BYTES = 4096, 4096
_SEND_BYTES = RECEIVE_BYTES // 12 * 259


class Left(enum.IntEnum):
    """What there is to do for a descriptor."""

    NOTHING = 0
    READY = 1
    """Something happened; nothing was read."""
    RECEIVED = 2
    """Bytes came that were not answered; none: the other side has closed, or is gone."""
    UNSENT = 3
    """Answers, of which the rest was not taken."""


class _Shared(ctypes.Structure):
    """The caller's part of `Plc` in `_plc.c`."""

    _fields_ = (
        ("descriptor", ctypes.c_int64),
        ("size", ctypes.c_int64),
        ("requests", ctypes.c_int64),
        ("heard_s", ctypes.c_double * DESCRIPTORS),
        ("answered", ctypes.c_int64 * DESCRIPTORS),
        ("direct", ctypes.c_uint8 * DESCRIPTORS),
        ("unit", ctypes.c_uint8 * 256),
        ("received", ctypes.c_uint8 * RECEIVE_BYTES),
        ("unsent", ctypes.c_uint8 * _SEND_BYTES),
    )


_BYTES_AT = {Left.RECEIVED: _Shared.received.offset, Left.UNSENT: _Shared.unsent.offset}


class Direct:
    """Answers reads of what is published, for ``units``, and counts them. One thread waits."""

    def __init__(self, published: PublishedImage, units: Iterable[int], counters: Counters) -> None:
        self._memory, self._counters = ctypes.create_string_buffer(_bytes()), counters
        self._shared, self._bytes = _Shared.from_buffer(self._memory), memoryview(self._memory)
        for unit in units:
            self._shared.unit[unit] = 1
        self._published = published  # the C code reads its memory
        _begin(self._memory, published.memory)

    def watch(self, descriptor: int, direct: bool) -> None:
        """Whether this connection's reads are answered here."""
        if descriptor < DESCRIPTORS:
            self._shared.direct[descriptor] = direct

    def wait(self, epoll: int, seconds: float) -> tuple[Left, int, bytes]:
        """What is left to do, for which descriptor, and with which bytes. Nothing after ``seconds``."""
        left, shared = Left(_wait(self._memory, epoll, seconds)), self._shared
        self._counters.requests += shared.requests
        shared.requests, data = 0, b""
        if left in _BYTES_AT:
            at = _BYTES_AT[left]
            data = self._bytes[at : at + max(shared.size, 0)].tobytes()
        return left, shared.descriptor, data

    def take_activity(self, descriptor: int) -> tuple[int, float]:
        """Requests of this connection answered here since this was asked last, and when the last one was."""
        if descriptor >= DESCRIPTORS:
            return 0, 0.0
        answered: int = self._shared.answered[descriptor]
        heard_s: float = self._shared.heard_s[descriptor]
        self._shared.answered[descriptor] = 0
        return answered, heard_s
