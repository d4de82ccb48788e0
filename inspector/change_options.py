"""What a command was asked to inspect recorded frames by, read from files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from inspector import calibration_file, settings_version, yaml_document
from inspector.calibration_file import CalibrationError
from inspector.recipe import Recipe
from inspector.reinspection import Change
from inspector.settings import SettingsError, load


class Unusable(Exception):
    """What was asked for cannot be done; the message says why."""


@dataclass(frozen=True, slots=True)
class Asked:
    """Files and a method to use instead of what was recorded; None: as recorded."""

    recipe: Path | None = None
    calibration: Path | None = None
    method: str | None = None
    config: Path | None = None

    @property
    def anything(self) -> bool:
        """Whether anything is to be other than recorded."""
        return self != Asked()


def change_of(asked: Asked) -> Change:
    """The change that was asked for. Raises Unusable with every problem of a file."""
    try:
        version = settings_version.of(load(asked.config)) if asked.config else None
        text = asked.calibration.read_text(encoding="utf-8") if asked.calibration else None
        if text is not None:
            calibration_file.parse(text, str(asked.calibration))
    except (SettingsError, CalibrationError) as error:
        raise Unusable(str(error)) from error
    except OSError as error:
        raise Unusable(f"{error.filename}: cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise Unusable(f"{asked.calibration}: is no text ({error.reason})") from error
    return Change(version, recipe_of(asked.recipe) if asked.recipe else None, text, asked.method)


def recipe_of(path: Path) -> Recipe:
    """The recipe in a file. Raises Unusable."""
    recipe, problems = yaml_document.validate(yaml_document.read(path), Recipe)
    if recipe is None or problems:
        raise Unusable("\n".join([f"{path} is not a recipe:", *map(str, problems)]))
    return recipe
