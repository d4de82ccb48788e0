"""What `inspector archive` does."""

from __future__ import annotations

import time
from pathlib import Path

import typer

from inspector import settings
from inspector.archive import store_copy
from inspector.archive.store import FILE
from inspector.settings import SettingsError

EXIT_DONE, EXIT_NOT_DONE, EXIT_SETTINGS_REFUSED = 0, 1, 78
"""Exit statuses: done; not possible, as stderr says; the settings are refused (EX_CONFIG)."""


def back_up(config: Path, output: Path) -> int:
    """Copy the store of a station, which may be running, into a file; the exit status."""
    try:
        archive = settings.load(config).archive
    except SettingsError as error:
        typer.echo(str(error), err=True)
        return EXIT_SETTINGS_REFUSED
    if archive is None:
        typer.echo(f"{config}: there is no archive, so nothing is kept; name its folder: archive.folder", err=True)
        return EXIT_NOT_DONE
    try:
        held = store_copy.copy(archive.folder / FILE, output)
    except store_copy.CannotCopy as error:
        typer.echo(f"not backed up: {error}", err=True)
        return EXIT_NOT_DONE
    typer.echo(f"{output}: {held.results} results{_up_to(held.last_s)}")
    return EXIT_DONE


def _up_to(last_s: float | None) -> str:
    return "" if last_s is None else f", the last one of {time.strftime('%Y-%m-%d %H:%M:%S', time.localtime(last_s))}"
