"""The tables that `inspector export` writes: what a column means, its unit, and where in the store its value is.

The files' columns, the queries and the manual's page are made from these.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from inspector.archive.schema import RUN_BITS
from inspector.faults import Fault
from inspector.model import Flag, Reason, Verdict

LOW = (1 << RUN_BITS) - 1


@dataclass(frozen=True, slots=True)
class Column:
    """A column: name, kind (Arrow's name of a type, or "time"), what it says, SQL for its value, and what is made of
    that; None stays None."""

    name: str
    kind: str
    says: str
    sql: str
    of: Callable[[Any], Any] | None = None


@dataclass(frozen=True, slots=True)
class Table:
    """Rows: where they come from, in which order; SQL for a row's time, for the end of it where it lasts, for its
    sequence, and for its recipe's id and hash, where it has them."""

    says: str
    source: str
    order: str
    columns: tuple[Column, ...]
    at: str = "r.at_s"
    until: str | None = None
    sequence: str | None = "r.sequence"
    recipe: tuple[str, str] | None = ("r.recipe_id", "r.recipe")


def _verdict(number: int) -> str:
    return Verdict(number).name


def _reasons(bits: int) -> str:
    return " ".join(str(reason.name).lower() for reason in Reason if reason & bits)


def _flags(bits: int) -> str:
    return " ".join(Flag(bits).names())


def _sentences(text: str) -> str:
    return "; ".join(json.loads(text))


def meaning(code: int) -> str | None:
    """What a fault code means; None: it is not one of this program's."""
    return next((fault.meaning for fault in Fault if fault == code), None)


def _plain(kind: str, of: str, **says: str) -> list[Column]:
    """Columns that are the store's own."""
    return [Column(name, kind, text, f"{of}.{name}") for name, text in says.items()]


STATION = Column("station", "string", "the station's name", "u.station")
OF_RESULT = [
    Column("id", "int64", "names the result for good: run in the upper 32 bits, sequence in the lower", "r.id"),
    Column("run", "int64", "the service from its start to its end, counted", f"r.id >> {RUN_BITS}"),
    Column("sequence", "int64", "the result's number, as the PLC read it", "r.sequence"),
    Column("at", "time", "when the result was there", "r.at_s"),
    Column("panel_id", "int64", "the panel's number: as the PLC gave it, else counted", "r.panel_id"),
]
VERDICT = [
    Column("verdict", "string", "PASS, FAIL or NOT_INSPECTED", "r.verdict", _verdict),
    Column("reasons", "int64", "bits of the reason word, as in the registers", "r.reasons"),
    Column("reasons_names", "string", "their names", "r.reasons", _reasons),
    Column("reasons_text", "string", "a sentence for each reason", "r.reasons_text", _sentences),
]
RECIPE = [
    Column("recipe_id", "int64", "the recipe, by number", "r.recipe_id"),
    Column("recipe_name", "string", "the recipe's name; null: not kept", "v.name"),
    Column("recipe", "string", "hash of the recipe's content", "r.recipe"),
    Column("settings", "string", "hash of what inspection depends on, and the calibration", "r.settings"),
]
RESULTS = Table(
    "A row for each result, as the PLC was shown it.",
    "result r LEFT JOIN recipe_version v ON v.hash = r.recipe",
    "r.id",
    (
        *OF_RESULT,
        *VERDICT,
        *_plain("int64", "r", fault_code="the fault that stood; 0: none"),
        *RECIPE,
        *_plain("int64", "r", defect_count="seeds", unpaired_count="highlights without a partner"),
        *_plain("float64", "r", largest_height_um="the highest seed, um; null: none has a height"),
        *_plain("int64", "r", frame_count="frames of the panel"),
        *_plain("float64", "r", area_m2="area seen, m2; null: that of one frame"),
        *_plain("int64", "r", acquisition_id="the camera's number of the last frame"),
        *_plain("float64", "r", lamp_set_v="lamp level asked for, V", lamp_read_v="lamp level read back, V"),
        *_plain("float64", "r", exposure_us="exposure as read back, us", elapsed_us="time of the inspection, us"),
        *_plain("float64", "r", cycle_us="time of the whole cycle, us"),
        *_plain("int64", "r", missed_triggers="triggers missed so far"),
        Column("simulated", "bool_", "the camera was a simulated or replayed one", "r.simulated", bool),
        Column("degraded", "bool_", "shown with STORE_DEGRADED", "r.degraded", bool),
    ),
)
SUMMED = "(SELECT {} FROM {} WHERE result = r.id)"
PANELS = Table(
    "A row for each result again, for statistics: with its seeds and frames summed up, and the run it is of.",
    "result r LEFT JOIN recipe_version v ON v.hash = r.recipe LEFT JOIN run u ON u.id = r.id >> 32",
    "r.id",
    (
        *OF_RESULT,
        *VERDICT,
        *RECIPE,
        STATION,
        Column("program", "string", "the program's version", "u.program"),
        Column("seeds", "int64", "seeds", "r.defect_count"),
        Column("height_mean_um", "float64", "mean height, um; null: no seed has one",
               SUMMED.format("avg(height_um)", "defect")),
        Column("height_max_um", "float64", "the highest seed, um", "r.largest_height_um"),
        Column("area_m2", "float64", "area seen, m2; null: that of one frame", "r.area_m2"),
        Column("frames", "int64", "frames", "r.frame_count"),
        Column("frames_kept", "int64", "frames that were to be kept", SUMMED.format("count(image)", "frame")),
        Column("first_frame_at", "time", "exposure of the first frame", SUMMED.format("min(taken_at_s)", "frame")),
        Column("last_frame_at", "time", "exposure of the last frame", SUMMED.format("max(taken_at_s)", "frame")),
        Column("travel_mm", "float64", "how far it moved between these, mm", SUMMED.format("max(travel_mm)", "frame")),
    ),
)  # fmt: skip
DEFECTS = Table(
    "A row for each seed of each result.",
    "result r JOIN defect d ON d.result = r.id LEFT JOIN recipe_version v ON v.hash = r.recipe",
    "r.id, d.number",
    (
        *OF_RESULT,
        VERDICT[0],
        *RECIPE[:2],
        Column("number", "int64", "which of the result's seeds, from 0, the highest first", "d.number"),
        *_plain("float64", "d", x_mm="place on the panel, x, mm", y_mm="place on the panel, y, mm"),
        *_plain("float64", "d", height_um="height, um; null or infinite: it has none"),
        *_plain("float64", "d", height_sigma_um="its standard deviation, um; null: the method has none"),
        *_plain("float64", "d", direct_x_px="direct spot, x, px", direct_y_px="direct spot, y, px"),
        *_plain("float64", "d", mirror_x_px="mirror spot, x, px", mirror_y_px="mirror spot, y, px"),
        Column("flags", "int64", "bits of what is unusual about it", "d.flags"),
        Column("flags_names", "string", "their names", "d.flags", _flags),
        *_plain("float64", "d", residual_sigma="residual of its spare equation, sigma"),
        *_plain("float64", "d", sunk_bias_um="how far off it is read if half sunk, um"),
        *_plain("float64", "d", place_sigma_mm="standard deviation of its place, mm"),
    ),
)
FRAMES = Table(
    "A row for each frame of each result, kept or not.",
    "result r JOIN frame f ON f.result = r.id LEFT JOIN recipe_version v ON v.hash = r.recipe",
    "r.id, f.number",
    (
        *OF_RESULT,
        *_plain("int64", "f", number="which of the result's frames, from 0", frame_id="the camera's number of it"),
        *_plain("string", "f", name="the camera's name of it"),
        Column("taken_at", "time", "when it was exposed", "f.taken_at_s"),
        *_plain("float64", "f", exposure_us="exposure as read back, us; null: not known"),
        *_plain("float64", "f", exposure_set_us="exposure asked for, us"),
        *_plain("float64", "f", lamp_v="lamp level read back, V; null: not known", lamp_set_v="asked for, V"),
        *_plain("float64", "f", travel_mm="how far the panel had moved since its first frame, mm"),
        Column("frame_verdict", "string", "what this frame says by itself", "f.verdict", _verdict),
        Column("frame_reasons", "int64", "bits of the reason word", "f.reasons"),
        *_plain("string", "f", kept="why it was to be kept: failing, sample or last; null: it was not"),
        *_plain("string", "f", image="its file, from the archive's folder; old ones go"),
    ),
)
FAULTS = Table(
    "A row for each fault, in the order they began.",
    "fault f LEFT JOIN run u ON u.id = f.run",
    "f.began_s, f.code",
    (
        Column("began", "time", "when it began", "f.began_s"),
        Column("ended", "time", "when it ended; null: it lasts, or its run ended with it", "f.ended_s"),
        Column("duration_s", "float64", "how long it lasted, s", "f.ended_s - f.began_s"),
        *_plain("int64", "f", code="the fault code, as in the registers"),
        Column("meaning", "string", "what it means", "f.code", meaning),
        *_plain("int64", "f", run="the run that it was in", sequence="the last result before it"),
        STATION,
    ),
    at="f.began_s",
    until="coalesce(f.ended_s, u.ended_s, (SELECT min(n.started_s) FROM run n WHERE n.id > f.run), 9e99)",
    sequence="f.sequence",
    recipe=None,
)
ACTIONS = Table(
    "A row for each thing that a person or the PLC did to the station.",
    "action a LEFT JOIN run u ON u.id = a.run",
    "a.at_s",
    (
        Column("at", "time", "when", "a.at_s"),
        *_plain("int64", "a", run="the run that it was in"),
        *_plain("string", "a", who="who did it", what="what was done", detail="more of it"),
        STATION,
    ),
    at="a.at_s",
    sequence=None,
    recipe=None,
)
LAMP = Table(
    "A row for each time that the lamp's burning hours were written down.",
    "lamp l LEFT JOIN run u ON u.id = l.run",
    "l.at_s",
    (
        Column("at", "time", "when", "l.at_s"),
        *_plain("int64", "l", run="the run that it was in"),
        *_plain("float64", "l", burnt_hours="how long it had burnt, h, by `lamp.hours_file`; without, in this run"),
        STATION,
    ),
    at="l.at_s",
    sequence=None,
    recipe=None,
)
RUNS = Table(
    "A row for each run: the service from its start to its end.",
    "run u",
    "u.id",
    (
        *_plain("int64", "u", id="the run, counted"),
        Column("started", "time", "when it started", "u.started_s"),
        Column("ended", "time", "when it ended; null: it lasts, or was killed", "u.ended_s"),
        *_plain("string", "u", station="the station's name", program="the program's version"),
    ),
    at="u.started_s",
    until="coalesce(u.ended_s, (SELECT min(n.started_s) FROM run n WHERE n.id > u.id), 9e99)",
    sequence=None,
    recipe=None,
)
SETTINGS = Table(
    "A row for each version of the settings that was used.",
    "settings_version s",
    "s.first_used_s, s.name",
    (
        *_plain("string", "s", name="hash of what inspection depends on, and the calibration"),
        Column("first_used", "time", "when it was first used", "s.first_used_s"),
        *_plain("string", "s", text="all settings as they then were, and the calibration, JSON"),
    ),
    at="s.first_used_s",
    sequence=None,
    recipe=None,
)
RECIPES = Table(
    "A row for each version of a recipe that was used.",
    "recipe_version v",
    "v.first_used_s, v.hash",
    (
        *_plain("string", "v", hash="hash of the recipe's content"),
        *_plain("int64", "v", recipe_id="the recipe, by number"),
        *_plain("string", "v", name="its name"),
        Column("first_used", "time", "when it was first used", "v.first_used_s"),
        *_plain("string", "v", text="the whole of it, JSON"),
    ),
    at="v.first_used_s",
    sequence=None,
    recipe=("v.recipe_id", "v.hash"),
)
TABLES = {
    "results": RESULTS,
    "defects": DEFECTS,
    "frames": FRAMES,
    "faults": FAULTS,
    "actions": ACTIONS,
    "panels": PANELS,
    "lamp": LAMP,
    "runs": RUNS,
    "settings": SETTINGS,
    "recipes": RECIPES,
}


def as_markdown() -> str:
    """The manual's page on the tables."""
    lines = ["# What `inspector export` writes", "", *PAGE.splitlines(), ""]
    for name, table in TABLES.items():
        lines += [f"## {name}", "", table.says, "", "| column | type | what it says |", "| --- | --- | --- |"]
        lines += [f"| {c.name} | {c.kind.rstrip('_')} | {c.says} |" for c in table.columns] + [""]
    return "\n".join(lines)


PAGE = """\
Generated by `inspector export-columns`; edit `inspector/archive_reading/columns.py` instead.

Forms, by the ending of `--output`: `.csv` (a header; null is an empty cell), `.jsonl` (an object a line), `.json` (one
list of objects), `.parquet` (needs `pip install 'seed-inspector[export]'`; each column's metadata says what it says
here). Numbers have every digit that the store has. A time is ISO 8601 in UTC, in Parquet a timestamp in UTC, to the
microsecond. What is infinite is null in JSON.

`--from` and `--to` take times (from, to before) or sequences (both included); a fault or a run is of every time that it
lasted, settings and recipes are of the time when they were first used. Without them it is everything."""
