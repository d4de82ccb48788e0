"""What goes into the store, as rows: made where it happens, written where nothing waits for it.

The store fills in what only it knows: the run, and with it the id of a result, of which rows here give the sequence.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from inspector.model import Defect, Frame, FrameResult, Snapshot


@dataclass(frozen=True, slots=True)
class Rows:
    """Rows of one table. ``of_result``: the first value is a result's sequence, and the store puts its id there;
    ``of_run``: the store adds the run."""

    table: str
    columns: tuple[str, ...]
    values: tuple[tuple[Any, ...], ...]
    of_result: bool = False
    of_run: bool = False


@dataclass(frozen=True, slots=True)
class Taken:
    """A frame of a result: what was found in it, what it was to be taken at, and how far its panel had moved."""

    frame: Frame
    result: FrameResult
    exposure_set_us: float
    lamp_set_v: float
    travel_mm: float = 0.0


@dataclass(frozen=True, slots=True)
class Place:
    """Where a frame is kept, relative to the archive, and why."""

    kept: str
    image: str


Entry = tuple[Rows, ...]
"""What is written together, or not at all."""


def of_result(
    shown: Snapshot,
    at_s: float,
    texts: Sequence[str],
    frames: Sequence[Taken],
    places: Sequence[Place | None],
    names: tuple[str, str],
) -> Entry:
    """A result with its frames and defects. ``names`` of the versions of settings and recipe, ``places`` of frames."""
    heights = [d.height_um for d in shown.defects if math.isfinite(d.height_um)]
    result = {
        "id": shown.sequence,
        "sequence": shown.sequence,
        "at_s": at_s,
        "panel_id": shown.panel_id,
        "verdict": int(shown.verdict),
        "reasons": int(shown.reasons),
        "reasons_text": json.dumps(list(texts), ensure_ascii=False),
        "fault_code": int(shown.fault_code),
        "settings": names[0],
        "recipe": names[1],
        "recipe_id": shown.recipe_id,
        "defect_count": len(shown.defects),
        "unpaired_count": shown.unpaired_count,
        "largest_height_um": max(heights, default=None),
        "frame_count": len(frames),
        "area_m2": shown.extent.area_m2 if shown.extent else None,
        "acquisition_id": shown.acquisition_id,
        "lamp_set_v": shown.lamp_set_v,
        "lamp_read_v": shown.lamp_read_v,
        "exposure_us": shown.exposure_us,
        "elapsed_us": shown.elapsed_us,
        "cycle_us": shown.cycle_us,
        "missed_triggers": shown.missed_triggers,
        "simulated": int(shown.simulated),
        "degraded": int(shown.store_degraded),
    }
    rows = [Rows("result", tuple(result), (tuple(result.values()),), of_result=True)]
    if frames:
        values = (_frame(shown.sequence, n, *pair) for n, pair in enumerate(zip(frames, places, strict=True)))
        rows.append(Rows("frame", _FRAME, tuple(values), of_result=True))
    if shown.defects:
        rows.append(Rows("defect", _DEFECT, tuple(_defects(shown.sequence, shown.defects)), of_result=True))
    return tuple(rows)


_FRAME = (
    "result",
    "number",
    "frame_id",
    "name",
    "taken_at_s",
    "exposure_us",
    "exposure_set_us",
    "lamp_v",
    "lamp_set_v",
    "travel_mm",
    "verdict",
    "reasons",
    "kept",
    "image",
)
_DEFECT = (
    "result",
    "number",
    "x_mm",
    "y_mm",
    "height_um",
    "height_sigma_um",
    "direct_x_px",
    "direct_y_px",
    "mirror_x_px",
    "mirror_y_px",
    "flags",
    "residual_sigma",
    "sunk_bias_um",
    "place_sigma_mm",
)


def _frame(sequence: int, number: int, taken: Taken, place: Place | None) -> tuple[Any, ...]:
    frame, result = taken.frame, taken.result
    return (
        sequence,
        number,
        frame.frame_id,
        frame.name,
        frame.taken_at_s,
        frame.exposure_us,
        taken.exposure_set_us,
        frame.lamp_v,
        taken.lamp_set_v,
        taken.travel_mm,
        int(result.verdict),
        int(result.reasons),
        place.kept if place else None,
        place.image if place else None,
    )


def _defects(sequence: int, defects: Sequence[Defect]) -> Iterator[tuple[Any, ...]]:
    """One row a defect, in the result's order. What is no number is null there, as SQLite keeps it."""
    for number, d in enumerate(defects):
        places = (d.x_mm, d.y_mm, d.height_um, d.height_sigma_um, *d.direct_px, *d.mirror_px)
        yield (sequence, number, *places, int(d.flags), d.residual_sigma, d.sunk_bias_um, d.place_sigma_mm)


def settings_version(name: str, at_s: float, text: str) -> Entry:
    """A version of the settings, whole; known ones stay as they are."""
    return (Rows("settings_version", ("name", "first_used_s", "text"), ((name, at_s, text),)),)


def recipe_version(name: str, recipe_id: int, title: str, at_s: float, text: str) -> Entry:
    """A version of a recipe, whole; known ones stay as they are."""
    columns = ("hash", "recipe_id", "name", "first_used_s", "text")
    return (Rows("recipe_version", columns, ((name, recipe_id, title, at_s, text),)),)


def fault(began_s: float, code: int, sequence: int, ended_s: float | None = None) -> Entry:
    """A fault that began after the result ``sequence``; the same again when it ends."""
    columns = ("began_s", "code", "sequence", "ended_s")
    return (Rows("fault", columns, ((began_s, code, sequence, ended_s),), of_run=True),)


def action(at_s: float, who: str, what: str, detail: str = "") -> Entry:
    """Something that a person or the PLC did to the station."""
    return (Rows("action", ("at_s", "who", "what", "detail"), ((at_s, who, what, detail),), of_run=True),)


def lamp(at_s: float, burnt_hours: float) -> Entry:
    """How long the bulb has burnt."""
    return (Rows("lamp", ("at_s", "burnt_hours"), ((at_s, burnt_hours),), of_run=True),)
