"""What inspects a station's frames and judges its panels.

The stages are imported when they are first needed: half a second that the registers do not wait for.
"""

from __future__ import annotations

from collections.abc import Callable

from inspector import calibration_file
from inspector.model import Frame, FrameResult, PanelFrames, PanelResult
from inspector.settings import Settings

Inspection = Callable[[Frame], FrameResult]
Judging = Callable[[PanelFrames], PanelResult]


def inspection_of(settings: Settings) -> Inspection:
    """What inspects a frame of this station. Raises CalibrationError."""
    from inspector.pipeline import Station, inspect

    station = Station(calibration_file.read(settings.calibration), settings.recipe)
    return lambda frame: inspect(frame, station)


def judging_of(settings: Settings) -> Judging:
    """What judges a panel of several frames of this station. Raises CalibrationError."""
    from inspector.judge.panel import PanelStation, judge_panel

    station = PanelStation(calibration_file.read(settings.calibration), settings.recipe.limits, settings.panel)
    return lambda gathered: judge_panel(gathered, station)
