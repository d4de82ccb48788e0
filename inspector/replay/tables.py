"""The tables that `inspector reinspect` writes: a row for each recorded frame, and one for each seed of these.

What a column means and its unit stands in :data:`FRAMES` and :data:`SEEDS`, from which the Parquet files' schema, the
values and the manual's page are made.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from inspector.model import Defect, FrameResult, PanelResult
from inspector.replay.comparison import Compared, Seed, same, seeds
from inspector.sessions import RecordedFrame

COUNTS = b"inspector.counts"
"""Key of a file's metadata under which it says what came out."""


@dataclass(frozen=True, slots=True)
class Column:
    """A column: its name, Arrow's name of its type, what it says with its unit, and its value of a row's source."""

    name: str
    kind: str
    says: str
    of: Callable[[Any], Any]


@dataclass(frozen=True, slots=True)
class FrameRow:
    """What a row about a frame is made of. ``root``: sessions are named by their path from there."""

    root: str
    one: Compared

    @property
    def session(self) -> str:
        """The session's folder, from the root."""
        return os.path.relpath(self.one.item.folder, self.root)

    @property
    def recorded(self) -> RecordedFrame | None:
        """The frame; None: its line cannot be read."""
        return self.one.item if isinstance(self.one.item, RecordedFrame) else None

    def taken(self, name: str) -> Any:
        """What its line says of how it was taken."""
        return getattr(self.recorded.recorded, name) if self.recorded else None

    def inspected(self, name: str) -> Any:
        """What its line says of its inspection."""
        said = self.recorded.inspected if self.recorded else None
        return getattr(said, name) if said else None

    @property
    def alike(self) -> bool | None:
        """Whether the frame is found as it was; None: not compared."""
        then, now = self.one.then, self.one.now
        return None if then is None or now is None else same(then, now)

    @property
    def panel_alike(self) -> bool | None:
        """Whether its panel is judged as it was; None: not compared."""
        then, now = self.one.panel_then, self.one.panel
        return None if then is None or now is None else same(then, now)


@dataclass(frozen=True, slots=True)
class SeedRow:
    """What a row about a seed is made of."""

    frame: FrameRow
    number: int
    seed: Seed


Result = FrameResult | PanelResult | None


def _verdicts(prefix: str, what: str, of: Callable[[FrameRow], Result]) -> list[Column]:
    """Columns about a result."""

    def said(value: Callable[[FrameResult | PanelResult], Any]) -> Callable[[FrameRow], Any]:
        return lambda row: None if (result := of(row)) is None else value(result)

    return [
        Column(f"{prefix}_verdict", "string", f"{what}: PASS, FAIL or NOT_INSPECTED", said(lambda r: r.verdict.name)),
        Column(f"{prefix}_reasons", "int32", f"{what}: bits of the reason word", said(lambda r: int(r.reasons))),
        Column(f"{prefix}_reasons_text", "string", f"{what}: why", said(lambda r: "; ".join(r.reasons_text))),
        Column(f"{prefix}_seeds", "int32", f"{what}: seeds", said(lambda r: len(r.defects))),
        Column(f"{prefix}_unpaired", "int32", f"{what}: lone spots", said(lambda r: len(r.unpaired))),
    ]


def _taken(name: str, kind: str, says: str) -> Column:
    return Column(name, kind, says, lambda row: row.taken(name))


def _inspected(name: str, kind: str, says: str) -> Column:
    return Column(name, kind, says, lambda row: row.inspected(name))


FRAMES = [
    Column("session", "string", "the session's folder, from the archive's", lambda row: row.session),
    _taken("file", "string", "the image beside the index; null: its line cannot be read"),
    _taken("frame_id", "int64", "the camera's number of the frame"),
    _taken("taken_at_s", "float64", "when it was taken, Unix time, s"),
    _taken("exposure_us", "float64", "exposure as read back, us; null: not known"),
    _taken("lamp_v", "float64", "lamp level as read back, V; null: not known"),
    _inspected("settings", "string", "the settings that it was inspected by, their hash"),
    _inspected("sequence", "int64", "the result that it is of; null: of none"),
    _inspected("panel_id", "int64", "its panel, as the PLC gave it; null: it gave none"),
    _inspected("number", "int32", "which of its panel's frames it is, from 0"),
    _inspected("frames", "int32", "frames of its panel"),
    _inspected("travel_mm", "float64", "how far the panel had moved since its first frame, mm"),
    Column("problem", "string", "why it could not be compared; null: it was", lambda row: row.one.why or None),
    Column("same", "bool_", "whether it is found as it was, to the last bit", lambda row: row.alike),
    *_verdicts("then", "found when it was recorded", lambda row: row.one.then),
    *_verdicts("now", "found now", lambda row: row.one.now),
    Column("panel_problem", "string", "why its panel could not be judged again", lambda row: row.one.panel_why or None),
    Column("panel_same", "bool_", "with a panel's last frame: whether it is judged as it was", lambda r: r.panel_alike),
    *_verdicts("panel_then", "with a panel's last frame, judged then", lambda row: row.one.panel_then),
    *_verdicts("panel_now", "with a panel's last frame, judged now", lambda row: row.one.panel),
]  # fmt: skip
"""One row for each frame, and for each line that cannot be read."""


