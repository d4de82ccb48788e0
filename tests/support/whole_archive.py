"""An archive looked through as a reader finds it, whatever became of the process or the disk that it was written on."""

from __future__ import annotations

import shutil
import sqlite3
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import cv2

from firmware_bridge.wire import session
from inspector.archive import result_json
from inspector.archive.session_frames import inspected, version_file
from inspector.archive.store import FILE
from inspector.model import Frame
from inspector.pipeline import Station, inspect
from inspector.settings_version import from_json


def sequences(archive: Path, beside: Path) -> list[int]:
    """Sequences of the results, in the order in which they were made, of a store that is sound.

    It is read as a copy in the folder ``beside``: whoever opens a store that was killed works its log into it.
    """
    beside.mkdir(exist_ok=True)
    for suffix in ("", "-wal"):
        with suppress(FileNotFoundError):
            (beside / f"{FILE}{suffix}").unlink()
        with suppress(FileNotFoundError):
            shutil.copy(archive / f"{FILE}{suffix}", beside)
    if not (beside / FILE).exists():
        return []
    with closing(sqlite3.connect(beside / FILE)) as store:
        assert store.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
        if not store.execute("SELECT 1 FROM sqlite_master WHERE name = 'result'").fetchall():
            return []
        lone = "SELECT count(*) FROM result WHERE frame_count <> (SELECT count(*) FROM frame WHERE result = id)"
        assert store.execute(lone).fetchone() == (0,), "a result without its frames"
        lone = "SELECT count(*) FROM result WHERE defect_count <> (SELECT count(*) FROM defect WHERE result = id)"
        assert store.execute(lone).fetchone() == (0,), "a result without its defects"
        return [row[0] for row in store.execute("SELECT sequence FROM result ORDER BY id")]


class Images:
    """The images of an archive; what was looked at once is not looked at again."""

    def __init__(self, archive: Path) -> None:
        self._archive = archive
        self._stations: dict[str, Station] = {}
        self._whole: set[Path] = set()
        self.inspected = 0

    def check(self, every: int = 20) -> int:
        """Every image under a final name is whole and every line of an index names one; one in ``every`` of these is
        inspected again, to the same result. How many images there are."""
        for path in self._archive.glob("*/*/*.png"):
            if path not in self._whole:
                assert cv2.imread(str(path), cv2.IMREAD_UNCHANGED) is not None, f"half an image: {path}"
                self._whole.add(path)
        for index in self._archive.glob(f"*/*/{session.INDEX}"):
            if index.parent.name.startswith("."):
                continue
            lines = session.parse(index.read_text())
            for number, line in enumerate(lines):
                assert index.with_name(line.file).exists(), f"{index} names {line.file}, which is not there"
                if number % every == 0:
                    self._inspect(index.parent, line)
        return len(self._whole)

    def _inspect(self, folder: Path, line: Any) -> None:
        said = inspected(line)
        assert said is not None
        station = self._stations.get(said.settings)
        if station is None:
            version = from_json((folder / version_file(said.settings)).read_text())
            station = self._stations[said.settings] = Station(version.calibration, version.recipe)
        image = cv2.imread(str(folder / line.file), cv2.IMREAD_UNCHANGED)
        assert result_json.same(inspect(Frame(image, line.file), station), said.result), folder / line.file
        self.inspected += 1
