"""A recorded frame inspected again: the one place for it. By the settings it was inspected by the result is the same,
to the last bit; by others it says what they would have found.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from inspector.judge.panel import PanelStation, judge_panel
from inspector.model import Frame, FrameResult, Image, PanelFrame, PanelFrames, PanelResult
from inspector.pipeline import Station, inspect
from inspector.recipe import Recipe, find
from inspector.settings_version import SettingsVersion


@dataclass(frozen=True)
class Reinspection:
    """One version of a station's settings at work again. Whatever it calls for first raises VersionWrong where the
    version is not one that this program knows."""

    version: SettingsVersion

    @cached_property
    def station(self) -> Station:
        """What frames are inspected with."""
        return Station(self.version.calibration, self.version.recipe)

    @cached_property
    def panel_station(self) -> PanelStation:
        """What panels of several frames are judged with."""
        return PanelStation(self.version.calibration, self.version.recipe.limits, self.version.panel)

    def frame(self, image: Image, name: str) -> FrameResult:
        """What is found in the image (H, W) as the camera gave it."""
        return inspect(Frame(self.version.without_patch(image), name), self.station)

    def panel(self, frames: Sequence[PanelFrame], panel_id: int | None, missing: tuple[str, ...]) -> PanelResult:
        """What the frames of a panel say together; ``missing`` is what was recorded to have kept it from being seen
        whole."""
        return judge_panel(PanelFrames(panel_id, tuple(frames), missing), self.panel_station)


@dataclass(frozen=True)
class Change:
    """What is other than it was when frames were recorded; what is None stays. Travels to other processes.

    ``version`` takes the place of all the settings, and of its recipes the one of the recorded recipe's id is used,
    where it has one.
    """

    version: SettingsVersion | None = None
    recipe: Recipe | None = None
    calibration_text: str | None = None
    method: str | None = None

    def applied(self, recorded: SettingsVersion) -> SettingsVersion:
        """The version to inspect by instead of the recorded one. Raises VersionWrong."""
        if self == Change():
            return recorded
        base = self.version or recorded
        settings: dict[str, Any] = dict(base.settings)
        recipe = self.recipe or (_of_same_id(base, recorded.recipe.id) if self.version else base.recipe)
        if self.method is not None:
            recipe = recipe.model_copy(update={"method": self.method})
        settings["recipe"] = recipe.model_dump(mode="json")
        text = base.calibration_text if self.calibration_text is None else self.calibration_text
        return SettingsVersion(base.name, settings, text)


def _of_same_id(version: SettingsVersion, recipe_id: int) -> Recipe:
    """The version's recipe of this id, or else the one it uses. Raises VersionWrong."""
    return find(version.recipes, recipe_id) or version.recipe
