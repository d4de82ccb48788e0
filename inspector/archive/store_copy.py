"""Copies of a store, of one moment, whole or not at all: made also while a station writes into it."""

from __future__ import annotations

import os
import secrets
import sqlite3
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from firmware_bridge import whole_file

BUSY_S = 10.0
"""Whoever has the store locked is waited for so long."""


class CannotCopy(Exception):
    """There is no copy; the message says why and what to do. A copy that was there before is as it was."""


@dataclass(frozen=True, slots=True)
class Copied:
    """What a copy holds: results, and Unix time of the last one, None without any."""

    results: int
    last_s: float | None


def copy(store: Path, output: Path) -> Copied:
    """Copy a store, which may be in use, into one file of its own, and check it. Raises CannotCopy."""
    _check_names(store, output)
    try:
        with closing(sqlite3.connect(f"{store.resolve().as_uri()}?mode=ro", uri=True, timeout=BUSY_S)) as connection:
            return write(connection, output)
    except OSError as error:
        raise CannotCopy(f"{output}: {error.strerror}; name a file in a folder that may be written") from error
    except sqlite3.Error as error:
        raise CannotCopy(f"{store} cannot be copied to {output} ({error}): check disks, space and rights") from error


def write(connection: sqlite3.Connection, output: Path) -> Copied:
    """Copy an open store as it is now, to the disk. Raises sqlite3.Error, OSError; then ``output`` is as it was."""
    part = output.with_name(f".{output.name}.{secrets.token_hex(4)}.part")
    try:
        part.touch(mode=0o600, exist_ok=False)
        with closing(sqlite3.connect(part)) as copied:
            connection.backup(copied)
        held = _checked(part)
        with part.open("rb") as file:
            os.fsync(file.fileno())
        part.replace(output)
    finally:
        part.unlink(missing_ok=True)
    whole_file.settle(output.parent)
    return held


def _check_names(store: Path, output: Path) -> None:
    if not store.is_file():
        raise CannotCopy(f"{store} is not there: check archive.folder, and whether the station has run with it")
    if output.exists() and not output.is_file():
        raise CannotCopy(f"{output} is no ordinary file: name another")
    if output.parent.resolve() == store.parent.resolve():
        raise CannotCopy(f"{output} is in the archive's own folder, which the station keeps: name another folder")


def _checked(part: Path) -> Copied:
    """What the copy holds, read through: a copy of a damaged store is no backup. Raises sqlite3.Error."""
    with closing(sqlite3.connect(f"{part.resolve().as_uri()}?immutable=1", uri=True)) as copied:
        complaint = copied.execute("PRAGMA quick_check(1)").fetchone()[0]
        if complaint != "ok":
            raise sqlite3.DatabaseError(f"it is damaged: {complaint}")
        return Copied(*copied.execute("SELECT count(*), max(at_s) FROM result").fetchone())
