"""One version of a station's settings, whole: everything that a frame was inspected by, so that it can be again.

Kept in the store and beside recorded frames. ``settings`` is the whole tree as JSON with all defaults filled in,
``calibration`` the text of the calibration file; neither holds secrets, which stand in files of their own.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeVar

from pydantic import BaseModel, TypeAdapter, ValidationError

from inspector import calibration_file
from inspector.acquire import light
from inspector.acquire.light import LightSettings
from inspector.judge.spc.settings import StatisticsSettings
from inspector.model import Image
from inspector.optics import Calibration
from inspector.panel_settings import PanelSettings
from inspector.recipe import Recipe
from inspector.settings import Settings, configuration_hash

ModelT = TypeVar("ModelT", bound=BaseModel)


class VersionWrong(ValueError):
    """A kept version of settings cannot be used; the message says why."""


@dataclass(frozen=True)
class SettingsVersion:
    """``name`` is the configuration hash in hexadecimal, as sessions and registers show it."""

    name: str
    settings: Mapping[str, Any]
    calibration_text: str

    @cached_property
    def calibration(self) -> Calibration:
        """The geometry. Raises VersionWrong."""
        try:
            return calibration_file.parse(self.calibration_text, f"calibration of settings {self.name}")
        except calibration_file.CalibrationError as error:
            raise VersionWrong(str(error)) from error

    @cached_property
    def recipe(self) -> Recipe:
        """The recipe in use. Raises VersionWrong."""
        return self._part(Recipe, "recipe")

    @cached_property
    def recipes(self) -> tuple[Recipe, ...]:
        """The recipes that PLC and people choose from. Raises VersionWrong."""
        try:
            return TypeAdapter(tuple[Recipe, ...]).validate_json(json.dumps(self.settings.get("recipes", ())))
        except ValidationError as error:
            raise self._not_known("recipes", error) from error

    @cached_property
    def panel(self) -> PanelSettings:
        """What made a panel of frames. Raises VersionWrong."""
        return self._part(PanelSettings, "panel")

    @cached_property
    def light(self) -> LightSettings | None:
        """The reference patch in the frame, which is not inspected. Raises VersionWrong."""
        return None if self.settings.get("light") is None else self._part(LightSettings, "light")

    @cached_property
    def statistics(self) -> StatisticsSettings:
        """The statistics of the paint line. Raises VersionWrong."""
        return self._part(StatisticsSettings, "statistics")

    def without_patch(self, image: Image) -> Image:
        """The image (H, W) as it was inspected."""
        return image if self.light is None else light.without(image, self.light.patch)

    def _part(self, model: type[ModelT], key: str) -> ModelT:
        try:
            return model.model_validate_json(json.dumps(self.settings[key]))
        except (KeyError, ValidationError) as error:
            raise self._not_known(key, error) from error

    def _not_known(self, key: str, error: Exception) -> VersionWrong:
        what = f"settings {self.name}: {key} is not one of this program's: {' '.join(str(error).split())}"
        return VersionWrong(f"{what}; replay them with the program that wrote them")

    def as_json(self) -> str:
        """The version as a file keeps it."""
        said = {"configuration_hash": self.name, "settings": self.settings, "calibration": self.calibration_text}
        return json.dumps(said, ensure_ascii=False, indent=1) + "\n"


def of(settings: Settings) -> SettingsVersion:
    """The version that these settings are. Raises OSError if the calibration file cannot be read."""
    name = f"{configuration_hash(settings):08x}"
    calibration = settings.calibration.read_text(encoding="utf-8")
    return SettingsVersion(name, settings.model_dump(mode="json"), calibration)


def from_json(text: str) -> SettingsVersion:
    """The version in a file's text. Raises VersionWrong."""
    try:
        said = json.loads(text)
        return SettingsVersion(str(said["configuration_hash"]), dict(said["settings"]), str(said["calibration"]))
    except (ValueError, KeyError, TypeError) as error:
        raise VersionWrong(f"not a version of settings: {error}") from error
