"""What `inspector report` does: one panel, or a shift, as one HTML file, while the service may run."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

from firmware_bridge import whole_file
from inspector.archive_reading import document, kept, panel_report, period_report, selection
from inspector.archive_reading.document import Document
from inspector.archive_reading.explain import made
from inspector.archive_reading.store_reader import ArchiveUnreadable, StoreReader
from inspector.archive_reading.where import Place, place_of
from inspector.change_options import Unusable
from inspector.settings import SettingsError

DONE, NOTHING_DONE, SETTINGS_REFUSED = 0, 2, 78
"""Exit statuses; the last is EX_CONFIG."""
ONE_OF = "say what to report on, one of: --panel ID, --result SEQUENCE, --shift DATE/TIMES, --from and --to"


@dataclass(frozen=True, slots=True)
class About:
    """What to report on: one of these; None: not that."""

    panel: int | None = None
    result: str | None = None
    shift: str | None = None
    begin: str | None = None
    end: str | None = None


def run(archive: Path | None, config: Path | None, about: About, output: Path) -> int:
    """Write the report; the exit status."""
    try:
        place = place_of(archive, config)
        with StoreReader(place.archive) as store:
            page = _page(store, about, place)
        whole_file.write(output, document.as_html(page, made()))
    except SettingsError as error:
        print(error, file=sys.stderr)
        return SETTINGS_REFUSED
    except (Unusable, ArchiveUnreadable) as error:
        print(f"inspector: {error}", file=sys.stderr)
        return NOTHING_DONE
    except OSError as error:
        print(f"inspector: {output}: not written ({error.strerror})", file=sys.stderr)
        return NOTHING_DONE
    print(f"{page.title}: {output}")
    return DONE


def _page(store: StoreReader, about: About, place: Place) -> Document:
    asked = [about.panel, about.result, about.shift, about.begin or about.end]
    if sum(one is not None for one in asked) != 1:
        raise Unusable(ONE_OF)
    if about.panel is not None:
        return panel_report.page(kept.kept(store, kept.of_panel(store, about.panel)))
    if about.result is not None:
        return panel_report.page(kept.kept(store, kept.by_name(store, about.result)))
    if about.shift is not None:
        return period_report.page(store, selection.shift(about.shift, place.shifts), f"Shift {about.shift}")
    return period_report.page(store, selection.of(about.begin, about.end), "Inspection report")
