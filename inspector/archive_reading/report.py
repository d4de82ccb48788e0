"""What `inspector report` does: one panel, or a shift, as one HTML file, while the service may run."""

from __future__ import annotations

import re
from pathlib import Path

from firmware_bridge import whole_file
from inspector.archive_reading import document, kept, panel_report, period_report, selection
from inspector.archive_reading.document import Document
from inspector.archive_reading.explain import made
from inspector.archive_reading.status import DONE, status_of
from inspector.archive_reading.store_reader import StoreReader
from inspector.archive_reading.where import Place, place_of
from inspector.change_options import Unusable

SUBJECTS = (
    "a panel's id (17), a result (result:1041), a shift (2026-11-26/06:00-14:00, or /NAME as the settings call it), "
    "or FROM..TO by sequences or times"
)


def run(subject: str, archive: Path | None, config: Path | None, output: Path | None) -> int:
    """Write the report; the exit status. ``output`` None: a file in this folder that is called by the subject."""
    file = output or Path(f"report-{re.sub('[^0-9A-Za-z.-]+', '-', subject)}.html")

    def work() -> int:
        place = place_of(archive, config)
        with StoreReader(place.archive) as store:
            page = _page(store, subject, place)
        whole_file.write(file, document.as_html(page, made()))
        print(f"{page.title}: {file}")
        return DONE

    return status_of(work, file)


def _page(store: StoreReader, subject: str, place: Place) -> Document:
    if subject.isascii() and subject.isdigit() and len(subject) < 19:
        return panel_report.page(kept.kept(store, kept.of_panel(store, int(subject))))
    if subject.startswith("result:"):
        return panel_report.page(kept.kept(store, kept.by_name(store, subject.removeprefix("result:"))))
    if ".." in subject:
        begin, _, end = subject.partition("..")
        return period_report.page(store, selection.of(begin or None, end or None), "Inspection report")
    if "/" in subject:
        return period_report.page(store, selection.shift(subject, place.shifts), f"Shift {subject}")
    raise Unusable(f"{subject!r}: say what to report on: {SUBJECTS}")
