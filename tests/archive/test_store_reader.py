"""The store on a medium that nobody may write to: it is read where that is safe, and refused where it is not."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import pytest
from typer.testing import CliRunner

from inspector.archive import entries
from inspector.archive.store import FILE, Run, Store
from inspector.archive_reading.store_reader import ArchiveUnreadable, StoreReader
from inspector.cli.app import app
from inspector.model import Snapshot, Verdict

COUNT = "SELECT count(*) FROM result"


def opened(archive: Path) -> closing[Store]:
    archive.mkdir(exist_ok=True)
    return closing(Store(archive, Run(1000.0, "0.1.0", "line 2")))


def results(sequences: range) -> list[entries.Entry]:
    shown = [Snapshot(sequence=n, verdict=Verdict.PASS) for n in sequences]
    return [entries.of_result(snapshot, 50.0, (), [], [], ("0a", "0b")) for snapshot in shown]


@pytest.fixture
def read_only(tmp_path: Path) -> Iterator[Callable[[Path], Path]]:
    """``read_only(folder)``: where its files are seen by who may not write them, not even root."""
    if os.geteuid() != 0:
        pytest.skip("peer missing: root, who alone mounts a folder (sudo)")
    medium = tmp_path / "medium"
    medium.mkdir()

    def mounted(folder: Path) -> Path:
        for options in (["--bind", str(folder)], ["-o", "remount,bind,ro"]):
            done = subprocess.run(["mount", *options, str(medium)], capture_output=True, text=True, timeout=60)
            if done.returncode:
                pytest.skip(f"no medium here: {done.stderr}")
        return medium

    yield mounted
    subprocess.run(["umount", "--lazy", str(medium)], capture_output=True, timeout=60)


def test_an_archive_on_a_read_only_medium_is_exported(tmp_path: Path, read_only: Callable[[Path], Path]) -> None:
    with opened(tmp_path / "archive") as store:
        store.write(results(range(1, 4000)))
    medium = read_only(tmp_path / "archive")
    assert [path.name for path in medium.iterdir()] == [FILE]
    done = CliRunner().invoke(app, ["export", "--output", str(tmp_path / "out.jsonl"), str(medium)])
    assert (done.exit_code, done.stderr) == (0, "")
    lines = (tmp_path / "out.jsonl").read_text().splitlines()
    assert [json.loads(line)["sequence"] for line in lines] == list(range(1, 4000))


def test_a_service_that_begins_to_write_there_meanwhile_is_told(
    tmp_path: Path, read_only: Callable[[Path], Path]
) -> None:
    with opened(tmp_path / "archive") as store:
        store.write(results(range(1, 9)))
    medium = read_only(tmp_path / "archive")
    reader = StoreReader(medium)
    with opened(tmp_path / "archive") as service:
        service.write(results(range(9, 17)))
        assert tuple(reader.row(COUNT) or ()) == (8,)
        with pytest.raises(ArchiveUnreadable, match="began to write meanwhile"):
            reader.__exit__(None, None, None)
        with StoreReader(medium) as later:
            assert tuple(later.row(COUNT) or ()) == (16,)


def test_results_in_a_log_that_cannot_be_worked_in_are_not_left_out(
    tmp_path: Path, read_only: Callable[[Path], Path]
) -> None:
    killed = tmp_path / "killed"
    with opened(tmp_path / "archive") as store:
        store.write(results(range(1, 9)))
        killed.mkdir()
        for name in (FILE, f"{FILE}-wal"):
            shutil.copy(tmp_path / "archive" / name, killed)
    with pytest.raises(ArchiveUnreadable, match=f"copy it with {FILE}-wal"):
        StoreReader(read_only(killed))
    with StoreReader(killed) as reader:
        assert tuple(reader.row(COUNT) or ()) == (8,)
