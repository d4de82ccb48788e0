"""Bytes of a GenICam camera's image -> grey values, for the monochrome formats of up to 16 bits.

Names and codes are those of the Pixel Format Naming Convention (EMVA PFNC 2.4); the layouts named "Packed" are GigE
Vision's own. Values are not scaled: 12 bits stay 0 to 4095. Packing goes on over the ends of rows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from firmware_bridge.wire.image import Image, ImageWrong

Bytes = npt.NDArray[np.uint8]
Values = npt.NDArray[np.uint16]


@dataclass(frozen=True, slots=True)
class PixelFormat:
    """A row of the table: ``bits`` of a value; ``unpack`` turns whole groups of bytes into values, all at once."""

    name: str
    code: int
    bits: int
    group_bytes: int
    unpack: Callable[[Bytes], Bytes | Values]

    @property
    def bits_per_pixel(self) -> int:
        """Bits that a pixel takes on the wire; PFNC keeps them in bits 16 to 23 of the code."""
        return self.code >> 16 & 0xFF

    def size_bytes(self, width_px: int, height_px: int) -> int:
        """Bytes of an image."""
        return (width_px * height_px * self.bits_per_pixel + 7) // 8


def _plain(data: Bytes) -> Bytes:
    return data


def _little_endian(data: Bytes) -> Values:
    return data.view("<u2").astype(np.uint16)


def _groups(data: Bytes, size: int) -> list[Values]:
    """The first, second... byte of each group, widened for shifting."""
    return list(data.reshape(-1, size).T.astype(np.uint16))


def _gige_pairs(low_bits: int) -> Callable[[Bytes], Values]:
    """Two values in three bytes: the high eight bits of each in the outer ones, the low bits in the middle one."""
    mask = (1 << low_bits) - 1

    def unpack(data: Bytes) -> Values:
        first, low, second = _groups(data, 3)
        return np.stack([first << low_bits | low & mask, second << low_bits | low >> 4 & mask], axis=1)

    return unpack


def _mono12p(data: Bytes) -> Values:
    """Two values in three bytes, a stream of bits with the lowest first."""
    a, b, c = _groups(data, 3)
    return np.stack([a | (b & 0x0F) << 8, b >> 4 | c << 4], axis=1)


def _mono10p(data: Bytes) -> Values:
    """Four values in five bytes, a stream of bits with the lowest first."""
    a, b, c, d, e = _groups(data, 5)
    return np.stack([a | (b & 0x03) << 8, b >> 2 | (c & 0x0F) << 6, c >> 4 | (d & 0x3F) << 4, d >> 6 | e << 2], axis=1)


_ROWS = (
    PixelFormat("Mono8", 0x01080001, 8, 1, _plain),
    PixelFormat("Mono10", 0x01100003, 10, 2, _little_endian),
    PixelFormat("Mono10Packed", 0x010C0004, 10, 3, _gige_pairs(2)),
    PixelFormat("Mono10p", 0x010A0046, 10, 5, _mono10p),
    PixelFormat("Mono12", 0x01100005, 12, 2, _little_endian),
    PixelFormat("Mono12Packed", 0x010C0006, 12, 3, _gige_pairs(4)),
    PixelFormat("Mono12p", 0x010C0047, 12, 3, _mono12p),
)
FORMATS = {row.name: row for row in _ROWS}
"""The table, by PFNC name."""
_BY_CODE = {row.code: row for row in _ROWS}


def unpack(code: int, data: bytes | bytearray, width_px: int, height_px: int) -> Image:
    """The image (height, width), uint8 for Mono8 and uint16 otherwise, native byte order, writable, a copy.

    ``code`` is the PFNC code that came with it. Raises ImageWrong for other formats, or too few or too many bytes.
    """
    row = _BY_CODE.get(code)
    if row is None:
        raise ImageWrong(f"has pixel format {code:#010x}", f"set the camera to one of {', '.join(FORMATS)}")
    expected = row.size_bytes(width_px, height_px)
    if len(data) != expected:
        shape = f"{width_px} x {height_px} {row.name}"
        raise ImageWrong(f"holds {len(data)} bytes, not the {expected} of {shape}", "check the network and packet size")
    whole = np.zeros(-(-expected // row.group_bytes) * row.group_bytes, np.uint8)
    whole[:expected] = np.frombuffer(data, np.uint8)
    return row.unpack(whole).reshape(-1)[: width_px * height_px].reshape(height_px, width_px)
