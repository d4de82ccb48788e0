"""Next exposure and lamp level from the spots of a frame: the longest exposure and lowest level at which none bleeds.

Only the spots count: the panel is dark at any exposure that suits them. A spot that clips spills its charge over its
neighbours, and its centre then depends on the threshold it is looked at with (the thesis' section 5.2); a spot far
below full scale drowns in noise. Pure: the caller takes the frames and keeps the time.

Light on the sensor is taken as exposure times lamp level in percent, which is what the lamp's curve makes it.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

from firmware_bridge.contracts import CameraCapabilities
from inspector.model import Flag, FrameResult, Highlights, Reason
from inspector.recipe import AutomaticExposure

TARGET_SHARE = 0.9
"""Where the brightest spot is to peak, as a share of full scale over the panel: what is left is for noise and lamp."""
SETTLED = 0.05
"""A peak within this share of the target is at it."""
STEP_DOWN, STEP_UP = 0.5, 2.0
"""The largest change of light in one step: an overexposed spot does not tell by how much it is so."""
CLIPPED_STEP = 0.8
"""The smallest step down while a spot bleeds, since its fitted peak may say too little."""
LAMP_STEP_PERCENT = 5.0
"""The lamp's level moves by no more in one step: its filament takes time to follow."""
HIGH_SHARE, LOW_SHARE, PANELS = 0.97, 0.7, 8
"""Between panels: down as soon as a spot peaks above the first; up when in so many panels with spots all stayed under
the second, since a panel with small seeds says nothing of the next one's."""


@dataclass(frozen=True, slots=True)
class Level:
    """How much light: exposure in microseconds, lamp in percent of its full intensity."""

    exposure_us: float
    lamp_percent: float


@dataclass(frozen=True, slots=True)
class Bounds:
    """What exposure (a whole number of steps) and lamp may be set to."""

    exposure_min_us: float
    exposure_max_us: float
    exposure_step_us: float
    lamp_min_percent: float
    lamp_max_percent: float

    @classmethod
    def of(cls, wanted: AutomaticExposure, camera: CameraCapabilities) -> Bounds:
        """What the recipe allows and the camera can do."""
        low_us = max(wanted.min_us, camera.exposure_min_us)
        high_us = max(low_us, min(wanted.max_us, camera.exposure_max_us))
        return cls(low_us, high_us, camera.exposure_step_us, wanted.lamp_min_percent, wanted.lamp_max_percent)


@dataclass(frozen=True, slots=True)
class Brightness:
    """How bright the spots of a frame are: how many there are and bleed; the brightest's peak as a share of full scale
    over the panel: above 1 clipped, infinite where the frame is lit all over, NaN where there is no spot."""

    spots: int
    bleeding: int
    peak_share: float


DARK = Brightness(0, 0, math.nan)
OVERLIT = Brightness(0, 0, math.inf)
_OVERLIT = Reason.FRAME_OVERLIT | Reason.TOO_MANY_HIGHLIGHTS


def brightness(result: FrameResult) -> Brightness:
    """What an inspected frame says of its light; a frame that was refused for another reason says nothing."""
    if result.highlights is None:
        return OVERLIT if result.reasons & _OVERLIT else DARK
    return of_spots(result.highlights)


def of_spots(spots: Highlights) -> Brightness:
    """The brightness of a frame's spots; hot pixels are the sensor's and none of them."""
    real = (spots.flags & Flag.HOT_PIXEL) == 0
    bleeding = int(((spots.flags[real] & Flag.SATURATED) != 0).sum())
    if not real.any():
        return DARK
    share = float(spots.peak_dn[real].max()) / max(spots.full_scale_dn - spots.background_dn, 1.0)
    return Brightness(int(real.sum()), bleeding, max(share, 1.0) if bleeding else share)


def brightest(seen: Sequence[Brightness]) -> Brightness:
    """The brightest of them, with the bleeding of any; one without spots is darker than all."""
    top = max(seen, key=lambda one: -1.0 if math.isnan(one.peak_share) else one.peak_share)
    return replace(top, bleeding=max(one.bleeding for one in seen))


def is_right(seen: Brightness) -> bool:
    """Whether the brightest spot is where it should be and none bleeds."""
    return seen.bleeding == 0 and abs(seen.peak_share / TARGET_SHARE - 1) <= SETTLED


def next_level(level: Level, seen: Brightness, bounds: Bounds) -> Level:
    """One bounded step from ``level`` towards spots as bright as they may be, lamp as low and exposure as long as can.

    The same level where nothing is to be done, or nothing more can be. No spot at all asks for more light.
    """
    share = max(0.0 if math.isnan(seen.peak_share) else seen.peak_share, 1e-9)
    gain = min(max(TARGET_SHARE / share, STEP_DOWN), CLIPPED_STEP if seen.bleeding else STEP_UP)
    return _shared_out(level, 1.0 if is_right(seen) else gain, bounds)


def within(level: Level, bounds: Bounds) -> Level:
    """The level moved into the bounds."""
    lamp = min(max(level.lamp_percent, bounds.lamp_min_percent), bounds.lamp_max_percent)
    return Level(min(max(level.exposure_us, bounds.exposure_min_us), bounds.exposure_max_us), lamp)


def _shared_out(level: Level, gain: float, bounds: Bounds) -> Level:
    """``gain`` times the light of ``level``: from a longer exposure as far as it goes, the rest from the lamp."""
    light = level.exposure_us * level.lamp_percent * gain
    lowest = max(bounds.lamp_min_percent, light / bounds.exposure_max_us)
    highest = level.lamp_percent + LAMP_STEP_PERCENT
    lamp = min(max(lowest, level.lamp_percent - LAMP_STEP_PERCENT), highest)
    lamp = min(max(lamp, bounds.lamp_min_percent), bounds.lamp_max_percent)
    exposure = min(max(light / lamp, bounds.exposure_min_us), bounds.exposure_max_us)
    steps = math.floor((exposure - bounds.exposure_min_us) / bounds.exposure_step_us + 1e-9)
    return Level(bounds.exposure_min_us + steps * bounds.exposure_step_us, lamp)


class Automatic:
    """The level kept right from panel to panel: down at once, up slowly, and never within a panel."""

    def __init__(self, level: Level) -> None:
        self.level = level
        self._panel = DARK
        self._panels: deque[Brightness] = deque(maxlen=PANELS)

    def saw(self, seen: Brightness) -> None:
        """A frame of the panel that is being inspected; the level stays."""
        self._panel = brightest([self._panel, seen])

    def panel_done(self, bounds: Bounds) -> Level:
        """The level for the next panel."""
        seen, self._panel = self._panel, DARK
        if not math.isnan(seen.peak_share):
            self._panels.append(seen)
            moved = self._moved(seen, bounds)
            if moved != self.level:
                self._panels.clear()
                self.level = moved
        return self.level

    def _moved(self, seen: Brightness, bounds: Bounds) -> Level:
        if seen.bleeding or seen.peak_share > HIGH_SHARE:
            return next_level(self.level, seen, bounds)
        of_all = brightest(list(self._panels))
        if len(self._panels) == PANELS and of_all.peak_share < LOW_SHARE:
            return next_level(self.level, of_all, bounds)
        return _shared_out(self.level, 1.0, bounds)
