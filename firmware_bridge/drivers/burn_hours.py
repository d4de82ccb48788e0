"""A lamp's burning hours, kept over restarts in a small file of their own.

The file is JSON, ``{"burnt_hours": 812.4}``; take it away when the bulb is changed. A lamp is never kept dark for its
sake: a file that cannot be used is said once in the log, and the hours go on in memory.
"""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Callable
from pathlib import Path

from firmware_bridge import whole_file
from firmware_bridge.wire.lamp_burn import Burn, at_level, burnt

SAVE_EVERY_HOURS = 0.1
"""A power cut costs six minutes of a bulb's thousand hours, and the file's flash a write in as many."""

log = logging.getLogger(__name__)


class BurnHours:
    """The account of one lamp. ``file`` None: it is not kept. ``clock`` gives monotonic seconds."""

    def __init__(self, file: Path | None, clock: Callable[[], float]) -> None:
        self._file, self._clock = file, clock
        self._burn: Burn | None = None
        self._saved_hours = 0.0
        self._complained = False

    @property
    def hours(self) -> float:
        """Hours burnt until now."""
        return burnt(self._account(), self._clock())

    def level(self, level_v: float) -> None:
        """The lamp's level is known to be ``level_v``, volts; the file is written now and then."""
        last = self._account()
        self._burn = at_level(last, self._clock(), level_v)
        dark = last.lit and not self._burn.lit
        if self._burn.hours > self._saved_hours + (0.0 if dark else SAVE_EVERY_HOURS):
            self._save(self._burn.hours)

    def _account(self) -> Burn:
        if self._burn is None:
            self._saved_hours = self._read()
            self._burn = Burn(self._saved_hours, self._clock())
        return self._burn

    def _read(self) -> float:
        """Hours from the file; 0 without one. A damaged one is put aside for whoever wants to mend it."""
        if self._file is None:
            return 0.0
        try:
            return _hours(self._file.read_text(encoding="utf-8"))
        except FileNotFoundError:
            return 0.0
        except (OSError, ValueError) as error:
            self._complain(f"cannot be read ({error}): hours begin at 0, it is kept as {self._file.name}.damaged")
            self._put_aside(self._file)
            return 0.0

    def _put_aside(self, file: Path) -> None:
        try:
            file.replace(file.with_name(f"{file.name}.damaged"))
        except OSError as error:
            self._complain(f"cannot be put aside: {error}")

    def _save(self, hours: float) -> None:
        self._saved_hours = hours
        if self._file is None:
            return
        try:
            whole_file.write(self._file, json.dumps({"burnt_hours": round(hours, 4)}) + "\n")
        except OSError as error:
            self._complain(f"cannot be written ({error}): hours are kept in memory only")

    def _complain(self, what: str) -> None:
        if not self._complained:
            log.warning("lamp hours: %s %s", self._file, what)
        self._complained = True


def _hours(text: str) -> float:
    """The hours in a file's text. Raises ValueError."""
    kept = json.loads(text)
    hours = kept.get("burnt_hours") if isinstance(kept, dict) else None
    if isinstance(hours, bool) or not isinstance(hours, int | float) or not math.isfinite(hours) or hours < 0:
        raise ValueError('not {"burnt_hours": NUMBER}')
    return float(hours)
