"""The results' store as a file: what is written is there, as others read it; what is no store is set aside, whole."""

from __future__ import annotations

import shutil
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from inspector.archive import entries
from inspector.archive.claim import Claim, StoreInUse, StoreUnavailable
from inspector.archive.schema import STEPS
from inspector.archive.store import (
    FILE,
    EntryRefused,
    Run,
    Store,
    StoreDamaged,
    set_aside,
)
from inspector.model import Defect, Flag, Frame, FrameResult, Snapshot, Verdict

RUN = Run(1000.0, "0.1.0", "line 2")
LATER = ("ALTER TABLE result ADD COLUMN gloss REAL NOT NULL DEFAULT 0.5; CREATE TABLE gloss (id INTEGER PRIMARY KEY)",)


def result(sequence: int, *heights_um: float) -> entries.Entry:
    defects = tuple(Defect(1.0, 2.0, h, 3.5, (4.0, 5.0), (6.0, 7.0), Flag.SATURATED) for h in heights_um)
    shown = Snapshot(sequence=sequence, panel_id=77, verdict=Verdict.FAIL, defects=defects)
    frame = Frame(np.zeros((2, 2), np.uint8), "a.png", 9, 1000.0, 4.0, 12.5)
    taken = entries.Taken(frame, FrameResult("a.png", Verdict.FAIL, defects=defects), 1000.0, 4.0)
    place = entries.Place("failing", "frames/x/a.png")
    return entries.of_result(shown, 50.0 + sequence, ("too high",), [taken], [place], ("0a", "0b"))


@contextmanager
def opened(folder: Path, **options: Any) -> Iterator[Store]:
    store = Store(folder, RUN, **options)
    try:
        yield store
    finally:
        store.close()


def read(folder: Path, sql: str) -> list[tuple[Any, ...]]:
    """What somebody else's SQLite reads."""
    with closing(sqlite3.connect(folder / FILE)) as other:
        return other.execute(sql).fetchall()


def test_a_result_is_there_for_other_readers_when_it_is_written(tmp_path: Path) -> None:
    with opened(tmp_path) as store:
        store.write([result(5, 1200.25, float("nan")), result(6)])
        assert read(tmp_path, "SELECT id >> 32, sequence, verdict, panel_id, reasons_text FROM result") == [
            (store.id, 5, 2, 77, '["too high"]'),
            (store.id, 6, 2, 77, '["too high"]'),
        ]
        heights = read(tmp_path, "SELECT height_um, flags FROM defect JOIN result ON result = id WHERE sequence = 5")
        assert heights == [(1200.25, 1), (None, 1)]
        assert read(tmp_path, "SELECT DISTINCT image, exposure_us FROM frame") == [("frames/x/a.png", 1000.0)]


def test_what_is_written_again_replaces_itself_and_a_version_stays(tmp_path: Path) -> None:
    with opened(tmp_path) as store:
        for text in ("first", "second"):
            store.write([result(1, 900.0), entries.settings_version("0a", 1.0, text), entries.fault(2.0, 301, 1)])
        store.write([entries.fault(2.0, 301, 1, 8.0)])
    assert read(tmp_path, "SELECT count(*) FROM defect") == [(1,)]
    assert read(tmp_path, "SELECT text FROM settings_version") == [("first",)]
    assert read(tmp_path, "SELECT began_s, ended_s, code FROM fault") == [(2.0, 8.0, 301)]


def test_runs_keep_their_results_apart_though_the_sequence_began_anew(tmp_path: Path) -> None:
    for number in (1, 2):
        store = Store(tmp_path, Run(1000.0 * number, "0.1.0", "line 2"))
        store.write([result(1)])
        store.close(ended_s=1500.0 * number)
    assert read(tmp_path, "SELECT count(*) FROM result WHERE sequence = 1") == [(2,)]
    assert read(tmp_path, "SELECT started_s, ended_s FROM run ORDER BY id") == [(1000.0, 1500.0), (2000.0, 3000.0)]


def test_none_of_a_batch_is_written_if_one_cannot_be(tmp_path: Path) -> None:
    with opened(tmp_path) as store:
        with pytest.raises(EntryRefused):
            store.write([result(1), entries.fault(1.0, 2**70, 0)])
        store.write([result(2)])
    assert read(tmp_path, "SELECT sequence FROM result") == [(2,)]


