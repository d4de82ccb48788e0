"""The commands. Each calls something below; heavy imports happen inside, so that the service starts fast."""

from __future__ import annotations

import enum
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


class RegisterFormat(enum.StrEnum):
    """Forms of the register map."""

    TABLE = "table"
    CSV = "csv"
    JSON = "json"
    MARKDOWN = "markdown"


ConfigFile = Annotated[Path, typer.Argument(help="Settings file, YAML.")]


@app.command()
def registers(format: Annotated[RegisterFormat, typer.Option(help="How to print it.")] = RegisterFormat.TABLE) -> None:
    """Print the register map that the PLC reads."""
    from inspector.publish.registers_page import FORMATS

    typer.echo(FORMATS[format.value](), nl=False)


def main() -> None:
    """Entry point of the `inspector` command."""
    app()


if __name__ == "__main__":
    main()
