"""Entries on their way: nothing waits for a store that is not to be had, memory is bounded, and order is kept."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from inspector.archive import entries, store, store_writer
from inspector.archive.claim import Claim
from inspector.archive.store import FILE, Run, Store, StoreBusy
from inspector.archive.store_writer import StoreWriter
from inspector.model import Defect, Snapshot
from inspector.outage import Outage

RUN = Run(1000.0, "0.1.0", "line 2")


def result(sequence: int, defects: int = 0) -> entries.Entry:
    found = (Defect(1.0, 2.0, 3.0, 3.5, (4.0, 5.0), (6.0, 7.0)),) * defects
    return entries.of_result(Snapshot(sequence=sequence, defects=found), 50.0, (), [], [], ("0a", "0b"))


@pytest.fixture
def writer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[], StoreWriter]]:
    monkeypatch.setattr(store_writer, "RETRY_LONGEST_S", 0.1)
    monkeypatch.setattr(store, "BUSY_S", 0.01)
    begun: list[StoreWriter] = []

    def begin() -> StoreWriter:
        begun.append(StoreWriter(tmp_path, RUN, Claim(tmp_path), Outage("store"), Outage("log")))
        return begun[-1]

    yield begin
    for one in begun:
        one.close(20, 2000.0)


def read(folder: Path, sql: str) -> list[tuple[Any, ...]]:
    with closing(sqlite3.connect(folder / FILE)) as other:
        return other.execute(sql).fetchall()


def test_what_waits_is_bounded_by_its_rows_and_told_once(
    writer: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(store_writer, "MOST_ROWS", 10_000)
    other = Claim(tmp_path)
    other.take()
    one = writer()
    numbers = [one.put(result(sequence, defects=2000)) for sequence in range(1, 9)]
    assert one.waiting == 4
    assert one.lost == 4
    assert not one.has(numbers[-1])
    assert sum("what comes now is not kept" in record.message for record in caplog.records) == 1
    other.close()
    assert one.wait(numbers[3], 20)
    assert one.wait(one.put(result(9)), 20)
    assert read(tmp_path, "SELECT sequence, defect_count FROM result") == [*((n, 2000) for n in range(1, 5)), (9, 0)]


def test_another_process_that_writes_is_waited_for_with_the_store_open(
    writer: Any, tmp_path: Path, wait_until: Any, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = writer()
    assert one.wait(one.put(result(1)), 20)
    monkeypatch.setattr(store_writer, "Store", None)  # to open it anew would be an error
    with closing(sqlite3.connect(tmp_path / FILE, isolation_level=None)) as shell:
        shell.execute("BEGIN IMMEDIATE")
        last = [one.put(result(sequence)) for sequence in range(2, 30)][-1]
        wait_until(lambda: "store fails" in caplog.text, "an outage in the log")
        assert not one.has(last)
        shell.execute("ROLLBACK")
    assert one.wait(last, 20)
    assert read(tmp_path, "SELECT sequence FROM result ORDER BY id") == [(n,) for n in range(1, 30)]
    assert caplog.text.count("store fails") == 1


def test_an_entry_that_no_store_takes_keeps_no_other_from_it(writer: Any, tmp_path: Path) -> None:
    one = writer()
    bad = [entries.action(60.0 + n, "PLC", what) for n, what in enumerate(("name \udce4", object(), 2**70))]
    put = [one.put(entry) for entry in (result(1), *bad, result(2))]
    assert [one.wait(number, 20) for number in put] == [True, False, False, False, True]  # nor counts as kept itself
    assert one.lost == 3
    assert read(tmp_path, "SELECT sequence FROM result ORDER BY id") == [(1,), (2,)]


def test_a_store_begun_anew_knows_what_its_results_refer_to(writer: Any, tmp_path: Path) -> None:
    one = writer()
    one.stands("settings", entries.settings_version("0a", 1.0, "{}"))
    assert one.wait(one.put(result(1)), 20)
    (tmp_path / FILE).rename(tmp_path / "taken")
    assert one.wait(one.put(result(2)), 20)
    assert one.set_aside is not None
    assert read(tmp_path, "SELECT sequence, name FROM result JOIN settings_version ON settings = name") == [(2, "0a")]


def test_the_log_beside_the_store_stays_small_and_who_keeps_it_large_is_told(
    writer: Any, tmp_path: Path, wait_until: Any, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(store, "CHECKPOINT_BYTES", 100_000)
    monkeypatch.setattr(store_writer, "LARGE_LOG_BYTES", 1_000_000)
    caplog.set_level("INFO")
    one, sequence = writer(), 0
    log = tmp_path / f"{FILE}-wal"

    def write(results: int) -> None:
        nonlocal sequence
        for _ in range(results):
            sequence += 1
            assert one.wait(one.put(result(sequence, defects=200)), 20)

    write(30)
    assert log.stat().st_size < 200_000
    with closing(sqlite3.connect(tmp_path / FILE, isolation_level=None)) as reader:
        reader.execute("BEGIN")
        reader.execute("SELECT count(*) FROM result").fetchall()
        while log.stat().st_size < 1_000_000:
            write(1)
        write(1)
        wait_until(lambda: "log fails" in caplog.text, "who reads is told")
    while log.stat().st_size > 200_000:
        write(1)
    wait_until(lambda: "log works again" in caplog.text, "that it is over is told")


def test_a_full_disk_leaves_the_store_open_and_sound(tmp_path: Path) -> None:
    with closing(Store(tmp_path, RUN)) as full:
        full.write([result(1)])
        full._connection.execute(
            f"PRAGMA max_page_count = {full._connection.execute('PRAGMA page_count').fetchone()[0]}"
        )
        with pytest.raises(StoreBusy, match="full"):
            full.write([result(2, defects=500)])
        full._connection.execute("PRAGMA max_page_count = 1000000")
        full.write([result(3, defects=500)])
    assert read(tmp_path, "SELECT sequence FROM result") == [(1,), (3,)]
