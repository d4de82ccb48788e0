"""The results' store: one SQLite file, opened whole or set aside, written entry by entry. Used by one thread.

What it promises: an entry is on the disk, by fsync, when :meth:`Store.write` returns; it is there whole or not at all;
the file that another process reads meanwhile, or finds after a power cut, is a store.
"""

from __future__ import annotations

import os
import sqlite3
import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from firmware_bridge import whole_file
from inspector.archive import store_copy
from inspector.archive.claim import StoreUnavailable
from inspector.archive.entries import Entry, Rows
from inspector.archive.schema import OLDEST_WRITER, RUN_BITS, STEPS

FILE = "results.sqlite"
"""Name in the archive's folder."""
BUSY_S = 2.0
"""Whoever else writes into the file is waited for so long."""
CHECKPOINT_BYTES = 4_000_000
"""The log beside the file is worked into it when it is larger, and begun anew, unless somebody reads all the time."""
CACHE_KIB = 256
"""Rows are added at the end, which needs few pages in memory; SQLite's own 2 MB would fill over days."""
_BESIDE = ("", "-wal", "-shm")
_ONCE = frozenset({"settings_version", "recipe_version"})
"""Tables whose rows stay as they were written first."""


class StoreBusy(StoreUnavailable):
    """The store is sound and open, and cannot be written now: another process writes, or the disk is full."""


class StoreDamaged(Exception):
    """The file is no store, or a damaged one: to be set aside."""


class EntryRefused(Exception):
    """One of the entries cannot be kept by any store: an error in the program."""


@dataclass(frozen=True, slots=True)
class Run:
    """The service from its start to its end, as the store knows it: Unix time, program's version, station's name."""

    started_s: float
    program: str
    station: str


class Store:
    """A claimed folder's store, open. ``id`` is the run's number. Raises StoreUnavailable, StoreDamaged."""

    def __init__(self, folder: Path, run: Run, steps: Sequence[str] = STEPS) -> None:
        self._path = folder / FILE
        self._tidied_bytes = 0
        try:
            self._connection = _opened(self._path, steps)
            self.id = self._begin(run)
            self._files = _identities(self._path)
        except BaseException as error:
            self.close()
            if isinstance(error, sqlite3.Error | OSError):
                raise _meant(error) from error
            raise

    def write(self, entries: Iterable[Entry]) -> None:
        """Write these entries, all or none, to the disk. Raises StoreUnavailable, StoreDamaged, EntryRefused; then none
        is written.

        An entry that is written again replaces itself.
        """
        try:
            self._check_files()
            with self._connection as transaction:
                transaction.execute("BEGIN IMMEDIATE")
                for entry in entries:
                    for rows in entry:
                        self._insert(rows)
        except (*_REFUSALS, OverflowError, TypeError, ValueError) as error:
            raise EntryRefused(f"{type(error).__name__}: {error}") from error
        except (sqlite3.Error, OSError) as error:
            raise _meant(error) from error

    def tidy(self) -> int:
        """Work the log into the file when it has grown; to be called when nobody waits. Its size, bytes: who reads on
        and on keeps it from being begun anew, and then it grows. Raises as :meth:`write`."""
        try:
            size = os.stat(f"{self._path}-wal").st_size
            self._tidied_bytes = 0 if size < self._tidied_bytes else self._tidied_bytes
            if size > self._tidied_bytes + CHECKPOINT_BYTES:
                self._connection.execute("PRAGMA wal_checkpoint(PASSIVE)")
                self._tidied_bytes = size
        except FileNotFoundError:
            return 0
        except (sqlite3.Error, OSError) as error:
            raise _meant(error) from error
        return size

    def close(self, ended_s: float | None = None) -> None:
        """Close the file; with ``ended_s`` the run's end is kept. Never raises."""
        connection = getattr(self, "_connection", None)
        if connection is not None:
            with suppress(sqlite3.Error):
                if ended_s is not None:
                    with connection:
                        connection.execute("UPDATE run SET ended_s = ? WHERE id = ?", (ended_s, self.id))
            with suppress(sqlite3.Error):
                connection.close()

    def _check_files(self) -> None:
        """See that the files are those that were opened. Raises StoreUnavailable, StoreDamaged, sqlite3.Error, OSError.

        SQLite would go on in a log that was deleted, lost with the process: it is worked into the file.
        """
        found = _identities(self._path)
        if found == self._files:
            return
        if found[0] != self._files[0]:
            raise StoreDamaged(f"{self._path} was taken away or replaced")
        _, held, done = self._connection.execute("PRAGMA wal_checkpoint(PASSIVE)").fetchone()
        kind = StoreBusy if done < held else StoreUnavailable
        raise kind(f"{self._path}-wal or -shm was taken away while in use: leave them alone; what they held is kept")

    def _begin(self, run: Run) -> int:
        """The run's row; the same run that opens the store again finds its own."""
        with self._connection as transaction:
            transaction.execute("BEGIN IMMEDIATE")
            known = transaction.execute("SELECT id FROM run WHERE started_s = ? AND ended_s IS NULL", (run.started_s,))
            found = known.fetchone()
            if found is None:
                columns = "INSERT INTO run (started_s, program, station) VALUES (?, ?, ?) RETURNING id"
                found = transaction.execute(columns, (run.started_s, run.program, run.station)).fetchone()
        return int(found[0])

    def _insert(self, rows: Rows) -> None:
        verb = "IGNORE" if rows.table in _ONCE else "REPLACE"
        columns, values = rows.columns, rows.values
        if rows.of_run:
            columns, values = (*columns, "run"), tuple((*row, self.id) for row in values)
        if rows.of_result:
            values = tuple((self.id << RUN_BITS | row[0], *row[1:]) for row in values)
        marks = ", ".join("?" * len(columns))
        sql = f"INSERT OR {verb} INTO {rows.table} ({', '.join(columns)}) VALUES ({marks})"
        self._connection.executemany(sql, values)


