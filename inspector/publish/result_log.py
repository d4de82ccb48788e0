"""Results in the journal: which of them, by the settings, and with fields that can be searched."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable
from typing import Literal

from firmware_bridge.strict import Strict
from inspector.model import Snapshot, Verdict
from inspector.publish import console

log = logging.getLogger(__name__)


class LogSettings(Strict):
    """What is logged."""

    results: Literal["fails", "all", "none"] = "fails"
    """Results that the journal is told: each FAIL and the first NOT_INSPECTED of a row, all, or none. On a terminal
    every result has its line."""


Tell = Callable[[LogSettings, Snapshot, str, tuple[str, ...]], None]
"""Is told a result, with the frame's name and reasons as :func:`inspector.publish.console.panel_line` takes them."""


def on_terminal(_: LogSettings, result: Snapshot, name: str, why: tuple[str, ...]) -> None:
    """Print the result's line, with colours where that is a terminal."""
    console.say(console.panel_line(result, name, why, coloured=sys.stdout.isatty()))


class ResultLog:
    """Tells the journal of results. Of a row that is not inspected for one reason, the first says it."""

    def __init__(self) -> None:
        self._uninspected: tuple[int, int] | None = None

    def tell(self, settings: LogSettings, result: Snapshot, name: str, why: tuple[str, ...]) -> None:
        """See :data:`Tell`."""
        is_new = self._is_new(result)
        wanted = {"fails": result.verdict is not Verdict.PASS and is_new, "all": True, "none": False}
        if wanted[settings.results]:
            text = console.panel_line(result, name, why, coloured=False)
            log.log(logging.INFO if result.verdict else logging.WARNING, "%s", text, extra=ids(result))

    def _is_new(self, result: Snapshot) -> bool:
        before = self._uninspected
        inspected = result.verdict is not Verdict.NOT_INSPECTED
        self._uninspected = None if inspected else (result.fault_code, result.reasons)
        return inspected or self._uninspected != before


def ids(result: Snapshot) -> dict[str, object]:
    """What a line about a result says it is about."""
    return {
        "panel_id": result.panel_id,
        "sequence": result.sequence,
        "frame_id": result.acquisition_id,
        "recipe_id": result.recipe_id,
        "fault_code": result.fault_code,
        "verdict": result.verdict.name,
    }
