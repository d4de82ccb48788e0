"""One recorded frame from one file: PNG, TIFF, BMP, PGM or .npy, grey, 8 or 16 bit."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import numpy.typing as npt

SUFFIXES = frozenset({".png", ".tif", ".tiff", ".bmp", ".pgm", ".npy"})
"""File names that may hold a frame, lower case."""


def read(path: Path) -> npt.NDArray[np.uint8] | npt.NDArray[np.uint16]:
    """The frame, (H, W) uint8 or uint16. Raises OSError, or ValueError saying what is wrong with the contents."""
    data = path.read_bytes()
    if not data:
        raise ValueError("the file is empty")
    image = _decode_npy(data) if path.suffix.lower() == ".npy" else _decode_image(data)
    if image.ndim != 2:
        raise ValueError(f"not a grey frame: shape {image.shape}")
    if image.size == 0:
        raise ValueError("the frame has no pixels")
    if image.dtype == np.uint8:
        return image.astype(np.uint8, copy=False)
    if image.dtype == np.uint16:
        return image.astype(np.uint16, copy=False)
    raise ValueError(f"grey values are {image.dtype}, neither 8 nor 16 bit unsigned")


def _decode_npy(data: bytes) -> npt.NDArray[np.generic]:
    try:
        loaded = np.load(io.BytesIO(data), allow_pickle=False)
    except (ValueError, EOFError, OSError, MemoryError) as error:
        raise ValueError(f"not a .npy array: {error}") from error
    if not isinstance(loaded, np.ndarray):
        raise ValueError("an archive of arrays, not one array")
    return loaded


def _decode_image(data: bytes) -> npt.NDArray[np.generic]:
    import cv2  # 0.1 s, which the service's start need not wait for

    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise ValueError(f"not a readable image: {error}") from error
    if image is None:
        raise ValueError("not a readable image: damaged, cut short, or of another format")
    return np.asarray(image)
