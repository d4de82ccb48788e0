"""`inspector export`: what the files say is what the store says and what the PLC was shown."""

from __future__ import annotations

import csv
import json
import shutil
import sqlite3
import sys
import tempfile
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyarrow import parquet
from typer.testing import CliRunner

from inspector.archive import entries
from inspector.archive.store import Run, Store
from inspector.archive_reading import queries
from inspector.archive_reading.columns import TABLES, Column
from inspector.archive_reading.selection import Selection, iso, shift
from inspector.archive_reading.store_reader import StoreReader
from inspector.archive_reading.table_files import WRITERS
from inspector.cli.app import app
from inspector.faults import Fault
from inspector.model import Verdict

pytestmark = pytest.mark.xdist_group("kept")
FORMS = ("csv", "jsonl", "json", "parquet")


def export(output: Path, *options: object) -> Any:
    """The command's outcome."""
    return CliRunner().invoke(app, ["export", "--output", str(output), *map(str, options)])


def read(file: Path) -> list[dict[str, Any]]:
    """The rows of a file of any form; a CSV's cells are texts."""
    if file.suffix == ".parquet":
        rows: list[dict[str, Any]] = parquet.read_table(file).to_pylist()
        return rows
    if file.suffix == ".csv":
        return list(csv.DictReader(file.open()))
    text = file.read_text()
    return json.loads(text) if file.suffix == ".json" else [json.loads(line) for line in text.split("\n")[:-1]]


def stored(archive: Path, sql: str) -> list[tuple[Any, ...]]:
    with closing(sqlite3.connect(archive / "results.sqlite")) as store:
        return store.execute(sql).fetchall()


@pytest.mark.parametrize("form", FORMS)
def test_results_are_what_the_plc_was_shown(kept: Any, tmp_path: Path, form: str) -> None:
    station, shown = kept
    done = export(tmp_path / f"out.{form}", "--config", station.file)
    assert (done.exit_code, done.stderr) == (0, "")
    rows = {int(row["sequence"]): row for row in read(tmp_path / f"out.{form}")}
    assert [(n,) for n in rows] == stored(station.folder / "archive", "SELECT sequence FROM result ORDER BY id")
    seen = [(n, registers) for n, registers in shown.items() if n and n in rows]
    assert seen
    for number, registers in seen:
        assert rows[number]["verdict"] == Verdict(registers["verdict"]).name
        assert int(rows[number]["reasons"]) == registers["reasons"]
        assert int(rows[number]["defect_count"]) == registers["defect_count"]
        assert int(rows[number]["panel_id"]) == registers["panel_id"]


@pytest.mark.parametrize("what", TABLES)
def test_every_form_has_the_same_rows(kept: Any, tmp_path: Path, what: str) -> None:
    archive = kept[0].folder / "archive"
    for form in FORMS:
        assert export(tmp_path / f"out.{form}", archive, "--what", what).exit_code == 0
    parquet_rows, json_rows, lines, cells = (read(tmp_path / f"out.{f}") for f in ("parquet", "json", "jsonl", "csv"))
    assert lines == json_rows
    assert [{k: "" if v is None else str(v) for k, v in row.items()} for row in lines] == cells
    for row in parquet_rows:
        row |= {name: at(v) for name, v in row.items() if isinstance(v, datetime)}
    assert parquet_rows == json_rows
    tables = {"panels": "result", "settings": "settings_version", "recipes": "recipe_version"}
    assert [(len(lines),)] == stored(archive, f"SELECT count(*) FROM {tables.get(what, what.rstrip('s'))}")
    assert lines
    assert all(list(row) == [column.name for column in TABLES[what].columns] for row in lines)


def at(time: datetime) -> str:
    return time.astimezone(UTC).isoformat(timespec="microseconds").replace("+00:00", "Z")


def test_every_digit_of_a_height_is_there(kept: Any, tmp_path: Path) -> None:
    archive = kept[0].folder / "archive"
    assert export(tmp_path / "out.csv", archive, "--what", "defects").exit_code == 0
    heights = stored(archive, "SELECT height_um, residual_sigma FROM defect ORDER BY result, number")
    assert [(float(r["height_um"]), float(r["residual_sigma"])) for r in read(tmp_path / "out.csv")] == heights


def test_what_is_asked_for_is_what_comes(kept: Any, tmp_path: Path) -> None:
    archive, out = kept[0].folder / "archive", tmp_path / "out.jsonl"
    times = dict(stored(archive, "SELECT sequence, at_s FROM result"))

    def sequences(*options: str) -> list[int]:
        assert export(out, archive, *options).exit_code == 0
        return [row["sequence"] for row in read(out)]

    assert sequences("--from", "2", "--to", "4") == [2, 3, 4]
    begin, end = (datetime.fromtimestamp((times[n - 1] + times[n]) / 2, UTC).isoformat() for n in (2, 4))
    assert sequences("--from", begin, "--to", end) == [2, 3]
    assert sequences("--recipe", "black gloss") == sequences("--recipe", "1") == list(times)
    assert sequences("--recipe", "another") == []
    for recipe, rows in (("black gloss", 1), ("1", 1), ("another", 0)):
        assert export(out, archive, "--what", "recipes", "--recipe", recipe).exit_code == 0
        assert len(read(out)) == rows
    assert export(out, archive, "--what", "runs", "--from", begin, "--to", end).exit_code == 0
    assert len(read(out)) == 1


