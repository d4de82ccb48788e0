"""Where a command finds the archive, and what it needs to know of the station besides."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from inspector.change_options import Unusable
from inspector.settings import load_records


@dataclass(frozen=True, slots=True)
class Place:
    """The archive, and the names of the plant's shifts with their times."""

    archive: Path
    shifts: Mapping[str, str] = field(default_factory=dict)


def place_of(archive: Path | None, config: Path | None) -> Place:
    """The archive itself, or the one of a settings file. Raises Unusable, SettingsError."""
    if config is None:
        if archive is None:
            raise Unusable("say which archive: its folder, or the station's settings, --config FILE")
        return Place(archive)
    settings = load_records(config)
    named = archive or (settings.archive.folder if settings.archive else None)
    if named is None:
        raise Unusable(f"{config} names no archive (archive.folder): nothing is kept, or name the folder")
    return Place(named, settings.shifts)
