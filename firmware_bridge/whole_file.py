"""Files written whole or not at all: after a power cut there is the old one or the new one, never half of either."""

from __future__ import annotations

import errno
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO


def write(path: Path, content: str | bytes) -> None:
    """Write a file beside ``path``, to the disk, and only then give it its name; an old one's mode is kept.

    Raises OSError, and then ``path`` is as it was: also where it is a device or a folder, which nothing may replace.
    """
    with writing(path) as file:
        file.write(content.encode() if isinstance(content, str) else content)


@contextmanager
def writing(path: Path) -> Iterator[BinaryIO]:
    """As :func:`write`, with the file to write into, for what is too large to be made first. Whatever is raised while
    it is written leaves ``path`` as it was."""
    if path.exists() and not path.is_file():
        raise FileExistsError(errno.EEXIST, "is no ordinary file: name another", str(path))
    beside = path.with_name(f".{path.name}.{secrets.token_hex(4)}.part")
    try:
        with beside.open("xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        with suppress(FileNotFoundError):
            beside.chmod(path.stat().st_mode)
        beside.replace(path)
    finally:
        beside.unlink(missing_ok=True)
    settle(path.parent)


def settle(folder: Path) -> None:
    """Return when the names in a folder are on the disk as they are now. Raises OSError."""
    opened = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(opened)
    finally:
        os.close(opened)