def test_what_was_refused_meanwhile_is_a_fault_with_its_duration(kept: Any, tmp_path: Path) -> None:
    assert export(tmp_path / "out.jsonl", kept[0].folder / "archive", "--what", "faults").exit_code == 0
    refused = [row for row in read(tmp_path / "out.jsonl") if row["code"] == Fault.SETTINGS_REFUSED]
    assert [row["duration_s"] > 0 for row in refused] == [True]
    assert refused[0]["began"] < refused[0]["ended"]


@pytest.mark.parametrize(("spoil", "says"), [
    (lambda file: file.unlink(), "is not there"),
    (lambda file: file.write_bytes(b"no store" * 2000), "is damaged, or no store"),
    (lambda file: file.write_bytes(b""), "is damaged, or no store"),
])  # fmt: skip
def test_a_store_that_cannot_be_read_is_named_and_nothing_written(
    kept: Any, tmp_path: Path, spoil: Any, says: str
) -> None:
    archive = tmp_path / "archive"
    archive.mkdir()
    shutil.copy(kept[0].folder / "archive" / "results.sqlite", archive)
    spoil(archive / "results.sqlite")
    done = export(tmp_path / "out.csv", archive)
    assert done.exit_code == 2
    assert str(archive / "results.sqlite") in done.stderr
    assert says in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["archive"]


def test_without_pyarrow_the_extra_is_named(kept: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    done = export(tmp_path / "out.parquet", kept[0].folder / "archive")
    assert done.exit_code == 2
    assert "pip install 'seed-inspector[export]'" in done.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("options", [
    ["--from", "yesterday"], ["--what", "actions", "--from", "3"], ["--what", "faults", "--recipe", "1"],
])  # fmt: skip
def test_what_cannot_be_asked_is_refused(kept: Any, tmp_path: Path, options: list[str]) -> None:
    done = export(tmp_path / "out.csv", kept[0].folder / "archive", *options)
    assert done.exit_code == 2
    assert "allowed:" in done.stderr or "these" in done.stderr
    assert not list(tmp_path.iterdir())


def test_an_export_reads_beside_a_writer_and_sees_one_moment(kept: Any, tmp_path: Path) -> None:
    shutil.copy(kept[0].folder / "archive" / "results.sqlite", tmp_path)
    with closing(sqlite3.connect(tmp_path / "results.sqlite")) as writer, StoreReader(tmp_path) as store:
        before = writer.execute("SELECT count(*) FROM result").fetchone()[0]
        with writer:
            writer.execute("DELETE FROM result WHERE sequence > 2")
        assert len(list(store.rows(*queries.query(TABLES["results"], Selection())))) == before
        with StoreReader(tmp_path) as later:
            assert len(list(later.rows("SELECT id FROM result"))) == 2


COLUMNS = (Column("n", "int64", "", "n"), Column("x_mm", "float64", "", "x"), Column("text", "string", "", "t"))
VALUES = st.tuples(
    st.none() | st.integers(-(2**63), 2**63 - 1),
    st.none() | st.floats(allow_nan=False, allow_infinity=False),
    st.text(st.characters(codec="utf-8", exclude_characters="\x00"), min_size=1),
)


@settings(max_examples=40)
@given(st.lists(VALUES, max_size=5), st.sampled_from(FORMS))
def test_whatever_the_store_holds_comes_back(rows: list[tuple[Any, ...]], form: str) -> None:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / f"out.{form}"
        with file.open("wb") as out:
            assert WRITERS[file.suffix](out, COLUMNS, rows) == len(rows)
        if form == "csv":
            with file.open(newline="") as text:
                found = [(int(n) if n else None, float(x) if x else None, t) for n, x, t in list(csv.reader(text))[1:]]
        else:
            found = [tuple(row.values()) for row in read(file)]
        assert found == rows


def test_a_shift_is_of_the_clock_on_the_wall_and_may_end_on_the_next_day() -> None:
    early, late = shift("2026-11-26/06:00-14:00", {}), shift("2026-11-26/late", {"late": "22:00-06:00"})
    assert early.ends_s == datetime(2026, 11, 26, 14).timestamp()
    assert (late.begins_s, late.ends_s) == tuple(datetime(2026, 11, *at).timestamp() for at in ((26, 22), (27, 6)))
    assert iso(0.25) == "1970-01-01T00:00:00.250000Z"


def test_a_fault_lasts_no_longer_than_its_run_though_that_was_killed(tmp_path: Path) -> None:
    for started_s in (1000.0, 2000.0):
        store = Store(tmp_path, Run(started_s, "0.1.0", "line 2"))
        store.write([entries.fault(started_s + 1, 301, 7)])
        store.close()
    begins = "1970-01-01T00:40:00Z"
    words = ["export", str(tmp_path), "--what", "faults", "--from", begins, "--output", str(tmp_path / "faults.jsonl")]
    assert CliRunner().invoke(app, words).exit_code == 0
    rows = [json.loads(line) for line in (tmp_path / "faults.jsonl").read_text().splitlines()]
    assert [row["began"] for row in rows] == ["1970-01-01T00:33:21.000000Z"]
