"""The main path: one frame in, one result out. Pure: no clock, file, socket or thread."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from inspector.detect import highlights as highlights_stage
from inspector.detect import pairs as pairs_stage
from inspector.detect.highlights import FrameRefused
from inspector.estimate import heights as heights_stage
from inspector.judge.verdict import judge
from inspector.model import Frame, FrameResult, Reason, Verdict
from inspector.optics import Calibration, Camera
from inspector.recipe import Recipe


@dataclass(frozen=True)
class Station:
    """What an inspection needs besides the frame: the geometry and the recipe."""

    calibration: Calibration
    recipe: Recipe = Recipe()

    @cached_property
    def area_m2(self) -> float:
        """The panel's area in view, square metres: the outline of the frame carried to the panel (0 if it is not all
        on the panel)."""
        x, y = self.calibration.camera.outline_mm().T
        area_mm2 = abs(float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))) / 2
        return area_mm2 / 1e6 if np.isfinite(area_mm2) else 0.0


def inspect(frame: Frame, station: Station) -> FrameResult:
    """Find, pair, measure and judge the seeds of one frame. A frame that cannot be judged is NOT_INSPECTED."""
    calibration, recipe = station.calibration, station.recipe
    try:
        _check(frame, calibration.camera)
        highlights = highlights_stage.find(frame.image, recipe.detection, calibration.sensor)
    except FrameRefused as refusal:
        return FrameResult(frame.name, Verdict.NOT_INSPECTED, refusal.reason, (str(refusal),))
    pairs = pairs_stage.pair(highlights, calibration)
    defects, unpaired = heights_stage.measure(highlights, pairs, calibration, recipe.method)
    verdict, reasons, texts = judge(defects, unpaired, recipe.limits, station.area_m2)
    return FrameResult(frame.name, verdict, reasons, texts, defects, unpaired, highlights=highlights)


def _check(frame: Frame, camera: Camera) -> None:
    """Refuse what is no frame of this camera. Raises FrameRefused."""
    image, expected = frame.image, (camera.height_px, camera.width_px)
    if image.shape != expected:
        raise FrameRefused(
            Reason.FRAME_WRONG_SHAPE,
            f"the frame is {' x '.join(map(str, image.shape[::-1])) or 'a scalar'} pixels, the calibration"
            f" {expected[1]} x {expected[0]}: calibrate this camera, or undo its region of interest",
        )
    if image.dtype.kind != "u" or image.dtype.itemsize > 2:
        raise FrameRefused(
            Reason.FRAME_UNREADABLE, f"the frame's pixels are {image.dtype}: grey frames of 8 or 16 bits are inspected"
        )
