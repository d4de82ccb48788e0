"""The command that looks at a running service from outside."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def health(
    config: Annotated[Path | None, typer.Option("--config", help="Settings file, YAML.")] = None,
    address_file: Annotated[
        Path | None, typer.Option(help="Instead: the file in which a service of systemd's says where it serves.")
    ] = None,
) -> None:
    """Ask a running service's registers how it is, as its PLC would.

    Exit status: 0 healthy, 1 it answers and is not well, 69 it answers nothing, 78 the settings are refused.
    """
    from inspector.commands import health as command

    if (config is None) is (address_file is None):
        raise typer.BadParameter("say either --config or --address-file")
    raise typer.Exit(command.run(config, address_file))
