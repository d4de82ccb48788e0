"""The commands that look at recorded sessions again."""

from __future__ import annotations

import enum
from pathlib import Path
from typing import Annotated

import typer

sessions_app = typer.Typer()


class Method(enum.StrEnum):
    """How heights are computed."""

    EXACT = "exact"
    THESIS = "thesis"


class ReplayFormat(enum.StrEnum):
    """Forms of a comparison."""

    TABLE = "table"
    JSON = "json"


RecipeFile = Annotated[Path | None, typer.Option("--recipe", help="A recipe to use instead, YAML.")]
CalibrationFile = Annotated[Path | None, typer.Option("--calibration", help="A calibration file to use instead.")]
OtherMethod = Annotated[Method | None, typer.Option("--method", help="Compute heights so instead.")]
OtherConfig = Annotated[
    Path | None,
    typer.Option("--config", help="Settings to use instead; of their recipes the one of the recorded one's id."),
]
Jobs = Annotated[int | None, typer.Option(min=1, help="Processes; default: one for each core.")]


@sessions_app.command()
def replay(
    sessions: Annotated[list[Path], typer.Argument(help="Folders of sessions, or above such.")],
    recipe: RecipeFile = None,
    calibration: CalibrationFile = None,
    method: OtherMethod = None,
    config: OtherConfig = None,
    format: Annotated[ReplayFormat, typer.Option(help="How the comparison is printed.")] = ReplayFormat.TABLE,
    output: Annotated[Path | None, typer.Option(help="File for it; default: standard output.")] = None,
    plot: Annotated[Path | None, typer.Option(help="SVG file for a plot of heights then and now.")] = None,
    state: Annotated[
        Path | None, typer.Option(help="File that an interrupted run goes on from; default: beside --output.")
    ] = None,
    jobs: Jobs = None,
) -> None:
    """Inspect recorded frames again, by their own settings or by others, and compare with what was found then.

    Exit status: 0 all the same to the last bit, or all compared with other settings; 1 differences by their own
    settings, or not all could be compared (each is named); 2 nothing could be done.
    """
    from inspector.change_options import Asked
    from inspector.replay import command

    asked = Asked(recipe, calibration, method.value if method else None, config)
    raise typer.Exit(command.run(sessions, asked, command.Output(format.value, output, plot, state), jobs))


@sessions_app.command()
def reinspect(
    archive: Annotated[Path, typer.Argument(help="The archive, or a folder above sessions.")],
    output: Annotated[Path, typer.Option(help="NAME.parquet (and NAME.seeds.parquet), or a folder of partitions.")],
    scheduler: Annotated[
        str | None, typer.Option(help="A Dask cluster, tcp://HOST:PORT, that sees the archive under the same path.")
    ] = None,
    recipe: RecipeFile = None,
    calibration: CalibrationFile = None,
    method: OtherMethod = None,
    config: OtherConfig = None,
    jobs: Jobs = None,
) -> None:
    """Inspect an archive's frames again, by their own settings or by others, into Parquet tables; a run that was
    interrupted goes on. Without a scheduler on this machine's cores, with the same result.

    Exit status: 0 all the same to the last bit, or all compared with other settings; 1 differences by their own
    settings, or not all could be compared; 2 nothing could be done, or not all of it.
    """
    from inspector.change_options import Asked
    from inspector.replay import reinspect as command

    asked = Asked(recipe, calibration, method.value if method else None, config)
    raise typer.Exit(command.run(archive, asked, output, scheduler, jobs))


@sessions_app.command("reinspect-columns")
def reinspect_columns() -> None:
    """Print the manual's page on the tables that reinspect writes."""
    from inspector.replay import tables

    typer.echo(tables.as_markdown(), nl=False)
