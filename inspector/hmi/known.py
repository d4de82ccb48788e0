"""What the page takes from the station's settings: recipes by name, the plant's words for actions, the panel's map."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from inspector import calibration_file, panel_map
from inspector.hmi.look import Look
from inspector.hmi.texts import Texts
from inspector.hmi.view import Known
from inspector.judge.spc.actions import code_of
from inspector.model import Defect, Flag, PanelResult, Verdict
from inspector.recipe import Recipe, content_hash
from inspector.settings import Settings, SettingsError, load

AGAIN_S = 5.0
"""The settings file is not read more often: a reload of the service changes it, not a browser that asks much."""
MAP_SIZE = 3.0
"""Letters and marks of the map, so that they are read from where a line is."""


class Settled:
    """The settings as they were read last; read again, after a while, when somebody wants the recipes."""

    def __init__(
        self, file: Path, settings: Settings, texts: Texts, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._file, self._settings, self._clock, self._texts = file, settings, clock, texts
        self._lock, self._read_s = threading.Lock(), clock()
        self.why_stale = ""
        """Why the file cannot be read just now; empty if it can."""
        self.known = _known(settings, texts)

    def refresh(self) -> None:
        """Read the file again if that is some time ago; settings that are wrong leave the old ones."""
        with self._lock:
            if self._clock() < self._read_s + AGAIN_S:
                return
            self._read_s = self._clock()
            try:
                self._settings, self.why_stale = load(self._file, secrets=False), ""
            except SettingsError as error:
                self.why_stale = str(error.problems[0])
            self.known = _known(self._settings, self._texts)

    def drawn(self, look: Look) -> str | None:
        """The map of the result that is shown, SVG; None if there is none."""
        block = look.block
        if block is None or not look.listed_for:
            return None
        if _used(block, self._settings) is None:
            self.refresh()
        settings = self._settings
        camera, recipe = calibration_file.read(settings.calibration).camera, _used(block, settings)
        panel = PanelResult(
            Verdict(block["verdict"]),
            defects=tuple(map(_defect, look.defects)),
            travels_mm=() if settings.panel.several else (0.0,),
        )
        limits, area = recipe.limits if recipe else None, settings.panel.area
        return panel_map.svg(panel, camera, (0.0, 0.0), limits, area, size=MAP_SIZE, banner=False)


def _known(settings: Settings, texts: Texts) -> Known:
    recipes = sorted(settings.recipes or (settings.recipe,), key=lambda recipe: recipe.id)
    advice = {int(code_of(row)): row.text for row in reversed(settings.statistics.actions) if code_of(row) >= 100}
    return Known(tuple(recipes), advice, texts)


def _used(block: Mapping[str, Any], settings: Settings) -> Recipe | None:
    """The recipe of the result, if the settings still have it word for word."""
    recipes = settings.recipes or (settings.recipe,)
    return next((r for r in recipes if r.id == block["recipe_id"] and content_hash(r) == block["recipe_hash"]), None)


def _defect(seed: Mapping[str, Any]) -> Defect:
    x_mm, y_mm, height_um = (math.nan if seed[n] is None else float(seed[n]) for n in ("x_mm", "y_mm", "height_um"))
    sigma_um, nowhere = seed["height_sigma_um"], (math.nan, math.nan)
    return replace(Defect(x_mm, y_mm, height_um, sigma_um, nowhere, nowhere), flags=Flag(int(seed["flags"])))
