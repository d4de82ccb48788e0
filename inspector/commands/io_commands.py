"""What `inspector io` does: the module's points for a technician at the cabinet, with the service stopped."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from threading import Event

import typer

from firmware_bridge.drivers.modbus_module import Found, ModbusModule
from firmware_bridge.errors import BridgeError, OutOfRange, WatchdogTripped
from firmware_bridge.factory import build_module
from firmware_bridge.wire.profiles_page import HEADINGS, rows
from inspector.commands import io_points
from inspector.commands.io_points import IoPoint
from inspector.settings import DeviceSettings, SettingsError, load_devices

EXIT_DONE, EXIT_DECLINED, EXIT_USAGE, EXIT_UNAVAILABLE, EXIT_SETTINGS_REFUSED = 0, 1, 2, 69, 78
"""Exit statuses: done; the question was answered no; no such point or value; the module cannot be used or does not do
as told (EX_UNAVAILABLE); the settings are refused (EX_CONFIG)."""

PIPE_COLUMNS = 160
"""Width of a table that no terminal limits."""


def list_points(config: Path) -> int:
    """Print the module's points; the wire is not touched. The exit status."""
    return _with_settings(config, lambda settings: _show_points(settings, {}))


def read(config: Path, names: Sequence[str]) -> int:
    """Print what points hold, and without names also how the module is set up. Nothing is written."""

    def show(settings: DeviceSettings) -> None:
        wanted = _chosen(settings, names)
        with _connected(settings) as module:
            _show_points(settings, io_points.read(module, wanted))
            if not names:
                _show_setup(module.found())

    return _with_settings(config, show)


def write(config: Path, name: str, value: str, *, yes: bool) -> int:
    """Set one point, after a question, and print what is read back. The exit status."""

    def ask_and_write(settings: DeviceSettings) -> int:
        (point,) = _chosen(settings, [name])
        io_points.check(point, value)
        with _connected(settings) as module:
            before = io_points.read(module, [point])[name]
            if not yes and not _confirmed(settings, point, before, value):
                typer.echo("nothing was written")
                return EXIT_DECLINED
            io_points.write(module, point, value, settings.lamp.tolerance_v)
            after = io_points.read(module, [point])[name]
            typer.echo(f"{name}: {before} -> {value}, reads back {after}")
        return EXIT_DONE

    return _with_settings(config, ask_and_write)


def watch(config: Path, names: Sequence[str], interval_s: float, count: int | None) -> int:
    """Print what points hold and then every change, ``count`` looks long (None: until Ctrl-C). The exit status."""

    def look(settings: DeviceSettings) -> None:
        wanted = _chosen(settings, names)
        pause, shown = Event(), dict[str, str]()
        with closing(_module(settings)) as module:
            module.connect()
            for _ in range(count) if count is not None else iter(int, 1):
                _show_changes(shown, _looked(module, wanted))
                pause.wait(interval_s)

    try:
        return _with_settings(config, look)
    except KeyboardInterrupt:
        return EXIT_DONE


def show_profiles() -> None:
    """Print the modules that there are profiles for."""
    _print_table("I/O modules", HEADINGS, rows())


def _with_settings(config: Path, work: Callable[[DeviceSettings], int | None]) -> int:
    """Do the work with the settings of the module and the lamp; errors are said and become exit statuses."""
    try:
        return work(load_devices(config)) or EXIT_DONE
    except SettingsError as error:
        typer.echo(f"{error}\nrefused: {config}", err=True)
        return EXIT_SETTINGS_REFUSED
    except OutOfRange as error:
        typer.echo(str(error), err=True)
        return EXIT_USAGE
    except BridgeError as error:
        hint = f"\nclear it: inspector io write --config {config} trip clear"
        typer.echo(f"{error}{hint if isinstance(error, WatchdogTripped) else ''}", err=True)
        return EXIT_UNAVAILABLE


def _chosen(settings: DeviceSettings, names: Sequence[str]) -> list[IoPoint]:
    """The points of these names, all without any. Raises OutOfRange."""
    known = io_points.points(settings.module.profile_row, settings.lamp.channel)
    for name in names:
        if name not in known:
            raise OutOfRange(name, f"no such point of {settings.module.profile}", f"there are: {', '.join(known)}")
    return [known[name] for name in names] or list(known.values())


def _module(settings: DeviceSettings) -> ModbusModule:
    module = build_module(settings.module)
    if module.simulated:
        typer.echo("a simulated module, started for this command: no running service's", err=True)
    return module


@contextmanager
def _connected(settings: DeviceSettings) -> Iterator[ModbusModule]:
    with closing(_module(settings)) as module:
        module.connect()
        yield module


def _looked(module: ModbusModule, wanted: Sequence[IoPoint]) -> dict[str, str]:
    """What the points hold, or what is wrong; after a failure the line is opened anew at the next look."""
    try:
        return io_points.read(module, wanted) | {"module": "answers"}
    except BridgeError as error:
        complaint = {"module": str(error)}
    try:
        module.connect()
    except BridgeError as error:
        complaint = {"module": str(error)}
    return complaint


def _show_changes(shown: dict[str, str], seen: Mapping[str, str]) -> None:
    for name, value in seen.items():
        if shown.get(name) != value:
            before = f"{shown[name]} -> " if name in shown else ""
            typer.echo(f"{time.strftime('%H:%M:%S')}  {name:<7} {before}{value}")
    shown.update(seen)
    sys.stdout.flush()


def _confirmed(settings: DeviceSettings, point: IoPoint, before: str, value: str) -> bool:
    what = f"{point.name}{f' ({point.note})' if point.note else ''}"
    question = f"{settings.module.profile_row.model}, unit {settings.module.unit}: set {what} from {before} to {value}?"
    try:
        return typer.confirm(question)
    except typer.Abort:  # no terminal to answer on
        typer.echo("")
        return False


def _show_points(settings: DeviceSettings, values: Mapping[str, str]) -> None:
    module = settings.module
    title = f"{module.profile_row.model}, unit {module.unit}, {_where(settings)}"
    known = _chosen(settings, list(values))
    headings = ("point", "what", "address", *(["value"] if values else []), "note")
    table = [(p.name, p.kind.value, p.address, *([values[p.name]] if values else []), p.note) for p in known]
    _print_table(title, headings, table)


def _where(settings: DeviceSettings) -> str:
    link = settings.module.link
    match link.kind:
        case "serial":
            return f"{link.port} at {link.baud} {link.parity}"
        case "tcp":
            return f"{link.host}:{link.port}"
        case _:
            return "simulated"


def _show_setup(found: Sequence[Found]) -> None:
    if not found:
        return
    table = [(one.held.meaning, one.held.point.manual, str(one.value), _as_wanted(one)) for one in found]
    _print_table("Set up", ("setting", "address", "holds", "the station needs"), table)


def _as_wanted(one: Found) -> str:
    if one.held.value is None:
        return "as it is"
    if one.right:
        return "this"
    return f"{one.held.value}: {'set at its start' if one.held.writable else 'set it with the maker’s tool'}"


def _print_table(title: str, headings: Sequence[str], table: Iterable[Sequence[str]]) -> None:
    from rich.console import Console
    from rich.table import Table

    shown = Table(title=title, title_justify="left")
    for column, heading in enumerate(headings):
        shown.add_column(heading, no_wrap=column == 0)
    for row in table:
        shown.add_row(*row)
    Console(width=None if sys.stdout.isatty() else PIPE_COLUMNS).print(shown)
