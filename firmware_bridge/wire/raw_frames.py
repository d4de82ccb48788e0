"""Grey frames as plain bytes, as a frame grabber's device, a pipe or a file in shared memory gives them.

A frame is height x width pixels, row after row from the top, one byte each for 8 bits, two (low byte first) for 16;
10, 12 and 14 bits stand in 16. Before it, where the source has them, 32 bytes of header, low bytes first:

    0   4  b"CCDF"
    4   4  number of the frame, counted by the camera; one more for each frame it took
    8   2  width, pixels
    10  2  height, pixels
    12  2  bits: 8 or 16
    14  2  zero
    16  8  exposure, microseconds, IEEE double; NaN if not known
    24  8  time it was taken, Unix seconds, IEEE double; NaN if not known
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

MAGIC = b"CCDF"
_HEADER = struct.Struct("<4sI4H2d")


@dataclass(frozen=True, slots=True)
class RawFrame:
    """One frame: image (H, W) uint8 or uint16; the rest None where the source does not say."""

    image: npt.NDArray[np.uint8] | npt.NDArray[np.uint16]
    number: int | None = None
    exposure_us: float | None = None
    taken_at_s: float | None = None


@dataclass(frozen=True, slots=True)
class RawFormat:
    """Shape of a source's frames, and whether they have headers."""

    width_px: int
    height_px: int
    bits: int
    header: bool = False

    @property
    def frame_bytes(self) -> int:
        """Bytes from one frame to the next."""
        return self._header_bytes + self.width_px * self.height_px * self.bits // 8

    @property
    def _header_bytes(self) -> int:
        return _HEADER.size if self.header else 0

    def encode(self, frame: RawFrame) -> bytes:
        """A frame's bytes. Its image must have this shape."""
        pixels = frame.image.astype("<u2" if self.bits == 16 else "u1", copy=False).tobytes()
        if not self.header:
            return pixels
        times = (math.nan if value is None else value for value in (frame.exposure_us, frame.taken_at_s))
        return _HEADER.pack(MAGIC, frame.number or 0, self.width_px, self.height_px, self.bits, 0, *times) + pixels

    def decode(self, data: bytes) -> RawFrame:
        """The frame in exactly ``frame_bytes`` bytes, whose header was found to fit."""
        image = self._image(data[self._header_bytes :])
        if not self.header:
            return RawFrame(image)
        _, number, *_, exposure_us, taken_at_s = _HEADER.unpack_from(data)
        return RawFrame(image, number, _known(exposure_us), _known(taken_at_s))

    def _image(self, pixels: bytes) -> npt.NDArray[np.uint8] | npt.NDArray[np.uint16]:
        import numpy as np  # settings only ask for a frame's size

        shape = self.height_px, self.width_px
        if self.bits == 16:
            return np.frombuffer(pixels, "<u2").astype(np.uint16).reshape(shape)
        return np.frombuffer(pixels, np.uint8).copy().reshape(shape)

    def start(self, data: bytes | bytearray) -> int:
        """Where in these bytes a frame may begin; their length if nowhere."""
        if not self.header:
            return 0
        at = data.find(MAGIC)
        while at >= 0:
            head = data[at : at + _HEADER.size]
            if len(head) < _HEADER.size or self._fits(head):
                return at
            at = data.find(MAGIC, at + 1)
        # The magic itself may have come in part.
        return next((len(data) - n for n in range(len(MAGIC) - 1, 0, -1) if data.endswith(MAGIC[:n])), len(data))

    def _fits(self, head: bytes | bytearray) -> bool:
        _, _, width_px, height_px, bits, zero, *_ = _HEADER.unpack(head)
        return (width_px, height_px, bits, zero) == (self.width_px, self.height_px, self.bits, 0)


class FrameReader:
    """Bytes in any pieces -> frames. With headers, what is no frame is dropped and the next frame found again.

    ``pending_bytes`` is what has come of the next frame, ``dropped_bytes`` what was no frame's, since it was made.
    """

    def __init__(self, form: RawFormat) -> None:
        self._form = form
        self._data = bytearray()
        self.dropped_bytes = 0

    @property
    def pending_bytes(self) -> int:
        """Bytes of a frame that is not whole yet."""
        return len(self._data)

    def receive(self, data: bytes) -> list[RawFrame]:
        """The frames that these bytes complete."""
        self._data += data
        frames = []
        while self._whole():
            frames.append(self._form.decode(bytes(self._data[: self._form.frame_bytes])))
            del self._data[: self._form.frame_bytes]
        return frames

    def _whole(self) -> bool:
        noise = self._form.start(self._data)
        del self._data[:noise]
        self.dropped_bytes += noise
        return len(self._data) >= self._form.frame_bytes


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None
