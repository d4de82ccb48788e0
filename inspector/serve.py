"""`inspector run`: the service from its first line in the log to its exit status."""

from __future__ import annotations

import logging
import os
from pathlib import Path

from inspector.front import Front, log_problems
from inspector.publish.plc_server import PlcServerError
from inspector.settings import SettingsError, load
from inspector.signals import Signals

log = logging.getLogger(__name__)

EXIT_STOPPED, EXIT_PORT_TAKEN, EXIT_SETTINGS_REFUSED = 0, 69, 78
"""Exit statuses, as sysexits.h names them: done, EX_UNAVAILABLE, EX_CONFIG (which no restart mends)."""


def run(file: Path, panels: int | None = None, duration_s: float | None = None) -> int:
    """Serve until asked to stop, or for so many results or seconds; the exit status.

    Settings that are refused are named in the log, all of them.
    """
    signals = Signals()
    signals.install()
    _log_to_stderr()
    try:
        front = Front(load(file), signals)
        front.start()
    except SettingsError as error:
        log_problems(error)
        return EXIT_SETTINGS_REFUSED
    except PlcServerError as error:
        log.error("%s", error)
        return EXIT_PORT_TAKEN
    from inspector.daemon import Daemon, Limits  # the registers are answered while these are imported

    Daemon(file, front, signals).run(Limits(panels, duration_s))
    return EXIT_STOPPED


def _log_to_stderr() -> None:
    """One line an event; the journal stamps its own time."""
    stamp = "" if "JOURNAL_STREAM" in os.environ else "%(asctime)s "
    logging.basicConfig(level=logging.INFO, format=f"{stamp}%(levelname)s %(message)s")
