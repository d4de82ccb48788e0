"""The paint line's statistics at work: fed by each result, and kept in a file over restarts.

Statistics never cost an inspection: whatever fails here is said once in the log, and the PLC sees them as not valid.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np

from firmware_bridge import whole_file
from inspector import calibration_file
from inspector.judge.spc.monitor import Monitor
from inspector.judge.spc.panel import Panel
from inspector.model import Extent, Snapshot, Verdict
from inspector.optics import Camera
from inspector.outage import Outage
from inspector.settings import Settings, SettingsError
from inspector.yaml_document import Problem

SAVE_EVERY_S = 30.0
"""A crash or a power cut costs the panels of this time; a write for each panel would cost more than the panel."""
CHARTS_ANEW, BASELINES_ANEW = 0, 1
"""Arguments of the PLC's command RESET_STATISTICS."""

log = logging.getLogger(__name__)


def extent_of(camera: Camera) -> Extent:
    """A camera's field on the panel."""
    outline = camera.outline_mm()
    if not np.isfinite(outline).all():
        return Extent()
    x, y = outline.T
    area_mm2 = abs(float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))) / 2
    rim_mm = float(np.hypot(x - np.roll(x, -1), y - np.roll(y, -1)).sum())
    return Extent(area_mm2 / 1e6, (float(x.min()), float(y.min()), float(x.max()), float(y.max())), rim_mm)


def one_frame(settings: Settings) -> Extent:
    """What one frame sees of the panel, by these settings' calibration file. Raises CalibrationError."""
    extent = extent_of(calibration_file.read(settings.calibration).camera)
    if not extent.area_m2 > 0:
        log.error("the camera sees past the panel's plane: its area is unknown, and there will be no statistics")
    return extent


def panel_of(snapshot: Snapshot, one_frame: Extent) -> Panel:
    """A published result as the statistics take it; its time is the result's. ``one_frame``: what a frame sees."""
    defects, extent = snapshot.defects, snapshot.extent or one_frame
    return Panel(
        at_s=snapshot.result_at_s or 0.0,
        recipe_id=snapshot.recipe_id,
        inspected=snapshot.verdict is not Verdict.NOT_INSPECTED,
        count=len(defects),
        area_m2=extent.area_m2,
        heights_um=tuple(d.height_um for d in defects),
        sigmas_um=tuple(d.height_sigma_um for d in defects),
        places_mm=tuple((d.x_mm, d.y_mm) for d in defects),
        bounds_mm=extent.bounds_mm,
        rim_mm=extent.rim_mm,
    )


class LineHistory:
    """The statistics of one station. Reading its settings' files may raise CalibrationError; nothing else is raised."""

    def __init__(self, settings: Settings, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._computing, self._saving = Outage("statistics", clock), Outage("statistics_file", clock)
        self._writer = ThreadPoolExecutor(max_workers=1, thread_name_prefix="statistics")
        self._written: Future[None] | None = None
        self._file = settings.statistics_file
        self._extent = one_frame(settings)
        self._monitor = Monitor(settings.statistics)
        self._remember()
        self._saved_s = clock()

    def after(self, result: Snapshot) -> Snapshot:
        """The result as it is to be published: with the statistics after it, or without any if they fail."""
        try:
            statistics = self._monitor.add(panel_of(result, self._extent))
        except Exception as error:
            self._computing.begins(f"{type(error).__name__}: {error}", traceback=True)
            return replace(result, statistics=None, statistics_sequence=result.sequence)
        self._computing.ends()
        if self._clock() >= self._saved_s + SAVE_EVERY_S:
            self._save()
        return replace(result, statistics=statistics, statistics_sequence=result.sequence)

    def reset(self, what: int) -> None:
        """Begin the charts anew, or the baselines too. Raises SettingsError if ``what`` is neither."""
        if what not in (CHARTS_ANEW, BASELINES_ANEW):
            allowed = f"allowed: {CHARTS_ANEW} the charts, {BASELINES_ANEW} the baselines too"
            raise SettingsError((Problem("PLC", "command_argument", str(what), allowed),))
        if what == BASELINES_ANEW:
            self._monitor.relearn()
        else:
            self._monitor.reset()
        self._save()

    def take_over(self, settings: Settings, extent: Extent) -> None:
        """Go on by other settings, of which ``extent`` is :func:`one_frame`, with what is remembered."""
        self._extent = extent
        self._monitor.settings = settings.statistics
        self._file = settings.statistics_file

    def close(self) -> None:
        """Write the last state; nothing is to come after."""
        self._save(in_turn=True)
        self._writer.shutdown()

    def _remember(self) -> None:
        """Go on from the file. One that is damaged is put aside for whoever wants to look, and all begins anew."""
        if self._file is None:
            return
        try:
            self._monitor = Monitor.from_json(self._monitor.settings, self._file.read_text(encoding="utf-8"))
        except FileNotFoundError:
            return
        except OSError as error:
            log.error("%s: cannot be read (%s); statistics begin anew", self._file, error.strerror)
        except ValueError as error:
            aside = self._file.with_name(f"{self._file.name}.damaged")
            log.error("%s: damaged (%s); statistics begin anew, it is put aside as %s", self._file, error, aside)
            try:
                self._file.replace(aside)
            except OSError as failure:
                log.error("%s: cannot be put aside (%s)", self._file, failure.strerror)

    def _save(self, in_turn: bool = False) -> None:
        """Have the state written, by a thread that the cycle does not wait for; left out while that still writes."""
        if self._file is None or (not in_turn and self._written is not None and not self._written.done()):
            return
        self._saved_s = self._clock()
        self._written = self._writer.submit(self._write, self._file, self._monitor.to_json())

    def _write(self, file: Path, text: str) -> None:
        try:
            whole_file.write(file, text + "\n")
        except OSError as error:
            self._saving.begins(f"{file} cannot be written ({error.strerror}); a restart would lose the statistics")
        else:
            self._saving.ends()
