"""The commands `inspector archive`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

archive_app = typer.Typer(help="The archive of a station: what it keeps of results and frames.", no_args_is_help=True)


@archive_app.command("backup")
def archive_backup(
    config: Annotated[Path, typer.Option("--config", help="Settings file, YAML.")],
    output: Annotated[Path, typer.Option(help="File for the copy, outside the archive; an old one is replaced.")],
) -> None:
    """Copy the results' store, while the station runs or not: one checked file, of one moment. Frames are not in it.

    Exit status: 0 done, 1 not possible (it says why), 78 the settings are refused.
    """
    from inspector.commands import archive_commands

    raise typer.Exit(archive_commands.back_up(config, output))