def _identities(path: Path) -> list[tuple[int, int] | None]:
    """Which files the store's names are of; None: of none. Raises OSError."""
    return [_identity(f"{path}{suffix}") for suffix in _BESIDE]


def _identity(path: str) -> tuple[int, int] | None:
    try:
        found = os.stat(path)
    except FileNotFoundError:
        return None
    return found.st_dev, found.st_ino


def set_aside(folder: Path, now_s: float) -> Path | None:
    """Give the store's files other names, so that a new one can begin; the new name, None if there is no store.

    Raises StoreUnavailable. Nothing is deleted: somebody may want to save what can be.
    """
    stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime(now_s))
    path = folder / FILE
    name = path.with_name(f"results.set-aside-{stamp}.sqlite")
    number = 1
    while name.exists():
        number += 1
        name = path.with_name(f"results.set-aside-{stamp}-{number}.sqlite")
    moved = None
    try:
        for suffix in reversed(_BESIDE):  # the log first: beside no file SQLite would take it for an old one's
            with suppress(FileNotFoundError):
                os.replace(f"{path}{suffix}", f"{name}{suffix}")
                moved = name
        whole_file.settle(folder)
    except OSError as error:
        raise StoreUnavailable(f"{path} is damaged and cannot be set aside ({error.strerror})") from error
    return moved


def _opened(path: Path, steps: Sequence[str]) -> sqlite3.Connection:
    """The file, sound and with all steps taken. Raises sqlite3.Error, OSError, StoreDamaged."""
    connection = sqlite3.connect(path, timeout=BUSY_S, isolation_level=None, check_same_thread=False)
    try:
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("PRAGMA synchronous = FULL")
        connection.execute("PRAGMA wal_autocheckpoint = 0")
        connection.execute(f"PRAGMA cache_size = -{CACHE_KIB}")
        # The log's size would tell nothing from then on if it stayed as large as it ever was.
        connection.execute(f"PRAGMA journal_size_limit = {CHECKPOINT_BYTES}")
        complaint = connection.execute("PRAGMA quick_check(1)").fetchone()[0]
        if complaint != "ok":
            raise StoreDamaged(f"{path} fails its integrity check: {complaint}")
        _bring_up_to_date(connection, path, steps)
    except BaseException:
        connection.close()
        raise
    return connection


def _bring_up_to_date(connection: sqlite3.Connection, path: Path, steps: Sequence[str]) -> None:
    """Take the steps that the file has not had, each whole or not at all, after a backup of what is there."""
    version = connection.execute("PRAGMA user_version").fetchone()[0]
    if version > len(steps):
        _check_writable(connection, path, len(steps))
        return
    if 0 < version < len(steps):
        store_copy.write(connection, path.with_name(f"results.version-{version}.sqlite"))
    for number, step in enumerate(steps[version:], version + 1):
        oldest = f"INSERT OR REPLACE INTO about VALUES ('oldest_writer', '{OLDEST_WRITER}')"
        script = f"BEGIN IMMEDIATE; {step}; {oldest}; PRAGMA user_version = {number}; COMMIT;"
        connection.executescript(script)
    if version < len(steps):
        whole_file.settle(path.parent)


def _check_writable(connection: sqlite3.Connection, path: Path, version: int) -> None:
    """A newer program's store goes on here if that program says so. Raises StoreDamaged: it is then set aside."""
    said = connection.execute("SELECT value FROM about WHERE key = 'oldest_writer'").fetchone()
    if said is None or int(said[0]) > version:
        raise StoreDamaged(f"{path} is a newer program's, and cannot be gone on with by this one")


_REFUSALS = (sqlite3.ProgrammingError, sqlite3.IntegrityError, sqlite3.InterfaceError, sqlite3.DataError)
_DAMAGE = (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)
_BUSY = (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED, sqlite3.SQLITE_FULL)


def _meant(error: sqlite3.Error | OSError) -> StoreUnavailable | StoreDamaged:
    """What an error of SQLite's or the system's means for the store."""
    code = getattr(error, "sqlite_errorcode", 0) & 0xFF
    if code in _DAMAGE or (isinstance(error, sqlite3.DatabaseError) and "no such table" in str(error)):
        return StoreDamaged(str(error))
    return StoreBusy(str(error)) if code in _BUSY else StoreUnavailable(str(error))
