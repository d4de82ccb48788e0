"""The commands that read the archive of a station, which may go on inspecting meanwhile."""

from __future__ import annotations

import enum
from pathlib import Path
from typing import Annotated

import typer

reports_app = typer.Typer()

Archive = Annotated[Path | None, typer.Argument(help="Folder of the archive; default: the one that --config names.")]
Config = Annotated[Path | None, typer.Option("--config", help="Settings file of the station, YAML.")]
From = Annotated[str | None, typer.Option("--from", help="First sequence, or time, such as 2026-11-26T06:00.")]
To = Annotated[str | None, typer.Option("--to", help="Last sequence, or time that it ends before.")]


class What(enum.StrEnum):
    """Tables of the archive."""

    RESULTS = "results"
    DEFECTS = "defects"
    FRAMES = "frames"
    FAULTS = "faults"
    ACTIONS = "actions"
    PANELS = "panels"
    LAMP = "lamp"
    RUNS = "runs"
    SETTINGS = "settings"
    RECIPES = "recipes"


@reports_app.command()
def export(
    output: Annotated[Path, typer.Option(help="File: .csv, .jsonl, .json or .parquet.")],
    archive: Archive = None,
    config: Config = None,
    what: Annotated[What, typer.Option(help="Which table.")] = What.RESULTS,
    begin: From = None,
    end: To = None,
    recipe: Annotated[str | None, typer.Option(help="Results by this recipe only, its id or name.")] = None,
) -> None:
    """Write what was kept as a table, row by row, whole or not at all.

    Exit status: 0 written, 2 nothing done (it says why), 78 the settings are refused.
    """
    from inspector.archive_reading import export as command

    raise typer.Exit(command.run(archive, config, output, what.value, (begin, end), recipe))


@reports_app.command("export-columns")
def export_columns() -> None:
    """Print the manual's page on the tables that export writes."""
    from inspector.archive_reading import columns

    typer.echo(columns.as_markdown(), nl=False)


class ExplanationFormat(enum.StrEnum):
    """Forms of an explanation."""

    TEXT = "text"
    HTML = "html"
    JSON = "json"


@reports_app.command()
def explain(
    result: Annotated[str, typer.Argument(help="The result: its sequence, or its id of the store.")],
    archive: Archive = None,
    config: Config = None,
    frame: Annotated[int | None, typer.Option(min=0, help="Only this one of its frames, from 0.")] = None,
    format: Annotated[ExplanationFormat, typer.Option(help="How it is told.")] = ExplanationFormat.TEXT,
    output: Annotated[Path | None, typer.Option(help="File for it; default: standard output.")] = None,
) -> None:
    """Tell how a verdict came about: every step from pixels to limits with its numbers, recomputed from the frame.

    Exit status: 0 as recorded, to the last bit, or nothing could be recomputed; 1 it differs; 2 nothing
    done; 78 refused.
    """
    from inspector.archive_reading import explain as command

    raise typer.Exit(command.run(result, archive, config, frame, format.value, output))


@reports_app.command()
def report(
    subject: Annotated[
        str,
        typer.Argument(
            metavar="PANEL|SHIFT",
            help="A panel's id; DATE/HH:MM-HH:MM, or DATE/NAME with a name of the settings' shifts; result:SEQUENCE; or"
            " FROM..TO, by sequences or times.",
        ),
    ],
    archive: Archive = None,
    config: Config = None,
    output: Annotated[
        Path | None, typer.Option(help="HTML file; all that it shows is in it. Default: report-SUBJECT.html here.")
    ] = None,
) -> None:
    """Report on a panel, or on a shift, as one HTML file to keep, mail or print.

    Exit status: 0 written, 2 nothing done (it says why), 78 the settings are refused.
    """
    from inspector.archive_reading import report as command

    raise typer.Exit(command.run(subject, archive, config, output))
