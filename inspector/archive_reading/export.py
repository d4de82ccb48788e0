"""What `inspector export` does: a table of the archive into a file, row by row, while the service may run."""

from __future__ import annotations

from pathlib import Path

from firmware_bridge import whole_file
from inspector.archive_reading import queries, selection
from inspector.archive_reading.columns import TABLES
from inspector.archive_reading.status import DONE, status_of
from inspector.archive_reading.store_reader import StoreReader
from inspector.archive_reading.table_files import WRITERS
from inspector.archive_reading.where import place_of
from inspector.change_options import Unusable


def run(
    archive: Path | None,
    config: Path | None,
    output: Path,
    what: str,
    span: tuple[str | None, str | None],
    recipe: str | None,
) -> int:
    """Write the rows asked for; the exit status. ``span``: from and to."""

    def work() -> int:
        wanted, place = selection.of(*span, recipe), place_of(archive, config)
        print(f"{write(place.archive, output, what, wanted)} {what} in {output}")
        return DONE

    return status_of(work, output)


def write(archive: Path, output: Path, what: str, wanted: selection.Selection) -> int:
    """Write a table of the archive, whole or not at all; the number of rows.

    Raises Unusable, ArchiveUnreadable, OSError.
    """
    form, table = WRITERS.get(output.suffix), TABLES[what]
    if form is None:
        raise Unusable(f"--output {output}: the form is told by its ending; allowed: {', '.join(WRITERS)}")
    sql, values = queries.query(table, wanted)
    with whole_file.writing(output) as file, StoreReader(archive) as store:
        return form(file, table.columns, store.rows(sql, values))
