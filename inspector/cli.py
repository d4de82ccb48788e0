"""The commands. Each calls something below; heavy imports happen inside, so that the service starts fast."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(
    name="inspector",
    help="Finds seeds in glossy paint and measures their height from one grey image.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
config_app = typer.Typer(help="Check, show and document settings.", no_args_is_help=True)
app.add_typer(config_app, name="config")

ConfigFile = Annotated[Path, typer.Argument(help="Settings file, YAML.")]


def main() -> None:
    """Entry point of the `inspector` command."""
    app()


if __name__ == "__main__":
    main()
