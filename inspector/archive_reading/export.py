"""What `inspector export` does: a table of the archive into a file, row by row, while the service may run."""

from __future__ import annotations

import sys
from pathlib import Path

from firmware_bridge import whole_file
from inspector.archive_reading import queries, selection
from inspector.archive_reading.columns import TABLES
from inspector.archive_reading.store_reader import ArchiveUnreadable, StoreReader
from inspector.archive_reading.table_files import NO_EXTRA, WRITERS
from inspector.archive_reading.where import place_of
from inspector.change_options import Unusable
from inspector.settings import SettingsError

DONE, NOTHING_DONE, SETTINGS_REFUSED = 0, 2, 78
"""Exit statuses; the last is EX_CONFIG."""


def run(
    archive: Path | None,
    config: Path | None,
    output: Path,
    what: str,
    span: tuple[str | None, str | None],
    recipe: str | None,
) -> int:
    """Write the rows asked for; the exit status. ``span``: from and to."""
    try:
        wanted, place = selection.of(*span, recipe), place_of(archive, config)
        count = write(place.archive, output, what, wanted)
    except SettingsError as error:
        print(error, file=sys.stderr)
        return SETTINGS_REFUSED
    except (Unusable, ArchiveUnreadable) as error:
        print(f"inspector: {error}", file=sys.stderr)
        return NOTHING_DONE
    except ImportError as error:
        print(f"inspector: {NO_EXTRA} ({error})", file=sys.stderr)
        return NOTHING_DONE
    except OSError as error:
        print(f"inspector: {output}: not written ({error.strerror or error})", file=sys.stderr)
        return NOTHING_DONE
    print(f"{count} {what} in {output}")
    return DONE


def write(archive: Path, output: Path, what: str, wanted: selection.Selection) -> int:
    """Write a table of the archive, whole or not at all; the number of rows.

    Raises Unusable, ArchiveUnreadable, OSError, and ImportError where the form needs what is not installed.
    """
    form, table = WRITERS.get(output.suffix), TABLES[what]
    if form is None:
        raise Unusable(f"--output {output}: the form is told by its ending; allowed: {', '.join(WRITERS)}")
    sql, values = queries.query(table, wanted)
    with whole_file.writing(output) as file, StoreReader(archive) as store:
        return form(file, table.columns, store.rows(sql, values))
