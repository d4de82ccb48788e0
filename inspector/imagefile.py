"""A grey frame from a file: PNG, TIFF, BMP, PGM or .npy, of 8 or 16 bits, exactly as the camera gave it.

A file that is damaged, cut short, in colour or of another kind is refused in one sentence with its remedy: half a
frame, or a frame turned grey by somebody else, would be measured wrong without anyone knowing.
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import numpy.typing as npt

from inspector.model import Image

NPY = b"\x93NUMPY"
PNG = b"\x89PNG\r\n\x1a\n"
TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
KINDS = (PNG, *TIFF, b"BM", b"P2", b"P3", b"P5", b"P6", NPY)
"""First bytes of the files that are read. P3 and P6 (PPM) are here to be told that they are in colour."""
KINDS_TEXT = "PNG, TIFF, BMP, PGM or .npy"


class FrameUnreadable(Exception):
    """The file holds no grey frame. The message names the file, ``sentence`` the problem and the remedy."""

    def __init__(self, path: Path, problem: str, remedy: str) -> None:
        self.sentence = f"{problem}; {remedy}"
        super().__init__(f"{path}: {self.sentence}")


def read(path: Path) -> Image:
    """The frame (H, W) in the file, uint8 or uint16, native byte order, contiguous. Raises FrameUnreadable.

    The kind is told by the content, not by the name. Values are not scaled: 12 bits in a 16-bit file stay 0 to 4095.
    """
    data = _bytes(path)
    if not data.startswith(KINDS):
        raise FrameUnreadable(path, "is no image that is read here", f"save the frame as {KINDS_TEXT}")
    image = _numpy(path) if data.startswith(NPY) else _decode(path, data)
    return _grey(path, image)


def _bytes(path: Path) -> bytes:
    """The whole content; devices and pipes, which may never end, are not opened."""
    if path.is_dir():
        raise FrameUnreadable(path, "is a folder", "name the frames in it")
    try:
        if path.exists() and not path.is_file():
            raise FrameUnreadable(path, "is no ordinary file", f"save the frame as {KINDS_TEXT}")
        data = path.read_bytes()
    except FileNotFoundError:
        raise FrameUnreadable(path, "no such file", "check the path") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise FrameUnreadable(path, f"cannot be read ({reason})", "check its permissions and its disk") from error
    if not data:
        raise FrameUnreadable(path, "is empty", "save the frame again")
    return data


def _numpy(path: Path) -> npt.NDArray[np.generic]:
    """The array of a .npy file. Mapped first: a size that the file does not hold is refused before memory is taken,
    and pickled objects are never unpacked."""
    try:
        return np.array(np.load(path, mmap_mode="r", allow_pickle=False))
    except (ValueError, OSError, MemoryError, SyntaxError) as error:
        problem = f"is damaged, cut short or holds no plain numbers ({str(error).splitlines()[0]})"
        raise FrameUnreadable(path, problem, "save the frame again with numpy.save, as uint8 or uint16") from error


def _decode(path: Path, data: bytes) -> npt.NDArray[np.generic]:
    """The image that OpenCV sees, channels and depth as stored."""
    import cv2

    damaged = FrameUnreadable(path, "is damaged or cut short", "copy or save the frame again")
    if data.startswith(PNG) and not _png_is_whole(data):
        raise damaged
    # What is wrong is said by the exception; OpenCV 4 and 5 keep the switch of their own words in different places.
    set_log_level = getattr(cv2, "setLogLevel", None) or cv2.utils.logging.setLogLevel
    set_log_level(0)
    if data.startswith(b"P2"):
        data += b"\n"  # OpenCV wants a blank after the last number too, which the format does not
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        pages = cv2.imcount(str(path)) if data.startswith(TIFF) else 1
    except cv2.error:
        raise damaged from None
    if image is None:
        raise damaged
    if pages > 1:
        raise FrameUnreadable(path, f"holds {pages} pages", "save each frame in a file of its own")
    return np.asarray(image)


def _png_is_whole(data: bytes) -> bool:
    """Whether each chunk is there with the right checksum, up to the last. Decoders differ in what they let pass."""
    at = len(PNG)
    while at + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, at)
        body = memoryview(data)[at + 4 : at + 8 + length]
        checksum = data[at + 8 + length : at + 12 + length]
        if len(checksum) < 4 or zlib.crc32(body) != int.from_bytes(checksum, "big"):
            return False
        if bytes(body[:4]) == b"IEND":
            return True
        at += 12 + length
    return False


def _grey(path: Path, image: npt.NDArray[np.generic]) -> Image:
    """The image if it is one grey frame of 8 or 16 bits."""
    shape = " x ".join(map(str, image.shape)) or "a single number"
    if image.size == 0:
        raise FrameUnreadable(path, f"has no pixels ({shape})", "save the frame again")
    if image.ndim == 3 and image.shape[2] <= 4:
        raise FrameUnreadable(
            path,
            f"is a colour image ({image.shape[2]} channels, or a palette)",
            "save the sensor's own grey values: a converted image measures wrong",
        )
    if image.ndim != 2:
        raise FrameUnreadable(path, f"is no image: its shape is {shape}", "save one frame, height x width")
    if image.dtype.kind != "u" or image.dtype.itemsize > 2:
        raise FrameUnreadable(path, f"has pixels of type {image.dtype}", "save the frame as 8 or 16 bits, unsigned")
    if image.dtype.itemsize == 1:
        return np.ascontiguousarray(image, dtype=np.uint8)
    return np.ascontiguousarray(image, dtype=np.uint16)
