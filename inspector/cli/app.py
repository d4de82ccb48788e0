"""The commands. Each calls something below; heavy imports happen inside, so that the service starts fast."""

from __future__ import annotations

import enum
import sys
from pathlib import Path
from typing import Annotated

import typer

from inspector.cli.archive import archive_app
from inspector.cli.health import health
from inspector.cli.page import page
from inspector.cli.recipes import recipe_app
from inspector.cli.reports import reports_app
from inspector.cli.sessions import Method, sessions_app

app = typer.Typer(
    name="inspector",
    help="Finds seeds in glossy paint and measures their height from one grey image.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
config_app = typer.Typer(help="Check, show and document settings.", no_args_is_help=True)
app.command()(health)
app.add_typer(config_app, name="config")
io_app = typer.Typer(help="The I/O module's points, at the cabinet, with the service stopped.", no_args_is_help=True)
app.add_typer(io_app, name="io")
lamp_app = typer.Typer(help="The lamp: its curve.", no_args_is_help=True)
app.add_typer(lamp_app, name="lamp")
app.add_typer(recipe_app, name="recipe")
app.add_typer(archive_app, name="archive")
app.add_typer(sessions_app)
app.add_typer(reports_app)
app.command()(page)
simulate_app = typer.Typer(help="Simulated devices, to try PLC and settings without hardware.", no_args_is_help=True)
app.add_typer(simulate_app, name="simulate-device")


class RegisterFormat(enum.StrEnum):
    """Forms of the register map."""

    TABLE = "table"
    CSV = "csv"
    JSON = "json"
    MARKDOWN = "markdown"


class ResultFormat(enum.StrEnum):
    """Forms of inspection results."""

    JSONL = "jsonl"
    CSV = "csv"
    TABLE = "table"


class PageFormat(enum.StrEnum):
    """Forms of a page of the manual."""

    TABLE = "table"
    MARKDOWN = "markdown"


class BenchFormat(enum.StrEnum):
    """Forms of measured times."""

    TABLE = "table"
    JSON = "json"


class ReportFormat(enum.StrEnum):
    """Forms of the doctor's report."""

    TEXT = "text"
    JSON = "json"


SettingsFile = Annotated[Path, typer.Option("--config", help="Settings file, YAML.")]
ConfigFile = Annotated[Path, typer.Argument(help="Settings file, YAML.")]


@app.command()
def inspect(
    frames: Annotated[list[str], typer.Argument(help="Frames: PNG, TIFF, BMP, PGM or .npy, grey, 8 or 16 bits.")],
    calibration: Annotated[Path, typer.Option(help="The camera's calibration file.")],
    recipe: Annotated[Path | None, typer.Option(help="Detection and limits, YAML; defaults where left out.")] = None,
    method: Annotated[Method | None, typer.Option(help="How heights are computed; default: the recipe's.")] = None,
    format: Annotated[ResultFormat, typer.Option(help="How results are printed.")] = ResultFormat.JSONL,
    overlay: Annotated[Path | None, typer.Option(help="Folder for a picture of each result.")] = None,
) -> None:
    """Inspect frames from files. Exit status: 0 all inspected, 1 some not inspected, 2 nothing could be done."""
    from inspector.commands import inspect_files

    raise typer.Exit(inspect_files.run(frames, calibration, recipe, method, format, overlay))


@app.command()
def panel(
    frames: Annotated[list[str], typer.Argument(help="Frames of one panel, in the order they were taken.")],
    config: SettingsFile,
    step_mm: Annotated[float | None, typer.Option(help="Travel from frame to frame; default: panel.travel's.")] = None,
    format: Annotated[ResultFormat, typer.Option(help="How the result is printed.")] = ResultFormat.TABLE,
    map: Annotated[Path | None, typer.Option(help="SVG file for the panel's map of seeds.")] = None,
) -> None:
    """Inspect frames from files as one panel. Exit status: 0 inspected, 1 not inspected, 2 nothing done, 78 refused."""
    from inspector.commands import panel_command

    raise typer.Exit(panel_command.run(frames, config, step_mm, format.value, map))


@app.command()
def registers(format: Annotated[RegisterFormat, typer.Option(help="How to print it.")] = RegisterFormat.TABLE) -> None:
    """Print the register map that the PLC reads."""
    from inspector.publish.registers_page import FORMATS

    typer.echo(FORMATS[format.value](), nl=False)


class CalibrationMethod(enum.StrEnum):
    """Ways to fit the camera."""

    REPROJECTION = "reprojection"
    TSAI = "tsai"


@app.command()
def calibrate(
    output: Annotated[Path, typer.Option(help="Calibration file to write, YAML.")],
    points: Annotated[Path | None, typer.Option(help="CSV: xw_mm, yw_mm, zw_mm, Xf_px, Yf_px.")] = None,
    board: Annotated[Path | None, typer.Option(help="Image of a board of bright squares on black.")] = None,
    heights: Annotated[
        Path | None, typer.Option(help="CSV of measured samples: frame, x_mm, y_mm, height_mm; fits the height gain.")
    ] = None,
    calibration: Annotated[
        Path | None, typer.Option(help="With --heights: the calibration to add the gain to.")
    ] = None,
    tolerance_mm: Annotated[float, typer.Option(help="With --heights: how far a sample may be from its defect.")] = 2.0,
    pitch_mm: Annotated[float | None, typer.Option(help="Board: distance of the squares' centres.")] = None,
    columns: Annotated[int | None, typer.Option(help="Board: squares along x.")] = None,
    rows: Annotated[int | None, typer.Option(help="Board: squares along y.")] = None,
    square_mm: Annotated[float | None, typer.Option(help="Board: side of a square; default: from the image.")] = None,
    method: Annotated[CalibrationMethod, typer.Option(help="Fit.")] = CalibrationMethod.REPROJECTION,
    width_px: Annotated[int | None, typer.Option(help="Sensor width; default: the image's, or 640.")] = None,
    height_px: Annotated[int | None, typer.Option(help="Sensor height; default: the image's, or 480.")] = None,
    dx_mm: Annotated[float, typer.Option(help="Pixel pitch in x.")] = 0.0075,
    dy_mm: Annotated[float, typer.Option(help="Pixel pitch in y.")] = 0.0075,
    cx_px: Annotated[float | None, typer.Option(help="Image centre, x; default: half the width.")] = None,
    cy_px: Annotated[float | None, typer.Option(help="Image centre, y; default: half the height.")] = None,
    sx: Annotated[float, typer.Option(help="Horizontal scale uncertainty.")] = 1.0,
    alpha_deg: Annotated[float, typer.Option(help="Lamp's angle from the panel's normal.")] = 30.0,
    azimuth_deg: Annotated[
        float | None, typer.Option(help="Lamp's direction on the panel, from x to y; default: opposite the camera.")
    ] = None,
    view_angle_deg: Annotated[float | None, typer.Option(help="Nominal view angle; default: as fitted.")] = None,
    overlay: Annotated[Path | None, typer.Option(help="Picture; default: beside the output, .overlay.png.")] = None,
) -> None:
    """Fit the camera to points or to the image of a board, or the height gain to samples; write a calibration file."""
    from inspector.commands import calibrate as command

    with command.refusals():
        command.check_sources(points, board, heights, calibration)
        if heights is not None and calibration is not None:
            from inspector.commands import calibrate_heights

            typer.echo(calibrate_heights.run(heights, calibration, output, tolerance_mm) + f"\n\ncalibration: {output}")
            return
        source = command.source(points, board, pitch_mm, columns, rows, square_mm)
        sensor = command.SensorOptions(width_px, height_px, dx_mm, dy_mm, cx_px, cy_px, sx)
        outcome = command.run(source, sensor, method.value)
        geometry = command.calibration(outcome.fit, alpha_deg, azimuth_deg, view_angle_deg)
        picture = overlay or output.with_suffix(".overlay.png")
        command.save(output, outcome, geometry, picture)
        typer.echo(f"{command.report(outcome)}\n\ncalibration: {output}\npicture:     {picture}")


@simulate_app.command(
    "module", context_settings={"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []}
)
def simulate_module(context: typer.Context) -> None:
    """An I/O module of any profile behind a pseudo-terminal; --help for its options."""
    from firmware_bridge.simulators import module

    module.main(context.args, context.command_path)


@simulate_app.command(
    "ccd", context_settings={"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []}
)
def simulate_ccd(context: typer.Context) -> None:
    """A CCD head on a serial line, with its frames in a pipe or a file; --help for its options."""
    from firmware_bridge.simulators import ccd_head

    ccd_head.main(context.args, context.command_path)


@app.command()
def run(
    config: Annotated[Path, typer.Option(help="Settings file, YAML.")],
    panels: Annotated[int | None, typer.Option(min=1, help="Stop after so many results.")] = None,
    duration_s: Annotated[float | None, typer.Option(min=0, help="Stop after so many seconds.")] = None,
) -> None:
    """Inspect panels and serve the results until SIGTERM or Ctrl-C; SIGHUP reads the settings again.

    Exit status: 0 stopped as asked, 69 the PLC port is taken, 78 the settings are refused.
    """
    from inspector.service import serve

    raise typer.Exit(serve.run(config, panels, duration_s))


@app.command()
def doctor(
    config: SettingsFile,
    format: Annotated[ReportFormat, typer.Option(help="How to print it.")] = ReportFormat.TEXT,
) -> None:
    """Try every device, port, file, disk and clock of a station, in order, with the service stopped; nothing is lit.

    Exit status: 0 the station can run, 1 it cannot.
    """
    from inspector.commands import doctor as command

    raise typer.Exit(command.run(config, format is ReportFormat.JSON))


@app.command()
def expose(
    config: SettingsFile,
    frames: Annotated[int, typer.Option(min=1, help="Frames looked at in each step.")] = 1,
    settle_s: Annotated[float, typer.Option(min=0, help="The lamp's time to follow its level, seconds.")] = 1.0,
    write: Annotated[bool, typer.Option("--write", help="Write what was found into the recipe.")] = False,
) -> None:
    """Find the longest exposure and lowest lamp level at which no spot bleeds, with a panel in view.

    Exit status: 0 found, 1 there is none (it says why), 69 a device cannot be used, 78 the settings are refused.
    """
    from inspector.commands import expose as command

    raise typer.Exit(command.run(config, frames=frames, settle_s=settle_s, write=write))


@app.command()
def record(
    config: SettingsFile,
    output: Annotated[Path, typer.Option(help="A new folder for the session.")],
    frames: Annotated[int, typer.Option(min=1, max=999_999, help="How many frames.")] = 100,
    settle_s: Annotated[float, typer.Option(min=0, help="The lamp's time to follow its level, seconds.")] = 1.0,
) -> None:
    """Keep frames as a session, with the exposure and lamp level each was taken at; the replay camera shows it.

    Exit status: 0 recorded, 1 not possible (it says why), 69 a device cannot be used, 78 the settings are refused.
    """
    from inspector.commands import record as command

    raise typer.Exit(command.run(config, output, frames=frames, settle_s=settle_s))


@lamp_app.command("calibrate")
def lamp_calibrate(
    config: SettingsFile,
    output: Annotated[Path | None, typer.Option(help="The curve's file; default: the one of lamp.curve.")] = None,
    steps: Annotated[int, typer.Option(min=2, max=100, help="Steps from 0 to 5 V.")] = 20,
    frames: Annotated[int, typer.Option(min=1, help="Frames averaged at each level.")] = 4,
    settle_s: Annotated[float, typer.Option(min=0, help="The lamp's time to follow its level, seconds.")] = 3.0,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask, for scripts.")] = False,
) -> None:
    """Step the lamp's level, measure the light on the reference in the frame, write the percent-to-volt curve.

    Exit status: 0 written, 1 not confirmed or no curve, 69 a device cannot be used, 78 the settings are refused.
    """
    from inspector.commands import lamp_calibrate as command

    raise typer.Exit(command.run(config, output, steps=steps, frames=frames, settle_s=settle_s, yes=yes))


@app.command()
def bench(
    format: Annotated[BenchFormat, typer.Option(help="How to print it.")] = BenchFormat.TABLE,
    quick: Annotated[bool, typer.Option("--quick", help="Three rounds of each: to see that it works.")] = False,
) -> None:
    """Measure how long each stage takes, beside OpenCV, scikit-image and sep, on frames of 0.3 to 12 megapixels."""
    import json

    from inspector.commands import benchmark

    report = benchmark.run(quick=quick, progress=lambda text: typer.echo(text, err=True))
    typer.echo(json.dumps(report.as_json(), indent=1) if format is BenchFormat.JSON else benchmark.table(report))


@app.command()
def demo(
    loop: Annotated[bool, typer.Option("--loop", help="The paint loop, live: booth, registers, PLC.")] = False,
    panels: Annotated[int, typer.Option(min=1, max=60000, help="Panels to paint.")] = 3000,
    rate: Annotated[float, typer.Option(min=0.1, max=1000, help="Panels a second.")] = 30.0,
    seed: Annotated[int, typer.Option(min=0, help="Of the booth's luck.")] = 1,
    port: Annotated[int, typer.Option(min=0, max=65535, help="TCP port of the registers; 0: any free one.")] = 0,
    seeds: Annotated[int, typer.Option(min=0, help="Instead of showing one: so many booths, and a table.")] = 0,
    plc: Annotated[str, typer.Option(help="Another PLC program; it is given the port, orders by lines of JSON.")] = "",
    plot: Annotated[Path | None, typer.Option(help="With --seeds: also a plot, SVG, into this file.")] = None,
) -> None:
    """Show what is to be shown without hardware; the station on recorded frames is `run --config config/demo.yaml`.

    Exit status: 0 shown, 2 nothing was asked for, 69 the port cannot be had.
    """
    if not loop:
        typer.echo("say --loop for the paint loop; for the station: inspector run --config config/demo.yaml", err=True)
        raise typer.Exit(2)
    from inspector.lab.booth import Booth, Deed
    from inspector.lab.plc_program import PlcProgram
    from inspector.loop import demo as loop_demo
    from inspector.loop import plot as loop_plot
    from inspector.loop import proof as loop_proof

    if not seeds:
        pace, plc = loop_demo.Pace(panels, rate), plc or f"{sys.executable} -m inspector.lab.plc_client"
        raise typer.Exit(loop_demo.run(Booth(seed), Booth(seed), Deed.__getitem__, pace, port, plc))
    comparison = loop_proof.compare_keeping(Booth, PlcProgram, tuple(Deed), seeds, panels)
    typer.echo(f"{comparison.table()}\n{comparison.sentence()}")
    if plot:
        plot.write_text(loop_plot.svg(comparison))


@app.command()
def states() -> None:
    """Print the manual's page on the station's states."""
    from inspector import lifecycle

    typer.echo(lifecycle.markdown(), nl=False)


@app.command()
def handshake() -> None:
    """Print the integrator's page on the handshake with the PLC: rules, dialogues, table."""
    from inspector.commands import handshake_page

    typer.echo(handshake_page.as_markdown(), nl=False)


@app.command("plc-package")
def plc_package(
    output: Annotated[Path, typer.Option(help="Folder; files of the same names are replaced.")],
) -> None:
    """Write what the line's controls engineer needs: register lists and pages. Exit status 1: not written."""
    from inspector.integrator import package

    try:
        files = package.write(output)
    except OSError as error:
        typer.echo(f"not written: {error}", err=True)
        raise typer.Exit(1) from error
    typer.echo("\n".join(map(str, files)))


@app.command()
def faults(format: Annotated[PageFormat, typer.Option(help="How to print it.")] = PageFormat.TABLE) -> None:
    """Print what can go wrong: fault, code, what the PLC sees, what the log says, how it recovers."""
    from inspector.commands import fault_table

    typer.echo(fault_table.FORMATS[format.value](), nl=False)


StationConfig = Annotated[Path, typer.Option("--config", help="Settings file, YAML; its module and lamp are used.")]
PointNames = Annotated[list[str] | None, typer.Argument(help="Points, such as ao0, di3, do0, trip; default: all.")]


@io_app.command("list")
def io_list(config: StationConfig) -> None:
    """The module's points, without touching it. Exit status: 0 done, 78 settings refused."""
    from inspector.commands import io_commands

    raise typer.Exit(io_commands.list_points(config))


@io_app.command("read")
def io_read(config: StationConfig, points: PointNames = None) -> None:
    """What points hold; nothing is written. Exit status: 0 done, 2 no such point, 69 no module, 78 settings refused."""
    from inspector.commands import io_commands

    raise typer.Exit(io_commands.read(config, points or []))


@io_app.command("write")
def io_write(
    config: StationConfig,
    point: Annotated[str, typer.Argument(help="Point: ao0, do0, or trip.")],
    value: Annotated[str, typer.Argument(help="Volts for ao; on or off for do; clear for trip.")],
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask, for scripts.")] = False,
) -> None:
    """Move an output, after a question. Exit status: 0 done, 1 not confirmed, 2 no such point or value, 69, 78."""
    from inspector.commands import io_commands

    raise typer.Exit(io_commands.write(config, point, value, yes=yes))


@io_app.command("watch")
def io_watch(
    config: StationConfig,
    points: PointNames = None,
    interval_s: Annotated[float, typer.Option(min=0.02, help="Time between looks, seconds.")] = 0.2,
    count: Annotated[int | None, typer.Option(min=1, help="End after so many looks; default: at Ctrl-C.")] = None,
) -> None:
    """Every change of points, until Ctrl-C; nothing is written."""
    from inspector.commands import io_commands

    raise typer.Exit(io_commands.watch(config, points or [], interval_s, count))


@io_app.command("profiles")
def io_profiles(format: Annotated[PageFormat, typer.Option(help="How to print it.")] = PageFormat.TABLE) -> None:
    """The modules that there are profiles for."""
    from firmware_bridge.wire import profiles_page
    from inspector.commands import io_commands

    if format is PageFormat.MARKDOWN:
        typer.echo(profiles_page.markdown(), nl=False)
    else:
        io_commands.show_profiles()


@config_app.command()
def check(file: ConfigFile) -> None:
    """Say everything that is wrong with a settings file; exit status 1 if anything is."""
    from inspector.commands import settings_commands

    raise typer.Exit(settings_commands.check(file))


@config_app.command()
def schema() -> None:
    """Print the JSON schema of settings, for editors and for people."""
    from inspector.commands import settings_commands

    typer.echo(settings_commands.schema(), nl=False)


@config_app.command()
def show(file: ConfigFile) -> None:
    """Print settings as they are understood, defaults filled in; exit status 1 if they are refused."""
    from inspector.commands import settings_commands

    raise typer.Exit(settings_commands.show(file))
