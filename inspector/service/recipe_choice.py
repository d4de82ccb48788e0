"""The PLC's last choice of a recipe, kept over restarts in a small file.

Of two choices the later one holds. The file says what the PLC chose and what the settings chose at that time: where
the settings have chosen another one since, that is the later choice, and the file's is past.
"""

from __future__ import annotations

import json
import logging
from pathlib import Path

from firmware_bridge import whole_file
from inspector.recipe import find
from inspector.settings import Settings

log = logging.getLogger(__name__)


def resumed(settings: Settings) -> Settings:
    """The settings as read from their file, with the PLC's choice where that is the later one.

    A file that cannot be used is said in the log, and the settings hold.
    """
    file = settings.recipe_choice_file
    if file is None or not file.exists():
        return settings
    try:
        said = json.loads(file.read_text(encoding="utf-8"))
        chosen_id, instead_of_id = int(said["recipe_id"]), int(said["settings_recipe_id"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        log.error("%s: cannot be used (%s); the settings' recipe %d holds", file, error, settings.recipe.id)
        return settings
    if instead_of_id != settings.recipe.id:
        return settings
    chosen = find(settings.recipes, chosen_id)
    if chosen is None:
        log.error("%s: recipe %d is no longer there; the settings' recipe %d holds", file, chosen_id, instead_of_id)
        return settings
    return settings.model_copy(update={"recipe": chosen})


def keep(file: Path, recipe_id: int, settings_recipe_id: int) -> None:
    """Keep what the PLC chose, and instead of which recipe of the settings. Raises OSError."""
    said = {"recipe_id": recipe_id, "settings_recipe_id": settings_recipe_id}
    whole_file.write(file, json.dumps(said) + "\n")
