"""The command `inspector page`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def page(
    config: Annotated[Path, typer.Option(help="Settings file of the station, YAML.")],
    host: Annotated[str | None, typer.Option(help="Address that browsers reach; default: page.host's.")] = None,
    port: Annotated[int | None, typer.Option(min=0, max=65535, help="Its port; default: page.port's.")] = None,
    set_password: Annotated[bool, typer.Option("--set-password", help="Ask for the password, keep it, end.")] = False,
    print_texts: Annotated[bool, typer.Option("--print-texts", help="Print the texts to translate, end.")] = False,
) -> None:
    """Serve the operator's page of a station that runs, until SIGTERM or Ctrl-C.

    Exit status: 0 stopped as asked, 69 the page's port is taken, 78 the settings are refused.
    """
    from inspector.hmi import serve

    if print_texts:
        raise typer.Exit(serve.print_texts())
    raise typer.Exit(serve.set_password(config) if set_password else serve.run(config, host, port))