def _defects(prefix: str, when: str, which: int) -> list[Column]:
    """Columns about a seed as it was found ``which`` time."""

    def value(of: Callable[[Defect], Any]) -> Callable[[SeedRow], Any]:
        return lambda row: None if (defect := row.seed[which]) is None else of(defect)

    def field(name: str) -> Callable[[SeedRow], Any]:
        return value(lambda defect: getattr(defect, name))

    def column(name: str, says: str, of: Callable[[Defect], Any] | None = None, kind: str = "float64") -> Column:
        return Column(f"{prefix}_{name}", kind, f"{says}, {when}", value(of) if of else field(name))

    return [
        column("height_um", "height, um (null: not found)"),
        column("height_sigma_um", "its standard deviation, um"),
        column("x_mm", "place in the frame's world, x, mm"),
        column("y_mm", "place in the frame's world, y, mm"),
        column("place_sigma_mm", "standard deviation of its place, mm"),
        column("direct_x_px", "direct spot, x, px", lambda defect: defect.direct_px[0]),
        column("direct_y_px", "direct spot, y, px", lambda defect: defect.direct_px[1]),
        column("mirror_x_px", "mirror spot, x, px", lambda defect: defect.mirror_px[0]),
        column("mirror_y_px", "mirror spot, y, px", lambda defect: defect.mirror_px[1]),
        column("flags", "bits of what is unusual about it", lambda defect: int(defect.flags), "int32"),
        column("residual_sigma", "residual of its spare equation, sigma"),
        column("sunk_bias_um", "how far off it is read if half sunk, um"),
    ]


SEEDS = [
    Column("session", "string", "as in the frames' table", lambda row: row.frame.session),
    Column("file", "string", "as in the frames' table", lambda row: row.frame.taken("file")),
    Column("seed", "int32", "its number in the frame, from 0", lambda row: row.number),
    *_defects("then", "when it was recorded", 0),
    *_defects("now", "now", 1),
]
"""One row for each seed of a frame that was compared; the two findings of a seed stand in one row."""


@dataclass(frozen=True, slots=True)
class Written:
    """The two tables of some frames, as Parquet files' content."""

    frames: bytes
    seeds: bytes


def written(found: Iterable[Compared], root: str) -> Written:
    """The tables of these frames."""
    frames = [FrameRow(root, one) for one in found]
    rows = [
        SeedRow(frame, number, seed)
        for frame in frames
        if frame.one.then is not None and frame.one.now is not None
        for number, seed in enumerate(seeds(frame.one.then.defects, frame.one.now.defects))
    ]
    return Written(_parquet(FRAMES, frames, counts(frames)), _parquet(SEEDS, rows, {}))


def counts(rows: Sequence[FrameRow]) -> dict[str, int]:
    """What came out, in numbers that add up."""
    alike, panels = [row.alike for row in rows], [row.panel_alike for row in rows]
    return {
        "frames": len(alike) - alike.count(None),
        "frames_same": alike.count(True),
        "panels": len(panels) - panels.count(None),
        "panels_same": panels.count(True),
        "not_compared": sum(bool(row.one.why) + bool(row.one.panel_why) for row in rows),
    }


def _parquet(columns: Sequence[Column], rows: Sequence[Any], said: dict[str, int]) -> bytes:
    import pyarrow
    from pyarrow import parquet

    fields = [pyarrow.field(c.name, getattr(pyarrow, c.kind)(), metadata={"says": c.says}) for c in columns]
    schema = pyarrow.schema(fields, {COUNTS: json.dumps(said).encode()} if said else None)
    arrays = [pyarrow.array([c.of(row) for row in rows], f.type) for c, f in zip(columns, fields, strict=True)]
    sink = pyarrow.BufferOutputStream()
    parquet.write_table(pyarrow.Table.from_arrays(arrays, schema=schema), sink, compression="zstd")
    return bytes(sink.getvalue())


def as_markdown() -> str:
    """The manual's page on the tables."""
    lines = ["# What `inspector reinspect` writes", "", *PAGE.splitlines(), ""]
    for title, columns in (("Frames", FRAMES), ("Seeds", SEEDS)):
        lines += [f"## {title}", "", "| column | type | what it says |", "| --- | --- | --- |"]
        lines += [f"| {c.name} | {c.kind.rstrip('_')} | {c.says} |" for c in columns] + [""]
    return "\n".join(lines)


PAGE = """\
Generated by `inspector reinspect-columns`; edit `inspector/replay/tables.py` instead.

A folder as `--output` gets `frames/part-*.parquet` and `seeds/part-*.parquet`, in the order of their numbers; a file,
`NAME.parquet`, gets the frames, and `NAME.seeds.parquet` beside it the seeds. Rows are in the order of sessions by name
and of their lines. Each column's metadata says what it says here. "Then" is what was recorded, "now" what is found by
the settings asked for; whatever a null means besides "not known" or "not compared" is said."""
