"""What lamp and camera are set to: by the recipe, then moved from panel to panel by what frames show. Pure."""

from __future__ import annotations

from dataclasses import replace

from firmware_bridge.contracts import CameraCapabilities
from inspector.acquire import exposure, light
from inspector.acquire.exposure import Automatic, Bounds, Level
from inspector.acquire.light import LightSettings, Trim
from inspector.faults import Fault
from inspector.model import Frame, FrameResult
from inspector.recipe import Recipe

LAMP_MOST_PERCENT = 100.0


class LightWrong(Exception):
    """The frame's reference patch does not show the light that it should; ``fault`` is why."""

    def __init__(self, fault: Fault, message: str) -> None:
        super().__init__(message)
        self.fault = fault


class Tuning:
    """The levels of one recipe at work. Nothing moves but in :meth:`trim` and :meth:`panel_done`, between panels."""

    def __init__(self, recipe: Recipe, settings: LightSettings | None) -> None:
        self._recipe, self._light = recipe, settings
        self._automatic = Automatic(Level(recipe.exposure_us, recipe.lamp_percent))
        self._trim = Trim()

    @property
    def level(self) -> Level:
        """What the next frame is to be taken at."""
        level = self._automatic.level
        return Level(level.exposure_us, min(max(level.lamp_percent + self._trim.percent, 0.0), LAMP_MOST_PERCENT))

    @property
    def is_weak(self) -> bool:
        """Whether the lamp is near the end of what its level may be raised by."""
        return self._light is not None and light.is_weak(self._trim, self._light)

    @property
    def follows_spots(self) -> bool:
        """Whether the camera's range is needed: the recipe lets the level follow the spots."""
        return self._recipe.automatic_exposure is not None

    def check(self, frame: Frame) -> None:
        """Raise LightWrong if the frame, taken at the present level, was not taken in the light that it should be."""
        if self._light is None:
            return
        mean_dn, target_dn = self._over_black(frame, self._light)
        fault = light.fault_of_light(mean_dn, target_dn, self._light.tolerance)
        if fault:
            within = f"{target_dn:.1f} within {self._light.tolerance:.0%}"
            message = f"reference patch at {mean_dn:.1f} DN over black, not {within}; {fault.remedy.lower()}"
            raise LightWrong(fault, message)

    def to_inspect(self, frame: Frame) -> Frame:
        """The frame without its reference patch."""
        return frame if self._light is None else replace(frame, image=light.without(frame.image, self._light.patch))

    def trim(self, frame: Frame, now_s: float) -> None:
        """Trim the lamp by the reference patch of a frame that was taken at the present level."""
        if self._light is not None:
            mean_dn, target_dn = self._over_black(frame, self._light)
            self._trim = light.trimmed(self._trim, mean_dn, target_dn, self.level.lamp_percent, self._light, now_s)

    def saw(self, result: FrameResult) -> None:
        """A frame of the panel under way shows this."""
        if self.follows_spots:
            self._automatic.saw(exposure.brightness(result))

    def panel_done(self, camera: CameraCapabilities) -> None:
        """Let the level follow the spots of the panel that is done, if the recipe lets it."""
        automatic = self._recipe.automatic_exposure
        if automatic is not None:
            self._automatic.panel_done(Bounds.of(automatic, camera))

    def _over_black(self, frame: Frame, settings: LightSettings) -> tuple[float, float]:
        """What the patch shows and should show, DN over black: its target is that of the recipe's level, and the spots
        may have moved that."""
        level, recipe = self._automatic.level, self._recipe
        moved = 1.0
        if self.follows_spots:
            moved = (level.exposure_us * level.lamp_percent) / (recipe.exposure_us * recipe.lamp_percent)
        mean_dn = light.patch_mean_dn(frame.image, settings.patch)
        return mean_dn - settings.black_dn, (settings.target_dn - settings.black_dn) * moved
