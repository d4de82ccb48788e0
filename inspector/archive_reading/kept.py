"""A result of the archive with all that was kept of it: its rows, and its frames, those that are gone named."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

from firmware_bridge.wire.session import SessionWrong
from inspector import sessions, settings_version
from inspector.archive.schema import RUN_BITS
from inspector.archive_reading.store_reader import StoreReader
from inspector.change_options import Unusable
from inspector.model import Defect, Flag
from inspector.sessions import RecordedFrame
from inspector.settings_version import SettingsVersion, VersionWrong

NOT_KEPT = "it was not kept: archive.frames says which frames are"
GONE = "it is gone: deleted when its time or the room for it was over (archive.frames), or not yet written"
NUMBERS = ("x_mm", "y_mm", "height_um", "height_sigma_um", "residual_sigma", "sunk_bias_um", "place_sigma_mm")


@dataclass(frozen=True, slots=True)
class KeptFrame:
    """A frame's row, and the frame as its session has it; None: ``why`` says why there is none."""

    row: sqlite3.Row
    item: RecordedFrame | None
    why: str = ""


@dataclass(frozen=True, slots=True)
class KeptResult:
    """A result's row, its seeds as stored, its frames, and the settings that it was found by; None: ``why`` says why
    these cannot be used."""

    row: sqlite3.Row
    recipe_name: str | None
    defects: tuple[Defect, ...]
    frames: tuple[KeptFrame, ...]
    version: SettingsVersion | None
    why: str = field(default="")


def by_name(store: StoreReader, name: str) -> sqlite3.Row:
    """The row of a result by its sequence (the latest of that number) or its id. Raises Unusable, ArchiveUnreadable."""
    if not (name.isascii() and name.isdigit() and len(name) < 19):
        raise Unusable(f"result {name!r}: allowed: its sequence, or its id of the store")
    column = "id" if int(name) >> RUN_BITS else "sequence"
    row = store.row(f"SELECT * FROM result WHERE {column} = ? ORDER BY id DESC LIMIT 1", (int(name),))
    return _there(store, row, f"no result {name}")


def of_panel(store: StoreReader, panel_id: int) -> sqlite3.Row:
    """The row of a panel's latest result. Raises Unusable, ArchiveUnreadable."""
    row = store.row("SELECT * FROM result WHERE panel_id = ? ORDER BY id DESC LIMIT 1", (panel_id,))
    return _there(store, row, f"no panel {panel_id}")


def _there(store: StoreReader, row: sqlite3.Row | None, what: str) -> sqlite3.Row:
    if row is not None:
        return row
    ends = store.row("SELECT min(sequence), max(sequence), count(*) FROM result")
    assert ends is not None
    there = f"there are {ends[2]}, sequences {ends[0]} to {ends[1]}" if ends[2] else "there are none yet"
    raise Unusable(f"{what} in {store.path}: {there}")


def kept(store: StoreReader, row: sqlite3.Row) -> KeptResult:
    """All that was kept of a result. Raises ArchiveUnreadable."""
    named = store.row("SELECT name FROM recipe_version WHERE hash = ?", (row["recipe"],))
    defects = defects_of(store, row["id"])
    rows = list(store.rows("SELECT * FROM frame WHERE result = ? ORDER BY number", (row["id"],)))
    frames = tuple(_frame(store.folder, frame) for frame in rows)
    version, why = None, ""
    try:
        version = version_of(store, row["settings"])
    except VersionWrong as error:
        why = str(error)
    return KeptResult(row, named[0] if named else None, defects, frames, version, why)


def defects_of(store: StoreReader, number: int) -> tuple[Defect, ...]:
    """The seeds of the result with this id, in its order. Raises ArchiveUnreadable."""
    rows = store.rows("SELECT * FROM defect WHERE result = ? ORDER BY number", (number,))
    return tuple(_defect(row) for row in rows)


def version_of(store: StoreReader, name: str) -> SettingsVersion:
    """A version of the settings, all of it known to this program. Raises VersionWrong, ArchiveUnreadable."""
    row = store.row("SELECT text FROM settings_version WHERE name = ?", (name,))
    if row is None:
        raise VersionWrong(f"its settings {name!r} were not kept")
    version = _version(row[0])
    version.calibration, version.recipe, version.panel  # noqa: B018  # what is wrong with them is said here
    return version


@lru_cache(maxsize=8)
def _version(text: str) -> SettingsVersion:
    return settings_version.from_json(text)


def _defect(row: sqlite3.Row) -> Defect:
    """A seed as stored; what is no number there is NaN, but for what a method may not have."""
    values = {name: row[name] for name in NUMBERS}
    for name in ("x_mm", "y_mm", "height_um"):
        values[name] = float("nan") if values[name] is None else values[name]
    direct, mirror = (row["direct_x_px"], row["direct_y_px"]), (row["mirror_x_px"], row["mirror_y_px"])
    return Defect(**values, direct_px=direct, mirror_px=mirror, flags=Flag(row["flags"]))


def _frame(archive: Path, row: sqlite3.Row) -> KeptFrame:
    if row["image"] is None:
        return KeptFrame(row, None, NOT_KEPT)
    for image in _places(archive, row["image"]):
        item = next((item for item in _session(image.parent) if _is_it(item, image, row)), None)
        if item is not None:
            return KeptFrame(row, item)
    return KeptFrame(row, None, f"{row['image']}: {GONE}")


def _places(archive: Path, image: str) -> Iterator[Path]:
    """Where the frame may be: as the store says, or linked into a session of the last ones."""
    yield archive / image
    yield from sorted(archive.glob(f"last/*/{Path(image).name}"))


def _is_it(item: RecordedFrame, image: Path, row: sqlite3.Row) -> bool:
    """Whether the line is of this frame; sequences, and with them names, may have come again."""
    recorded = item.recorded
    return recorded.file == image.name and recorded.taken_at_s == row["taken_at_s"] and image.is_file()


@lru_cache(maxsize=16)
def _session(folder: Path) -> Sequence[RecordedFrame]:
    try:
        return [item for item in sessions.read_session(folder) if isinstance(item, RecordedFrame)]
    except SessionWrong:
        return ()