def test_two_stations_cannot_have_one_archive_and_a_killed_one_leaves_no_lock(tmp_path: Path) -> None:
    program = (
        "import sys, pathlib; from inspector.archive.claim import Claim;"
        "Claim(pathlib.Path(sys.argv[1])).take(); print('open', flush=True); sys.stdin.read()"
    )
    other = subprocess.Popen(
        [sys.executable, "-c", program, str(tmp_path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    with other:
        assert other.stdout is not None
        assert other.stdout.readline() == "open\n"
        claim = Claim(tmp_path)
        with pytest.raises(StoreInUse, match="a folder of its own"):
            claim.take()
        other.kill()
        other.wait()
    claim.take()
    assert claim.holds()
    claim.close()
    assert not claim.holds()


def test_a_folder_on_a_disk_that_is_not_mounted_is_not_made(tmp_path: Path) -> None:
    with pytest.raises(StoreUnavailable, match="no disk is mounted"):
        Claim(tmp_path / "disk" / "archive", tmp_path / "disk").take()
    assert not list(tmp_path.iterdir())
    (tmp_path / "link").symlink_to("/")
    for disk in (Path("/"), tmp_path / "link"):
        claim = Claim(tmp_path / "archive", disk)
        claim.take()
        claim.close()


def test_a_claimed_folder_that_is_gone_is_waited_for_and_not_made_anew(tmp_path: Path) -> None:
    folder, away = tmp_path / "archive", tmp_path / "away"
    claim = Claim(folder)
    claim.take()
    folder.rename(away)
    folder.mkdir()  # what is there where a disk is not mounted
    assert not claim.holds()
    with pytest.raises(StoreUnavailable, match="mount its disk again"):
        claim.take()
    assert not list(folder.iterdir())
    folder.rmdir()
    away.rename(folder)
    claim.take()
    assert claim.holds()
    claim.close()


@settings(max_examples=15)
@given(st.data())
def test_a_damaged_store_is_noticed_or_reads_on(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    """Whatever is done to the file: either it is refused at opening and set aside with every byte, or it works on."""
    folder = tmp_path_factory.mktemp("damaged")
    with opened(folder) as store:
        store.write([result(n, 1000.0) for n in range(40)])
    sound = bytearray((folder / FILE).read_bytes())
    at = data.draw(st.integers(0, len(sound) - 1))
    noise = data.draw(st.binary(min_size=1, max_size=300))
    spoilt = bytes(sound[:at]) + noise + bytes(sound[at + len(noise) :])
    spoilt = spoilt[: data.draw(st.sampled_from([len(spoilt), at, max(at, 1)]))]
    (folder / FILE).write_bytes(spoilt)
    try:
        store = Store(folder, RUN)
    except StoreDamaged:
        moved = set_aside(folder, 0.0)
        assert moved is not None
        assert moved.read_bytes() == spoilt
        store = Store(folder, RUN)
        store.write([result(99)])
        store.close()
        assert read(folder, "SELECT sequence FROM result") == [(99,)]
    except StoreUnavailable:
        pytest.fail("a damaged file is not unavailable")
    else:
        store.close()


def test_a_file_taken_away_or_replaced_is_noticed_at_the_next_result(tmp_path: Path) -> None:
    with opened(tmp_path) as store:
        store.write([result(1)])
        (tmp_path / FILE).rename(tmp_path / "elsewhere")
        with pytest.raises(StoreDamaged, match="taken away"):
            store.write([result(2)])


@pytest.mark.parametrize("gone", ["-wal", "-shm"])
def test_a_log_deleted_in_use_is_worked_into_the_file_and_begun_anew(tmp_path: Path, gone: str) -> None:
    with opened(tmp_path) as store:
        store.write([result(1)])
        (tmp_path / f"{FILE}{gone}").unlink()
        with pytest.raises(StoreUnavailable, match="was taken away while in use"):
            store.write([result(2)])
        killed = tmp_path / "killed"  # what a process that is killed now leaves
        killed.mkdir()
        shutil.copy(tmp_path / FILE, killed)
        assert read(killed, "SELECT sequence FROM result") == [(1,)]
    with opened(tmp_path) as store:
        store.write([result(2)])
        assert read(tmp_path, "SELECT sequence FROM result") == [(1,), (2,)]


def test_steps_are_taken_after_a_backup_and_lose_nothing(tmp_path: Path) -> None:
    with opened(tmp_path) as store:
        store.write([result(n, 500.0) for n in range(100)])
    with opened(tmp_path, steps=STEPS + LATER) as store:
        store.write([result(100)])
    assert read(tmp_path, "SELECT count(*), sum(gloss) FROM result") == [(101, 50.5)]
    with closing(sqlite3.connect(tmp_path / f"results.version-{len(STEPS)}.sqlite")) as backup:
        assert backup.execute("SELECT count(*) FROM result").fetchone() == (100,)
    # The program of before goes on in the same file, and the one after finds all of it.
    with opened(tmp_path) as store:
        store.write([result(101)])
    with opened(tmp_path, steps=STEPS + LATER):
        assert read(tmp_path, "SELECT count(*) FROM result") == [(102,)]


def test_a_step_that_fails_leaves_the_store_as_it_was(tmp_path: Path) -> None:
    with opened(tmp_path) as store:
        store.write([result(1)])
    with pytest.raises(StoreUnavailable):
        Store(tmp_path, RUN, steps=(*STEPS, "CREATE TABLE one (id INTEGER); CREATE TABLE one (id INTEGER)"))
    assert read(tmp_path, "PRAGMA user_version") == [(len(STEPS),)]
    assert not read(tmp_path, "SELECT name FROM sqlite_master WHERE name = 'one'")
    with opened(tmp_path) as store:
        store.write([result(2)])


def test_a_newer_store_that_says_so_is_left_to_newer_programs(tmp_path: Path) -> None:
    with opened(tmp_path, steps=STEPS + LATER):
        pass
    with closing(sqlite3.connect(tmp_path / FILE)) as newer, newer:
        newer.execute("UPDATE about SET value = ? WHERE key = 'oldest_writer'", (len(STEPS) + 1,))
    with pytest.raises(StoreDamaged, match="newer program"):
        Store(tmp_path, RUN)
