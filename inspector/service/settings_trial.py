"""New settings are on trial until the station is ready with them.

Where it was ready before, and is not again within ``cycle.rollback_after_s``, they are taken back: the last good ones
are in force again, with their calibration as it was.
"""

from __future__ import annotations

import json
import logging
import math
import time
from collections.abc import Callable
from pathlib import Path

from inspector import settings_version
from inspector.faults import Fault
from inspector.model import Snapshot, State
from inspector.service import last_good
from inspector.service.last_good import Begun
from inspector.settings import Settings
from inspector.settings_version import SettingsVersion

log = logging.getLogger(__name__)

_RUNNING = (State.READY, State.SINGLE_EXECUTION, State.CONTINUOUS_EXECUTION)


class SettingsTrial:
    """The settings in force, as they were read from ``file``, and the last ones that the station was Ready with."""

    def __init__(
        self, file: Path, begun: Begun, folder: Path | None = None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._file, self._folder, self._clock = file, folder, clock
        self.settings, self._taken_back = begun.settings, begun.taken_back
        self._tried: SettingsVersion | None = settings_version.of(begun.settings)
        self._good: SettingsVersion | None = None
        self._ends_s = math.inf

    def tries(self, new: Settings, before: Snapshot) -> None:
        """``new`` are in force from now on; ``before`` is what the station was with the old ones. Raises OSError."""
        on_trial, after_s = math.isfinite(self._ends_s), new.cycle.rollback_after_s
        fair = self._good is not None and (on_trial or works(before))
        self._ends_s = self._clock() + after_s if fair and after_s is not None else math.inf
        self.settings, self._tried, self._taken_back = new, settings_version.of(new), None

    def saw(self, shown: Snapshot) -> None:
        """What the station is: if it is ready, the settings in force are good, and kept."""
        if self._tried is None or not works(shown):
            return
        self._good, self._tried, self._ends_s = self._tried, None, math.inf
        self._keep(self._good)

    @property
    def overdue(self) -> bool:
        """Whether the station has had time enough to become ready with the settings in force, and is not."""
        return self._clock() >= self._ends_s

    def go_back(self) -> Settings:
        """The last good settings, in force from now on; those before are refused. Raises OSError."""
        assert self._good is not None
        log.error(
            "with the new settings the station did not become ready within %s s (cycle.rollback_after_s): "
            "the last good ones are in force again",
            self.settings.cycle.rollback_after_s,
        )
        self._taken_back, self._ends_s, self._tried = last_good.version_name(self.settings), math.inf, None
        self._keep(self._good)
        self.settings = last_good.restored(self._good.settings, self._good.calibration_text, self._folder)
        return self.settings

    def _keep(self, good: SettingsVersion) -> None:
        if self._folder is not None:
            last_good.keep(self._file, self._folder, json.loads(good.as_json()), self._taken_back)


def works(shown: Snapshot) -> bool:
    """Whether the station's devices work: it is ready, or will be when its lamp is warm."""
    return shown.fault_code == Fault.LAMP_WARMING_UP or (not shown.fault_code and shown.state in _RUNNING)
