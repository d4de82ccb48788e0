"""What `inspector panel` does: frames from files inspected as one panel, its result printed and its map drawn."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from firmware_bridge import whole_file
from inspector import calibration_file, panel_map, result_text
from inspector.commands.inspect_files import inspect_file
from inspector.judge.panel import PanelStation, judge_panel
from inspector.model import FrameResult, PanelFrame, PanelFrames, PanelResult, Verdict
from inspector.panel_settings import LineSpeed, Pitch, Travel
from inspector.pipeline import Station
from inspector.settings import Settings, SettingsError, load

EXIT_INSPECTED, EXIT_NOT_INSPECTED, EXIT_USAGE, EXIT_SETTINGS_REFUSED = 0, 1, 2, 78
"""Exit statuses: PASS or FAIL; NOT_INSPECTED; nothing could be done; the settings are refused (EX_CONFIG)."""


class Unusable(Exception):
    """The settings do not say how the frames make a panel."""


def run(
    frames: Sequence[str], config: Path, step_mm: float | None = None, form: str = "table", map_file: Path | None = None
) -> int:
    """Inspect the frames, in the order of travel, as one panel; print its result; the exit status."""
    try:
        settings = load(config)
        travel = _travel(settings, step_mm)
    except SettingsError as error:
        print("\n".join(map(str, error.problems)), file=sys.stderr)
        return EXIT_SETTINGS_REFUSED
    except Unusable as error:
        print(f"{config}: {error}", file=sys.stderr)
        return EXIT_USAGE
    calibration = calibration_file.read(settings.calibration)
    at = PanelStation(calibration, settings.recipe.limits, settings.panel.model_copy(update={"travel": travel}))
    panel = judge_panel(PanelFrames(None, _inspected(frames, Station(calibration, settings.recipe), travel)), at)
    for line in result_text.FORMATS[form]([_as_frame(panel, len(frames))]):
        print(line)
    if map_file is not None:
        limits, area = settings.recipe.limits, settings.panel.area
        drawn = panel_map.svg(panel, calibration.camera, travel.direction, limits, area)
        try:
            whole_file.write(map_file, drawn)
        except OSError as error:
            print(f"{map_file}: not written ({error.strerror})", file=sys.stderr)
            return EXIT_USAGE
    return EXIT_NOT_INSPECTED if panel.verdict is Verdict.NOT_INSPECTED else EXIT_INSPECTED


def _travel(settings: Settings, step_mm: float | None) -> Travel:
    """How the panel moved from file to file. Raises Unusable where nobody says how far."""
    travel = settings.panel.travel
    if travel is None:
        raise Unusable("no panel.travel: say how the panel moves (panel.frames and panel.travel)")
    if step_mm is not None:
        return travel.model_copy(update={"by": Pitch(kind="pitch", mm_per_frame=step_mm)})
    if isinstance(travel.by, LineSpeed):
        raise Unusable("files do not tell when they were taken: give the travel from frame to frame, --step-mm")
    return travel


def _inspected(frames: Sequence[str], station: Station, travel: Travel) -> tuple[PanelFrame, ...]:
    assert not isinstance(travel.by, LineSpeed)
    step_mm, shown = travel.by.mm_per_frame, []
    for number, name in enumerate(frames):
        _, result = inspect_file(name, station)
        if result.verdict is Verdict.NOT_INSPECTED:
            print(f"inspector: {name}: {' '.join(result.reasons_text)}", file=sys.stderr)
        shown.append(PanelFrame(result, number * step_mm))
    return tuple(shown)


def _as_frame(panel: PanelResult, frames: int) -> FrameResult:
    """The panel in the form that frames are printed in; places are the panel's."""
    return FrameResult(
        f"panel of {frames} frame{'' if frames == 1 else 's'}",
        panel.verdict,
        panel.reasons,
        panel.reasons_text,
        panel.defects,
        panel.unpaired,
        panel.elapsed_us,
    )
