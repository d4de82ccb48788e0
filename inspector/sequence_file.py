"""The last result's number, kept over restarts in a small file, so that a sequence shown to the PLC never goes back.

A write to the disk for each result would cost more than a result; so the file holds a number that results have not
reached yet, and is written anew before they do, by a thread: a disk that hangs must not hold the line up. After a crash
the sequence goes on from there: with a gap, as if so many results had gone unseen, but never back.
"""

from __future__ import annotations

import json
import logging
import threading
from pathlib import Path

from firmware_bridge import whole_file

log = logging.getLogger(__name__)

RETRY_AFTER = 16
"""Results after which a file that could not be written is tried again."""
AHEAD = 256
"""How far ahead of the results the file is written; the largest gap after a crash. It is begun at half of that."""
WAIT_S = 0.2
"""A result that has come up to the file's number waits so long for the next, seconds."""


class SequenceFile:
    """``first`` is the number to go on from. Without a ``file`` that is 0, and nothing is kept."""

    def __init__(self, file: Path | None) -> None:
        self._file = file
        self._failed = False
        self._next_try = self._next_wait = 0
        self._writing: threading.Thread | None = None
        self._error = ""
        self.first = self._kept = self._read()

    def reached(self, sequence: int) -> None:
        """A result is about to have this number. A file that cannot be written is said once."""
        if self._file is None or sequence <= self._kept - AHEAD // 2:
            return
        if sequence >= self._next_try:
            self._next_try = sequence + RETRY_AFTER
            self._begin(sequence + AHEAD)
        if sequence > self._kept and sequence >= self._next_wait:
            self._wait_for(sequence)

    def move(self, file: Path | None) -> None:
        """Keep the number in another file from the next result on."""
        if file != self._file:
            self._file, self._kept, self._failed = file, -1, False
            self._next_try = self._next_wait = 0

    def ends(self, sequence: int) -> None:
        """No more results: the next run goes on from here, without a gap."""
        if self._file is not None:
            if self._writing is not None:
                self._writing.join(WAIT_S)
            self._kept = -1
            self._begin(sequence)
            self._wait_for(sequence)

    def _read(self) -> int:
        if self._file is None or not self._file.exists():
            return 0
        try:
            return max(0, int(json.loads(self._file.read_text(encoding="utf-8"))["sequence"]))
        except (OSError, ValueError, KeyError, TypeError) as error:
            log.error("%s: cannot be used (%s); sequence begins at 0 again: tell the PLC's program", self._file, error)
            return 0

    def _begin(self, number: int) -> None:
        """Have the number written, unless the one before is still on its way."""
        if self._writing is None or not self._writing.is_alive():
            self._error = "the disk does not answer"
            self._writing = threading.Thread(target=self._write, args=(self._file, number), daemon=True)
            self._writing.start()

    def _wait_for(self, sequence: int) -> None:
        if self._writing is not None:
            self._writing.join(WAIT_S)
        self._next_wait = sequence + RETRY_AFTER
        if self._kept >= sequence:
            self._failed = False
        elif not self._failed:
            why = "cannot be written (%s); after a restart the sequence may go back"
            log.error(f"%s: {why}", self._file, self._error)
            self._failed = True

    def _write(self, file: Path, number: int) -> None:
        """The thread."""
        try:
            whole_file.write(file, json.dumps({"sequence": number}) + "\n")
        except OSError as error:
            self._error = str(error)
        else:
            if file == self._file:
                self._kept = number
