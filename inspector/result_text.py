"""Frame results as text: JSON lines, CSV or a table. Each takes results one by one and yields lines as they come."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Callable, Iterable, Iterator, Sequence

from inspector.model import Defect, FrameResult, Unpaired

Cells = dict[str, object]

COLUMNS = (
    "frame",
    "verdict",
    "x_mm",
    "y_mm",
    "height_um",
    "height_sigma_um",
    "direct_x_px",
    "direct_y_px",
    "mirror_x_px",
    "mirror_y_px",
    "flags",
    "unpaired",
    "elapsed_us",
    "reasons",
)
"""Columns of the CSV."""
TABLE_COLUMNS = {
    "verdict": "<13",
    "x_mm": ">8",
    "y_mm": ">8",
    "height_um": ">9",
    "height_sigma_um": ">15",
    "flags": "<20",
    "frame": "",
}
"""Columns of the table with their alignment and width; the frame's name, which may be long, is last."""


def json_lines(results: Iterable[FrameResult]) -> Iterator[str]:
    """One JSON object a frame."""
    for result in results:
        yield json.dumps(as_dict(result), allow_nan=False)


def csv_lines(results: Iterable[FrameResult]) -> Iterator[str]:
    """A header, then one row a defect; a frame without defects has one row with those cells empty."""
    yield _csv_line(COLUMNS)
    for result in results:
        for row in _rows(result):
            yield _csv_line([row.get(column, "") for column in COLUMNS])


def table_lines(results: Iterable[FrameResult]) -> Iterator[str]:
    """The same rows with fewer columns, and the reasons on lines of their own, for people."""
    yield _table_line(dict(zip(TABLE_COLUMNS, TABLE_COLUMNS, strict=True)))
    for result in results:
        yield from map(_table_line, _rows(result))
        for text in result.reasons_text:
            yield f"  {text}"


FORMATS: dict[str, Callable[[Iterable[FrameResult]], Iterator[str]]] = {
    "jsonl": json_lines,
    "csv": csv_lines,
    "table": table_lines,
}


def as_dict(result: FrameResult) -> dict[str, object]:
    """The result as JSON shows it: lengths in mm, heights in um, null for what is not known or no number."""
    return {
        "frame": result.frame,
        "verdict": result.verdict.name,
        "reasons": list(result.reasons_text),
        "defects": [_defect(d) for d in result.defects],
        "unpaired": [_unpaired(u) for u in result.unpaired],
        "elapsed_us": round(result.elapsed_us, 1),
    }


def _defect(defect: Defect) -> dict[str, object]:
    return {
        "x_mm": _number(defect.x_mm),
        "y_mm": _number(defect.y_mm),
        "height_um": _number(defect.height_um),
        "height_sigma_um": _number(defect.height_sigma_um),
        "direct_px": [_number(v) for v in defect.direct_px],
        "mirror_px": [_number(v) for v in defect.mirror_px],
        "flags": list(defect.flags.names()),
    }


def _unpaired(spot: Unpaired) -> dict[str, object]:
    return {"x_px": _number(spot.x_px), "y_px": _number(spot.y_px), "flags": list(spot.flags.names())}


def _number(value: float | None) -> float | None:
    """The value, or None where JSON has no word for it."""
    return value if value is not None and math.isfinite(value) else None


def _rows(result: FrameResult) -> Iterator[Cells]:
    frame = {
        "frame": result.frame,
        "verdict": result.verdict.name,
        "unpaired": len(result.unpaired),
        "elapsed_us": round(result.elapsed_us, 1),
        "reasons": " | ".join(result.reasons_text),
    }
    for defect in result.defects:
        yield frame | _cells(defect)
    if not result.defects:
        yield frame


def _cells(defect: Defect) -> Cells:
    (direct_x, direct_y), (mirror_x, mirror_y) = defect.direct_px, defect.mirror_px
    return {
        "x_mm": defect.x_mm,
        "y_mm": defect.y_mm,
        "height_um": defect.height_um,
        "height_sigma_um": "" if defect.height_sigma_um is None else defect.height_sigma_um,
        "direct_x_px": direct_x,
        "direct_y_px": direct_y,
        "mirror_x_px": mirror_x,
        "mirror_y_px": mirror_y,
        "flags": " ".join(defect.flags.names()),
    }


def _csv_line(cells: Sequence[object]) -> str:
    line = io.StringIO()
    csv.writer(line, lineterminator="").writerow(cells)
    return line.getvalue()


def _table_line(row: Cells) -> str:
    cells = {name: row.get(name, "") for name in TABLE_COLUMNS}
    texts = {name: f"{cell:.2f}" if isinstance(cell, float) else str(cell) for name, cell in cells.items()}
    return "  ".join(format(texts[name], alignment) for name, alignment in TABLE_COLUMNS.items())
