"""Recorded sessions in a folder, the oldest first by their names: what they take, and taking them away."""

from __future__ import annotations

import logging
import re
import shutil
import time
from collections.abc import Collection
from contextlib import suppress
from pathlib import Path

from firmware_bridge.wire import session
from inspector.archive.retention import Held
from inspector.archive.session_writer import PART

STAMP = "%Y%m%dT%H%M%SZ"
"""Begin of a session's name, as strftime writes it: when it was begun, UTC."""
_SESSION = re.compile(r"\d{8}T\d{6}Z-")
"""What is named otherwise is somebody else's, and left alone."""
GOING = ".going-"
"""Begin of the name of a session that is being deleted: half of one is never taken for a session."""


log = logging.getLogger(__name__)


class Shelf:
    """The sessions of one folder. A session that is written no more is measured once."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._known: dict[str, Held] = {}
        self._stuck: set[str] = set()

    def sessions(self) -> list[str]:
        """Names of the sessions, the oldest first. Raises OSError."""
        try:
            return sorted(p.name for p in self.folder.iterdir() if _SESSION.match(p.name) and p.is_dir())
        except FileNotFoundError:
            return []

    def held(self, busy: Collection[str], now_s: float) -> list[Held]:
        """The sessions but those that are being written, the oldest first. Raises OSError.

        One from the future was written before the clock was set back: it is older than all others.
        """
        now = time.strftime(STAMP, time.gmtime(now_s))
        gone = {*busy, *self._stuck}
        names = sorted((n for n in self.sessions() if n not in gone), key=lambda n: (n[: len(now)] <= now, n))
        self._known = {name: self._known.get(name) or _measured(self.folder / name) for name in names}
        return list(self._known.values())

    def size_bytes(self, name: str) -> int:
        """What a session that is being written takes as yet. Raises OSError."""
        folder = self.folder / name
        return _measured(folder).size_bytes if folder.is_dir() else 0

    def delete(self, name: str) -> None:
        """Take a session away; one that cannot be is left alone from then on, and others go in its place."""
        going = self.folder / f"{GOING}{name}"
        self._known.pop(name, None)
        try:
            (self.folder / name).rename(going)
            shutil.rmtree(going)
        except OSError as error:
            self._stuck.add(name)
            log.error("%s cannot be deleted (%s): look at its permissions", self.folder / name, error.strerror)

    def clean(self) -> None:
        """Take away what a crash left half done; nothing that a session's index names. Raises OSError."""
        if not self.folder.is_dir():
            return
        for path in self.folder.iterdir():
            if path.name.startswith(GOING):
                shutil.rmtree(path)
        for name in self.sessions()[-1:]:  # only the one that was being written
            _clean_session(self.folder / name)


def _measured(folder: Path) -> Held:
    files = [file.lstat() for file in folder.iterdir()]
    newest_s = max((stat.st_mtime for stat in files), default=0.0)
    frames = sum(1 for file in folder.glob("*.png"))
    return Held(folder.name, sum(stat.st_blocks * 512 for stat in files), newest_s, frames)


def _clean_session(folder: Path) -> None:
    """Images without a line in the index are not known to be whole; a session without an index is none."""
    index = folder / session.INDEX
    if not index.is_file():
        shutil.rmtree(folder)
        return
    named = set[str]()
    with suppress(session.SessionWrong, UnicodeDecodeError):
        named = {recorded.file for recorded in session.parse(index.read_text(encoding="utf-8"))}
        for file in folder.iterdir():
            if file.name.endswith(PART) or (file.suffix == ".png" and file.name not in named):
                file.unlink()
