"""What `inspector explain` does: how one verdict of the archive came about, while the service may run."""

from __future__ import annotations

import json
import math
import sys
from datetime import datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

from firmware_bridge import whole_file
from inspector.archive_reading import document, explained, explanation, kept
from inspector.archive_reading.status import DIFFERS, DONE, status_of
from inspector.archive_reading.store_reader import StoreReader
from inspector.archive_reading.where import place_of
from inspector.change_options import Unusable


def run(
    result: str, archive: Path | None, config: Path | None, frame: int | None, form: str, output: Path | None
) -> int:
    """Print the explanation, or write it; the exit status."""

    def work() -> int:
        with StoreReader(place_of(archive, config).archive) as store:
            found = kept.kept(store, kept.by_name(store, result))
            if frame is not None and frame not in [one.row["number"] for one in found.frames]:
                raise Unusable(f"--frame {frame}: result {result} has {len(found.frames)}, counted from 0")
            said = explanation.explain(found, frame)
        if output is None:
            sys.stdout.write(FORMS[form](said))
        else:
            whole_file.write(output, FORMS[form](said))
        return DIFFERS if said["same"] is False else DONE

    return status_of(work, output)


def made() -> str:
    """What made a page, and when, for its foot."""
    now = datetime.now().astimezone().isoformat(sep=" ", timespec="minutes")
    return f"Made by seed-inspector {version('seed-inspector')}, {now}"


def _json(said: dict[str, Any]) -> str:
    return json.dumps(_plain(said), ensure_ascii=False, allow_nan=False, indent=1) + "\n"


def _plain(value: Any) -> Any:
    """The value with null for what is no number, as JSON has no word for it."""
    if isinstance(value, dict):
        return {key: _plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


FORMS = {
    "text": lambda said: document.as_text(explained.page(said)),
    "html": lambda said: document.as_html(explained.page(said), made()),
    "json": _json,
}
