"""One recorded frame from one file."""

from __future__ import annotations

from pathlib import Path

from firmware_bridge.wire import image

SUFFIXES = frozenset({".png", ".tif", ".tiff", ".bmp", ".pgm", ".npy"})
"""File names that may hold a frame, lower case."""


def read(path: Path) -> image.Image:
    """The frame, (H, W) uint8 or uint16. Raises OSError, or ValueError saying what is wrong with the contents."""
    return image.decode(path.read_bytes())
