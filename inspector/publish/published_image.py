"""The registers as they are published: one copy, that every client reads, in C (`_plc.c`) or through Python."""

from __future__ import annotations

import ctypes
import itertools

from firmware_bridge import native
from inspector.publish.registers import Image

MODULE = "inspector.publish._plc"
_bytes = native.function(MODULE, "plc_published_bytes", "")
_begin = native.function(MODULE, "plc_published_begin", "p")
_show = native.function(MODULE, "plc_show", "pipp")
_read = native.function(MODULE, "plc_read", "piip")


class PublishedImage:
    """The image shown last. It changes for all its readers at once; any thread may show and read."""

    def __init__(self) -> None:
        self.memory = ctypes.create_string_buffer(_bytes())
        """`Published` in `_plc.c`."""
        _begin(self.memory)

    def show(self, image: Image) -> None:
        """From now on this is read. Raises ValueError for more registers than there is room for."""
        spans = [(first, len(data) // 2) for first, data in image.areas]
        numbers = (ctypes.c_int64 * (2 * len(spans)))(*itertools.chain.from_iterable(spans))
        if _show(self.memory, len(spans), numbers, b"".join(data for _, data in image.areas)):
            raise ValueError(f"{len(spans)} areas of registers are more than the server has room for")

    def read(self, address: int, count: int) -> bytes | None:
        """Registers, big-endian, all from one image; None if they are not there, or not in one area."""
        data = ctypes.create_string_buffer(2 * count)
        return data.raw if _read(self.memory, address, count, data) else None
