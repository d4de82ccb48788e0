"""What is selected of a table of the archive, as SQL."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from inspector.archive_reading.columns import Table
from inspector.archive_reading.selection import Selection
from inspector.change_options import Unusable


def query(table: Table, selection: Selection) -> tuple[str, list[Any]]:
    """The rows asked for, their columns in the table's order; and the query's values. Raises Unusable."""
    conditions = list(_conditions(table, selection))
    columns = ", ".join(f"{column.sql} AS {column.name}" for column in table.columns)
    where = " AND ".join(condition for condition, _ in conditions) or "1"
    values = [value for _, some in conditions for value in some]
    return f"SELECT {columns} FROM {table.source} WHERE {where} ORDER BY {table.order}", values


def _conditions(table: Table, selection: Selection) -> Iterator[tuple[str, tuple[Any, ...]]]:
    if selection.begins_s is not None:
        begins = f"{table.until} > ?" if table.until else f"{table.at} >= ?"
        yield begins, (selection.begins_s,)
    if selection.ends_s is not None:
        yield f"{table.at} < ?", (selection.ends_s,)
    for operator, bound in ((">=", selection.first), ("<=", selection.last)):
        if bound is not None and table.sequence is None:
            raise Unusable("these have no sequence: give --from and --to as times")
        if bound is not None:
            yield f"{table.sequence} {operator} ?", (bound,)
    if selection.recipe is not None:
        yield _of_recipe(table, selection.recipe)


def _of_recipe(table: Table, recipe: str) -> tuple[str, tuple[Any, ...]]:
    if table.recipe is None:
        raise Unusable("these are of no recipe: leave --recipe out")
    number, content = table.recipe
    if recipe.isascii() and recipe.isdigit() and len(recipe) < 10:
        return f"{number} = ?", (int(recipe),)
    return f"{content} IN (SELECT hash FROM recipe_version WHERE name = ?)", (recipe,)
