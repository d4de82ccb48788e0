"""Bytes of an image file -> grey frame: PNG, TIFF, BMP, PGM or .npy, of 8 or 16 bits, exactly as the camera gave it.

What is damaged, cut short, in colour or of another kind is refused: half a frame, or a frame turned grey by somebody
else, would be measured wrong without anyone knowing.
"""

from __future__ import annotations

import io
import math
import struct

import numpy as np
import numpy.typing as npt

from firmware_bridge import native

Image = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]

NPY = b"\x93NUMPY"
PNG = b"\x89PNG\r\n\x1a\n"
TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
KINDS = (PNG, *TIFF, b"BM", b"P2", b"P3", b"P5", b"P6", NPY)
"""First bytes of what is read. P3 and P6 (PPM) are here to be told that they are in colour."""
PNG_HEADER = struct.Struct(">IIBBBBB")
PLAIN_CHUNKS = {b"IHDR", b"IDAT", b"IEND"}
GREY_IN_ROWS = [0, 0, 0, 0]
"""Colour type grey, the one compression and set of filters that there are, not interlaced."""
MOST_PIXELS = 1 << 28
KINDS_TEXT = "PNG, TIFF, BMP, PGM or .npy"

_png_rows = native.function("firmware_bridge.wire._png", "png_rows", "piiip")


class ImageWrong(ValueError):
    """The bytes hold no grey frame: what is wrong, and what to do."""

    def __init__(self, problem: str, remedy: str) -> None:
        super().__init__(f"{problem}; {remedy}")


def decode(data: bytes) -> Image:
    """The frame (H, W), uint8 or uint16, native byte order, contiguous. Raises ImageWrong.

    The kind is told by the content. Values are not scaled: 12 bits in a 16-bit file stay 0 to 4095.
    """
    if not data:
        raise ImageWrong("is empty", "save the frame again")
    if not data.startswith(KINDS):
        raise ImageWrong("is no image that is read here", f"save the frame as {KINDS_TEXT}")
    return _grey(_array(data) if data.startswith(NPY) else _image(data))


def _array(data: bytes) -> npt.NDArray[np.generic]:
    """The array of a .npy file, seen in place: pickled objects are never unpacked, a false size takes no memory."""
    stream = io.BytesIO(data)
    try:
        version = np.lib.format.read_magic(stream)
        read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, by_columns, dtype = read_header(stream)
        if dtype.hasobject:
            raise ValueError("Python objects")
        flat = np.frombuffer(data, dtype, math.prod(shape), stream.tell())
        return flat.reshape(shape, order="F" if by_columns else "C")
    except (ValueError, SyntaxError) as error:
        problem = f"is damaged, cut short or holds no plain numbers ({str(error).splitlines()[0]})"
        raise ImageWrong(problem, "save the frame again with numpy.save, as uint8 or uint16") from error


def _image(data: bytes) -> npt.NDArray[np.generic]:
    """The image that OpenCV sees, channels and depth as stored."""
    damaged = ImageWrong("is damaged or cut short", "copy or save the frame again")
    if data.startswith(PNG):
        chunks = _png_chunks(data)
        if chunks is None:
            raise damaged
        if (plain := _plain_png(chunks)) is not None:
            return plain
    import cv2  # 0.1 s, which the service's start need not wait for

    # What is wrong is said by the exception; OpenCV 4 and 5 keep the switch of their own words in different places.
    set_log_level = getattr(cv2, "setLogLevel", None) or cv2.utils.logging.setLogLevel
    set_log_level(0)
    if data.startswith(b"P2"):
        data += b"\n"  # OpenCV wants a blank after the last number too, which the format does not
    try:
        whole, pages = cv2.imdecodemulti(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        raise damaged from None
    if not whole or not pages:
        raise damaged
    if len(pages) > 1:
        raise ImageWrong(f"holds {len(pages)} pages", "save each frame in a file of its own")
    return np.asarray(pages[0])


Chunks = list[tuple[bytes, memoryview]]
"""Kind and content of each chunk of a PNG file."""


def _png_chunks(data: bytes) -> Chunks | None:
    """The chunks up to the last, each with the right checksum, or None. Decoders differ in what they let pass."""
    from isal import isal_zlib  # several times as fast as zlib's own; needed for recorded frames only

    at, whole, chunks = len(PNG), memoryview(data), Chunks()
    while at + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, at)
        body, checksum = whole[at + 4 : at + 8 + length], whole[at + 8 + length : at + 12 + length]
        if len(checksum) < 4 or isal_zlib.crc32(body) != int.from_bytes(checksum, "big"):
            return None
        chunks.append((bytes(body[:4]), body[4:]))
        if chunks[-1][0] == b"IEND":
            return chunks
        at += 12 + length
    return None


def _plain_png(chunks: Chunks) -> npt.NDArray[np.generic] | None:
    """The image of a plain grey PNG file, in about half of OpenCV's time or less; None: it is of another kind, or wrong
    in a way that OpenCV is to tell."""
    kind, header = chunks[0]
    if kind != b"IHDR" or len(header) != PNG_HEADER.size or {kind for kind, _ in chunks} != PLAIN_CHUNKS:
        return None
    width, height, bits, *rest = PNG_HEADER.unpack(header)
    if bits not in (8, 16) or rest != GREY_IN_ROWS or not 0 < width * height <= MOST_PIXELS:
        return None
    depth, size = bits // 8, height * (1 + width * bits // 8)
    raw = _inflated(b"".join(body for kind, body in chunks if kind == b"IDAT"), size)
    if len(raw) != size:
        return None
    pixels = np.empty((height, width), f">u{depth}")
    done = _png_rows(raw, height, width, depth, native.out(pixels))
    return pixels if done == height else None


def _inflated(packed: bytes, size: int) -> bytes:
    """``size`` bytes of a zlib stream, or fewer where it has no more or is damaged."""
    from isal import isal_zlib

    try:
        return bytes(isal_zlib.decompressobj().decompress(packed, size))
    except isal_zlib.error:  # type: ignore[misc]  # its stub makes an instance of the class
        return b""


def _grey(image: npt.NDArray[np.generic]) -> Image:
    """The image if it is one grey frame of 8 or 16 bits."""
    shape = " x ".join(map(str, image.shape)) or "a single number"
    if image.size == 0:
        raise ImageWrong(f"has no pixels ({shape})", "save the frame again")
    if image.ndim == 3 and image.shape[2] <= 4:
        raise ImageWrong(
            f"is a colour image ({image.shape[2]} channels, or a palette)",
            "save the sensor's own grey values: a converted image measures wrong",
        )
    if image.ndim != 2:
        raise ImageWrong(f"is no image: its shape is {shape}", "save one frame, height x width")
    if image.dtype.kind != "u" or image.dtype.itemsize > 2:
        raise ImageWrong(f"has pixels of type {image.dtype}", "save the frame as 8 or 16 bits, unsigned")
    if image.dtype.itemsize == 1:
        return np.ascontiguousarray(image, dtype=np.uint8)
    return np.ascontiguousarray(image, dtype=np.uint16)
