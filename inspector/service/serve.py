"""`inspector run`: the service from its first line in the log to its exit status."""

from __future__ import annotations

import gc
import logging
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from inspector import heap, journal_log
from inspector.journal_log import JournalHandler, TextFormatter, leads_to_journal
from inspector.publish.plc_server import PlcServerError
from inspector.publish.result_log import ResultLog, on_terminal
from inspector.service import last_good
from inspector.service.front import Front
from inspector.service.last_good import log_problems
from inspector.settings import SettingsError
from inspector.signals import Signals

if TYPE_CHECKING:
    from inspector.metrics.table import Gauges

log = logging.getLogger(__name__)

EXIT_STOPPED, EXIT_PORT_TAKEN, EXIT_SETTINGS_REFUSED = 0, 69, 78
"""Exit statuses, as sysexits.h names them: done, EX_UNAVAILABLE, EX_CONFIG (which no restart mends)."""


def run(file: Path, panels: int | None = None, duration_s: float | None = None) -> int:
    """Serve until asked to stop, or for so many results or seconds; the exit status.

    Settings that are refused are named in the log, all of them, and the last good ones used in their place, if any are.
    """
    heap.keep_images_off()
    signals = Signals()
    signals.install()
    gauges = _begin_log()
    tell = ResultLog().tell if leads_to_journal(sys.stdout.fileno()) else on_terminal
    try:
        begun = last_good.begin(file, last_good.state_folder())
        front = Front(begun.settings, signals, settings_refused=begun.refused)
        front.outlets.gauges += gauges
        front.start()
    except SettingsError as error:
        log_problems(error)
        return EXIT_SETTINGS_REFUSED
    except PlcServerError as error:
        log.error("%s", error)
        return EXIT_PORT_TAKEN
    from inspector.service import permissions  # the registers are answered while these are imported
    from inspector.service.daemon import Daemon, Limits
    from inspector.service.settings_trial import SettingsTrial

    gc.freeze()  # what is imported by now is never garbage, and no collection need look at it
    gc.enable()
    folder = last_good.state_folder()
    for misfit in permissions.misfits(file, begun.settings, folder):
        log.warning("%s", misfit)
    trial = SettingsTrial(file, begun, folder)
    Daemon(file, front, signals, trial=trial, tell=tell).run(Limits(panels, duration_s))
    return EXIT_STOPPED


def _begin_log() -> tuple[Gauges, ...]:
    """One line an event: to the journal by its own protocol if stderr leads there, else as text to stderr. What the log
    offers to be measured."""
    journal = JournalHandler(journal_log.SOCKET) if leads_to_journal(sys.stderr.fileno()) else None
    text = logging.StreamHandler()
    text.setFormatter(TextFormatter("%(asctime)s %(levelname)s %(message)s"))
    logging.basicConfig(level=logging.INFO, handlers=[journal or text])
    return (lambda: {"inspector_log_lines_lost_total": journal.lost},) if journal else ()
