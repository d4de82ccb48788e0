"""The results' store read beside the service that writes it: one look, as it was at one moment. Nothing is changed."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from inspector.archive.store import FILE

ROWS_AT_ONCE = 2000


class ArchiveUnreadable(Exception):
    """The archive cannot be read; the message names the place and the remedy."""


class StoreReader:
    """The store in ``archive``: its folder, or the file itself where it was set aside or copied.

    Raises ArchiveUnreadable, as :meth:`rows` does, and leaving the context.
    """

    def __init__(self, archive: Path) -> None:
        self.path = archive if archive.is_file() else archive / FILE
        self.folder = self.path.parent
        if not self.path.is_file():
            raise ArchiveUnreadable(_missing(archive))
        try:
            self._connection, self._unwritten = _opened(self.path)
        except sqlite3.Error as error:
            raise _unreadable(self.path, error) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, _error: object, _where: TracebackType | None) -> None:
        self._connection.close()
        if kind is None and self._unwritten and _log_of(self.path).exists():
            raise ArchiveUnreadable(f"{self.path}: a service began to write meanwhile: read it again")

    def rows(self, sql: str, values: Sequence[Any] = ()) -> Iterator[sqlite3.Row]:
        """The rows of a query, few of them in memory at a time."""
        try:
            cursor = self._connection.execute(sql, values)
            while some := cursor.fetchmany(ROWS_AT_ONCE):
                yield from some
        except sqlite3.Error as error:
            raise _unreadable(self.path, error) from error

    def row(self, sql: str, values: Sequence[Any] = ()) -> sqlite3.Row | None:
        """The first row of a query; None if there is none."""
        return next(self.rows(sql, values), None)


def _opened(path: Path) -> tuple[sqlite3.Connection, bool]:
    """The store, and whether it is read as a file that nobody writes: one in a folder where this process may not."""
    try:
        return _connected(path, "mode=ro"), False
    except sqlite3.OperationalError:
        if _log_of(path).exists() or not os.access(path, os.R_OK):
            raise
        return _connected(path, "immutable=1"), True


def _connected(path: Path, how: str) -> sqlite3.Connection:
    """A connection in a transaction of its own: all that it reads is of one moment. Raises sqlite3.Error."""
    connection = sqlite3.connect(f"{path.resolve().as_uri()}?{how}", uri=True, isolation_level=None)
    try:
        connection.row_factory = sqlite3.Row
        connection.execute("PRAGMA query_only = ON")
        connection.execute("BEGIN")
        connection.execute("SELECT 1 FROM result LIMIT 1").fetchone()
    except BaseException:
        connection.close()
        raise
    return connection


def _log_of(path: Path) -> Path:
    """SQLite's log beside the file: there while somebody writes."""
    return path.with_name(f"{path.name}-wal")


def _missing(archive: Path) -> str:
    if not archive.is_dir():
        return f"{archive}: there is no such archive: name the folder that the settings' archive.folder does"
    aside = sorted(str(path) for path in archive.glob("results.set-aside-*.sqlite"))
    also = f"; set aside as damaged, to be saved from: {', '.join(aside)}" if aside else ""
    return f"{archive / FILE} is not there: nothing was kept in this folder yet, or it is another's{also}"


def _unreadable(path: Path, error: sqlite3.Error) -> ArchiveUnreadable:
    """What SQLite says, with what can be done."""
    code = getattr(error, "sqlite_errorcode", 0) & 0xFF
    if code in (sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_READONLY, sqlite3.SQLITE_PERM):
        remedy = "run this as the service's user, who may read it and write beside it"
        if _log_of(path).exists():
            remedy += f", or copy it with {_log_of(path).name} to where you may write"
    elif code in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB) or "no such table" in str(error):
        remedy = f"it is damaged, or no store: name a sound copy, or save what can be: sqlite3 {path} .recover"
    else:
        remedy = "see whether disk and file are sound, and try again"
    return ArchiveUnreadable(f"{path}: {error}: {remedy}")
