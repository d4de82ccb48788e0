"""Exit statuses of the commands that read the archive, and what stops them, said."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

from inspector.archive_reading.store_reader import ArchiveUnreadable
from inspector.change_options import Unusable
from inspector.settings import SettingsError

DONE, DIFFERS, NOTHING_DONE, SETTINGS_REFUSED = 0, 1, 2, 78
"""Exit statuses; the last is EX_CONFIG."""


def status_of(work: Callable[[], int], output: Path | None) -> int:
    """The status that the work comes to, or that of what stops it, with a line that says so. ``output``: the file that
    it writes; None: standard output."""
    try:
        return work()
    except SettingsError as error:
        print(error, file=sys.stderr)
        return SETTINGS_REFUSED
    except (Unusable, ArchiveUnreadable) as error:
        print(f"inspector: {error}", file=sys.stderr)
    except OSError as error:
        print(f"inspector: {output or 'output'}: not written ({error.strerror or error})", file=sys.stderr)
    return NOTHING_DONE
