"""An archive's folder as one running station's: claimed by a lock on a file in it, which goes with the process."""

from __future__ import annotations

import fcntl
import os
from contextlib import suppress
from pathlib import Path

LOCK = "archive.lock"
"""Name in the archive's folder."""


class StoreUnavailable(Exception):
    """The store cannot be written now; the message says why. Trying again may help."""


class StoreInUse(StoreUnavailable):
    """Another process has the archive."""


def is_mounted(disk: Path) -> bool:
    """Whether a disk is mounted there, or where a link leads. One that cannot be asked is not."""
    return os.path.ismount(os.path.realpath(disk))


class Claim:
    """The claim on a folder, to be taken before anything is written there; not before its ``disk`` is mounted.
    :meth:`take` and :meth:`close` are for one thread, :meth:`holds` for any."""

    def __init__(self, folder: Path, disk: Path | None = None) -> None:
        self._folder, self._path, self._disk = folder, folder / LOCK, disk
        self._lock: int | None = None

    def take(self) -> None:
        """Have the folder, made if it is not there. Raises StoreInUse, StoreUnavailable.

        A folder that was ours is not made again: where it is gone, its disk is, and what were written in its place
        would be hidden when that comes back.
        """
        if self.holds():
            return
        try:
            lock = self._opened()
        except OSError as error:
            gone = self._lock is not None and isinstance(error, FileNotFoundError)
            why = "is gone: mount its disk again, or restart the service to begin anew" if gone else error.strerror
            raise StoreUnavailable(f"{self._folder} {why}" if gone else f"{self._folder}: {why}") from error
        self.close()
        self._lock = lock

    def holds(self) -> bool:
        """Whether the folder is ours, as it is there now: neither taken away nor replaced."""
        lock = self._lock
        if lock is None:
            return False
        try:
            return os.path.samestat(os.fstat(lock), self._path.stat())
        except OSError:
            return False

    def close(self) -> None:
        """Let others have it."""
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def _opened(self) -> int:
        """The lock, locked. Raises OSError, StoreInUse."""
        new = 0 if self._lock is not None else os.O_CREAT
        if self._disk is not None and not is_mounted(self._disk):
            raise StoreUnavailable(f"{self._disk}: no disk is mounted there")
        if new:
            self._folder.mkdir(parents=True, exist_ok=True)
        lock = os.open(self._path, os.O_RDWR | os.O_CLOEXEC | new, 0o600)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            with suppress(OSError):
                os.close(lock)
            if isinstance(error, BlockingIOError):
                why = "is another running station's: give each station a folder of its own"
                raise StoreInUse(f"{self._folder} {why}") from error
            raise
        return lock
