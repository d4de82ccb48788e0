"""What glibc does with memory that is freed; another C library does as it likes. The numbers are mallopt(3)'s."""

from __future__ import annotations

import ctypes
from contextlib import suppress

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
_IMAGE_BYTES = 64 * 1024
"""All images but the smallest are larger."""
_MOST_BYTES = 32 << 20
"""As much as mallopt takes."""


def keep_images_off() -> None:
    """Have images mapped, and unmapped when they are freed. glibc learns from the first that is freed to keep such
    blocks in its heap, where small ones that outlive them leave holes between: the process then keeps its worst moment
    for months."""
    with suppress(AttributeError):
        ctypes.CDLL(None).mallopt(_MMAP_THRESHOLD, _IMAGE_BYTES)


def keep_for_the_next_frame() -> None:
    """Keep memory that a frame took for the next one: glibc gives it back each time, and having it anew costs up to a
    quarter of a frame's time. For processes that end soon."""
    with suppress(AttributeError):
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(_MMAP_THRESHOLD, _MOST_BYTES)
        mallopt(_TRIM_THRESHOLD, _MOST_BYTES)


def give_back() -> None:
    """To the system, memory that small blocks no longer take: glibc keeps it for others that may never come. A fraction
    of a millisecond."""
    with suppress(AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
