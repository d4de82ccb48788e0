"""`inspector archive backup`: one file of one moment, whatever the station does, and a store to go on with."""

from __future__ import annotations

import shutil
import sqlite3
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from inspector.archive import entries
from inspector.archive.store import FILE, Run, Store
from inspector.cli.app import app
from inspector.model import Snapshot, Verdict

CONFIG = Path(__file__).parents[2] / "config/demo.yaml"


def result(sequence: int) -> entries.Entry:
    shown = Snapshot(sequence=sequence, verdict=Verdict.PASS)
    return entries.of_result(shown, 50.0 + sequence, (), [], [], ("0a", "0b"))


def sequences(file: Path) -> list[int]:
    with closing(sqlite3.connect(file)) as other:
        return [row[0] for row in other.execute("SELECT sequence FROM result ORDER BY sequence")]


@pytest.fixture
def station(tmp_path: Path) -> Path:
    """Settings with an archive, which is not there yet."""
    text = CONFIG.read_text().replace("folder: ../var/demo", "folder: archive")
    text = text.replace("calibration/", f"{CONFIG.parent}/calibration/").replace(
        "[frames]", f"[{CONFIG.parent}/frames]"
    )
    (tmp_path / "line.yaml").write_text(text)
    return tmp_path


@contextmanager
def opened(station: Path) -> Iterator[Store]:
    (station / "archive").mkdir(exist_ok=True)
    store = Store(station / "archive", Run(1000.0, "0.1.0", "line 2"))
    try:
        yield store
    finally:
        store.close()


@pytest.fixture
def store(station: Path) -> Iterator[Store]:
    with opened(station) as store:
        yield store


def back_up(station: Path, output: Path) -> Result:
    return CliRunner().invoke(
        app, ["archive", "backup", "--config", f"{station / 'line.yaml'}", "--output", f"{output}"]
    )


def test_a_copy_made_while_the_station_writes_is_whole_and_of_one_moment(station: Path, store: Store) -> None:
    store.write([result(1)])
    copies, written = station / "copies", [1]
    copies.mkdir()
    done = threading.Event()

    def inspect() -> None:
        while not done.is_set():
            store.write([result(written[0] + 1), result(written[0] + 2)])
            written[0] += 2

    writer = threading.Thread(target=inspect)
    writer.start()
    try:
        for number in range(2):
            before = written[0]
            said = back_up(station, copies / f"{number}.sqlite")
            assert said.exit_code == 0, said.output
            held = sequences(copies / f"{number}.sqlite")
            assert held == list(range(1, len(held) + 1))
            assert len(held) % 2 == 1  # two results went in at once
            assert before <= len(held) <= written[0] + 2
            assert f"{len(held)} results, the last one of" in said.output
    finally:
        done.set()
        writer.join()
    assert {p.name for p in copies.iterdir()} == {f"{n}.sqlite" for n in range(2)}


def test_a_restored_copy_is_the_store_that_the_station_goes_on_with(station: Path, store: Store) -> None:
    store.write([result(1), result(2)])
    assert back_up(station, station / "copy.sqlite").exit_code == 0
    store.write([result(3)])
    restored = station / "restored"
    restored.mkdir()
    shutil.copy(station / "copy.sqlite", restored / FILE)
    again = Store(restored, Run(2000.0, "0.1.0", "line 2"))
    again.write([result(3)])
    again.close()
    assert sequences(restored / FILE) == [1, 2, 3]


def test_the_store_of_a_station_that_has_stopped_is_copied_and_left_to_the_station(station: Path) -> None:
    with opened(station) as store:
        store.write([result(1)])
    assert back_up(station, station / "copy.sqlite").exit_code == 0
    assert sequences(station / "copy.sqlite") == [1]
    with opened(station) as store:
        store.write([result(2)])
    assert sequences(station / "archive" / FILE) == [1, 2]


def test_a_damaged_store_takes_the_place_of_no_earlier_copy(station: Path) -> None:
    file, copy = station / "archive" / FILE, station / "copy.sqlite"
    with opened(station) as store:
        store.write([result(number) for number in range(1, 400)])
    assert back_up(station, copy).exit_code == 0
    content = bytearray(file.read_bytes())
    content[len(content) // 2 :] = bytes(b"\xa5" * (len(content) - len(content) // 2))
    file.write_bytes(content)
    said = back_up(station, copy)
    assert said.exit_code == 1
    assert "check disks" in said.stderr
    assert sequences(copy) == list(range(1, 400))
    assert not list(station.glob(".*.part*"))


def test_what_cannot_be_copied_is_said_with_the_remedy(station: Path) -> None:
    said = back_up(station, station / "copy.sqlite")
    assert (said.exit_code, "archive.folder" in said.stderr) == (1, True)
    with opened(station) as store:
        store.write([result(1)])
    for output, why in (("archive/" + FILE, "another folder"), ("away/copy", "folder"), ("archive", "another")):
        said = back_up(station, station / output)
        assert (said.exit_code, why in said.stderr) == (1, True), said.output
    assert sequences(station / "archive" / FILE) == [1]
    (station / "line.yaml").write_text("station: 7\n")
    assert back_up(station, station / "copy.sqlite").exit_code == 78
