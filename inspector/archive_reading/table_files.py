"""Rows into a file as they come: CSV, JSON or Parquet. However many there are, few are in memory."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from datetime import UTC, datetime
from itertools import islice
from typing import Any, BinaryIO

from inspector.archive_reading.columns import Column
from inspector.archive_reading.selection import iso
from inspector.change_options import Unusable

Rows = Iterable[Sequence[Any]]
"""Values in the columns' order, as the store has them."""
GROUP_ROWS = 20_000
"""Rows of a Parquet file's row group."""
NO_EXTRA = "Parquet needs pyarrow: pip install 'seed-inspector[export]', or name a .csv or .jsonl file"


def csv_file(file: BinaryIO, columns: Sequence[Column], rows: Rows) -> int:
    """A header, then a line a row, as RFC 4180 has them; the number of rows. Raises OSError."""
    text = io.TextIOWrapper(file, encoding="utf-8", newline="")
    writer, count = csv.writer(text), 0
    writer.writerow([column.name for column in columns])
    makers = _makers(columns)
    for row in rows:
        writer.writerow([value if make is None else make(value) for value, make in zip(row, makers, strict=True)])
        count += 1
    text.flush()
    text.detach()
    return count


def json_lines_file(file: BinaryIO, columns: Sequence[Column], rows: Rows) -> int:
    """An object a line; the number of rows. Raises OSError."""
    count = 0
    for line in _objects(columns, rows):
        file.write(line + b"\n")
        count += 1
    return count


def json_file(file: BinaryIO, columns: Sequence[Column], rows: Rows) -> int:
    """One list of objects; the number of rows. Raises OSError."""
    count = 0
    for line in _objects(columns, rows):
        file.write((b",\n" if count else b"[\n") + line)
        count += 1
    file.write(b"\n]\n" if count else b"[]\n")
    return count


def parquet_file(file: BinaryIO, columns: Sequence[Column], rows: Rows) -> int:
    """A Parquet file; the number of rows. Raises OSError, and Unusable where pyarrow is missing."""
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError as error:
        raise Unusable(f"{NO_EXTRA} ({error})") from error

    schema = pyarrow.schema([_field(pyarrow, column) for column in columns])
    makers = [_timestamp if column.kind == "time" else column.of for column in columns]
    left, count = iter(rows), 0
    with parquet.ParquetWriter(file, schema, compression="zstd") as writer:
        while some := list(islice(left, GROUP_ROWS)):
            values = [
                [row[n] if make is None or row[n] is None else make(row[n]) for row in some]
                for n, make in enumerate(makers)
            ]
            arrays = [pyarrow.array(v, field.type) for v, field in zip(values, schema, strict=True)]
            writer.write_table(pyarrow.Table.from_arrays(arrays, schema=schema))
            count += len(some)
    return count


WRITERS: dict[str, Callable[[BinaryIO, Sequence[Column], Rows], int]] = {
    ".csv": csv_file,
    ".jsonl": json_lines_file,
    ".json": json_file,
    ".parquet": parquet_file,
}


def _makers(columns: Sequence[Column]) -> list[Callable[[Any], Any] | None]:
    """What is made of each column's values that are not None; None: they stay."""
    return [_known(iso if column.kind == "time" else column.of) for column in columns]


def _known(make: Callable[[Any], Any] | None) -> Callable[[Any], Any] | None:
    return None if make is None else lambda value: None if value is None else make(value)


def _objects(columns: Sequence[Column], rows: Rows) -> Iterator[bytes]:
    names, makers = [column.name for column in columns], _makers(columns)
    for row in rows:
        values = (value if make is None else make(value) for value, make in zip(row, makers, strict=True))
        said = {name: _number(value) for name, value in zip(names, values, strict=True)}
        yield json.dumps(said, ensure_ascii=False, allow_nan=False).encode()


def _number(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _field(pyarrow: Any, column: Column) -> Any:
    kind = pyarrow.timestamp("us", "UTC") if column.kind == "time" else getattr(pyarrow, column.kind)()
    return pyarrow.field(column.name, kind, metadata={"says": column.says})


def _timestamp(unix_s: float) -> datetime | None:
    try:
        return datetime.fromtimestamp(unix_s, UTC)
    except (ValueError, OverflowError, OSError):
        return None
