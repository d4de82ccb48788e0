"""Tables that people make: CSV files with a header, columns in any order and among others."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path


class InputRefused(ValueError):
    """What a command was given cannot be read or does not fit together; the message names every place and remedy."""


@dataclass(frozen=True)
class Row:
    """One row: the line it ends on, and the cells that were asked for (None: the row is too short)."""

    line: int
    cells: tuple[str | None, ...]


def read(path: Path, columns: Sequence[str]) -> list[Row]:
    """The rows of a CSV file with these columns. Raises InputRefused."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file)
            missing = [name for name in columns if name not in (reader.fieldnames or ())]
            if missing:
                raise InputRefused(f"{path}:1: columns missing: {', '.join(missing)}; needed: {', '.join(columns)}")
            return [Row(reader.line_num, tuple(row[name] for name in columns)) for row in reader]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputRefused(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from error


def numbers(path: Path, columns: Sequence[str], rows: Sequence[Row]) -> list[list[float]]:
    """The numbers in the last cells of each row, those of ``columns``. Raises InputRefused with every problem."""
    table, problems = [], []
    for row in rows:
        values = []
        for name, cell in zip(columns, row.cells[-len(columns) :], strict=True):
            try:
                values.append(float(cell or ""))
            except ValueError:
                problems.append(f"{path}:{row.line}: {name}: {cell!r}; allowed: a number")
        table.append(values)
    if problems:
        raise InputRefused("\n".join(problems))
    return table
