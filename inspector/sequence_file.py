"""The last result's number, kept over restarts in a small file, so that a sequence shown to the PLC never goes back.

A write to the disk for each result would cost more than a result; so the file holds a number that results have not
reached yet, and is written anew when they do. After a crash the sequence goes on from there: with a gap, as if so many
results had gone unseen, but never back.
"""

from __future__ import annotations

import json
import logging
from pathlib import Path

from firmware_bridge import whole_file

log = logging.getLogger(__name__)

RETRY_AFTER = 16
"""Results after which a file that could not be written is tried again."""
AHEAD = 256
"""How far ahead of the results the file is written; the largest gap after a crash."""


class SequenceFile:
    """``first`` is the number to go on from. Without a ``file`` that is 0, and nothing is kept."""

    def __init__(self, file: Path | None) -> None:
        self._file = file
        self._failed = False
        self.first = self._kept = self._read()

    def reached(self, sequence: int) -> None:
        """A result is about to have this number. A file that cannot be written is said once."""
        if sequence > self._kept:
            self._write(sequence + AHEAD)

    def move(self, file: Path | None) -> None:
        """Keep the number in another file from the next result on."""
        if file != self._file:
            self._file, self._kept, self._failed = file, -1, False

    def ends(self, sequence: int) -> None:
        """No more results: the next run goes on from here, without a gap."""
        self._write(sequence)

    def _read(self) -> int:
        if self._file is None or not self._file.exists():
            return 0
        try:
            return max(0, int(json.loads(self._file.read_text(encoding="utf-8"))["sequence"]))
        except (OSError, ValueError, KeyError, TypeError) as error:
            log.error("%s: cannot be used (%s); sequence begins at 0 again: tell the PLC's program", self._file, error)
            return 0

    def _write(self, sequence: int) -> None:
        if self._file is None:
            return
        try:
            whole_file.write(self._file, json.dumps({"sequence": sequence}) + "\n")
        except OSError as error:
            if not self._failed:
                log.error("%s: cannot be written (%s); after a restart the sequence may go back", self._file, error)
            self._failed = True
            self._kept = sequence - AHEAD + RETRY_AFTER
        else:
            self._kept, self._failed = sequence, False
