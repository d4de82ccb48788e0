"""`inspector page`: the page's process from its first line in the log to its exit status."""

from __future__ import annotations

import logging
import os
import signal
import sys
import threading
from pathlib import Path

import typer
import yaml
from pydantic import ValidationError

from firmware_bridge import factory
from inspector.hmi import gate, texts, texts_file
from inspector.hmi.gate import Gate
from inspector.hmi.known import Settled
from inspector.hmi.page import Page
from inspector.hmi.server import PageServer
from inspector.hmi.station import StationLink
from inspector.page_settings import PageSettings
from inspector.publish.address import EVERYWHERE
from inspector.publish.systemd import Notifier
from inspector.settings import Settings, SettingsError, load

log = logging.getLogger(__name__)

EXIT_STOPPED, EXIT_NOT_DONE, EXIT_PORT_TAKEN, EXIT_SETTINGS_REFUSED = 0, 1, 69, 78
"""Exit statuses, as sysexits.h names them: done, not done, EX_UNAVAILABLE, EX_CONFIG."""
STATION_DEADLINE_S = 1.0


def run(config: Path, host: str | None, port: int | None) -> int:
    """Serve the page until SIGTERM or Ctrl-C; the exit status."""
    stamp = "" if "JOURNAL_STREAM" in os.environ else "%(asctime)s "
    logging.basicConfig(level=logging.INFO, format=f"{stamp}%(levelname)s %(message)s")
    ends = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: ends.set())
    try:
        settings = load(config, secrets=False)
        given = {name: value for name, value in (("host", host), ("port", port)) if value is not None}
        page = PageSettings(**(settings.page.model_dump() | given))
        words, problems = texts_file.load(page.texts_file)
        if problems:
            raise SettingsError(problems)
    except SettingsError as error:
        log.error("settings refused: %s", error)
        return EXIT_SETTINGS_REFUSED
    except ValidationError as error:
        log.error("settings refused: %s", error.errors()[0]["msg"])
        return EXIT_SETTINGS_REFUSED
    return _serve(config, settings, page, words, ends)


def _serve(config: Path, settings: Settings, page: PageSettings, words: texts.Texts, ends: threading.Event) -> int:
    link = _link(settings, page)
    door = Gate((*page.names, page.host), page.password_file)
    shown = Page(
        settings.station, link, Settled(config, settings, words), door, words, allow_commands=page.allow_commands
    )
    try:
        server = PageServer(page.host, page.port, shown.answer)
    except OSError as error:
        log.error("the page cannot listen on %s:%d: %s; set another page.port", page.host, page.port, error.strerror)
        return EXIT_PORT_TAKEN
    link.start()
    threading.Thread(target=server.serve_forever, name="http", daemon=True).start()
    where = f"[{page.host}]" if ":" in page.host else page.host
    typer.echo(f"Page: http://{where}:{server.port}/")
    Notifier().send("READY=1", f"STATUS=http://{where}:{server.port}/")
    ends.wait()
    server.shutdown()
    server.server_close()
    link.stop()
    return EXIT_STOPPED


def _link(settings: Settings, page: PageSettings) -> StationLink:
    """The connection to the station's registers, not yet opened."""
    plc = settings.plc
    here = ("::1" if ":" in plc.host else "127.0.0.1") if plc.host in EVERYWHERE else plc.host
    host, port = page.station_host or here, page.station_port or plc.port
    master = factory.build_plc_master(host, port, plc.unit_ids[0], STATION_DEADLINE_S, device="station")
    return StationLink(master, f"{host}:{port}", plc.word_order)


def set_password(config: Path) -> int:
    """Ask for a password and keep it in the settings' file for it; the exit status."""
    try:
        file = load(config, secrets=False).page.password_file
    except SettingsError as error:
        print(error, file=sys.stderr)
        return EXIT_SETTINGS_REFUSED
    if file is None:
        print(f"{config}: name its file first, as page.password_file", file=sys.stderr)
        return EXIT_NOT_DONE
    try:
        gate.keep(file, typer.prompt("Password", hide_input=True, confirmation_prompt=True))
    except (OSError, ValueError) as error:
        print(f"{file}: {error}", file=sys.stderr)
        return EXIT_NOT_DONE
    print(f"{file}: holds at once, also for a page that runs")
    return EXIT_STOPPED


def print_texts() -> int:
    """Every text of the page by its key, as YAML: what a translation begins from; the exit status."""
    yaml.safe_dump(texts.english(), sys.stdout, sort_keys=False, allow_unicode=True, width=1000)
    return EXIT_STOPPED
