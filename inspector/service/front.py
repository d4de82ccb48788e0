"""What the PLC meets first: the registers, answered before devices, cycle and inspection are so much as imported.

Whatever this module imports, the PLC waits for; a rule of the house says what that may not be.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace

from inspector.lifecycle import Event, after
from inspector.metrics.observed import Observed
from inspector.model import Snapshot
from inspector.publish.systemd import Notifier
from inspector.recipe import content_hash
from inspector.sequence_file import SequenceFile
from inspector.service import recipe_choice
from inspector.service.control import PlcControl
from inspector.service.outlets import Outlets
from inspector.settings import Settings, configuration_hash
from inspector.signals import Signals

log = logging.getLogger(__name__)

PREPARING_S = 30.0
"""After the registers are served the cycle may take so long to begin: on a slow processor a first start does."""
LATE_S = 3.0
"""A disk that gives nothing for so long is told, seconds."""


class Front:
    """The registers of one station, and what becomes of what the PLC writes; the cycle joins when it is ready."""

    def __init__(
        self,
        settings: Settings,
        signals: Signals,
        notifier: Notifier | None = None,
        *,
        settings_refused: bool = False,
    ) -> None:
        self.notifier = notifier or Notifier()
        with _told_if_late(settings):
            self.settings, self.settings_recipe_id = recipe_choice.resumed(settings), settings.recipe.id
            self.sequence = SequenceFile(settings.plc.sequence_file)
        first = self.sequence.first
        self.snapshot = Snapshot(sequence=first, panel_id=first, settings_refused=settings_refused)
        self.control = PlcControl(self.snapshot, signals.wake)
        self.observed = Observed()
        self.outlets = Outlets(settings, self.control, self.notifier, self.observed)

    @property
    def port(self) -> int:
        """The TCP port of the registers."""
        return self.outlets.server.port

    def start(self) -> None:
        """Serve the registers, before anything else is done. Raises PlcServerError."""
        self.outlets.start(self.snapshot)
        _make_folder(self.settings)
        self.show(described(self.snapshot, self.settings, configuration_hash(self.settings), Event.CONFIGURED))
        self.outlets.server.beat(PREPARING_S)

    def show(self, snapshot: Snapshot) -> None:
        """Show this from now on, whole, to the PLC and to systemd."""
        self.sequence.reached(snapshot.sequence)
        self.control.publish(snapshot)
        self.observed.show(snapshot)
        self.snapshot = snapshot
        fault = f", fault {snapshot.fault_code}" if snapshot.fault_code else ""
        self.notifier.status(f"{snapshot.state.name}{fault}; registers on port {self.port}")


@contextmanager
def _told_if_late(settings: Settings) -> Iterator[None]:
    """Around the reading of what was kept over a restart. The registers wait for it, however long it takes: without it
    the sequence would go back."""
    files = " or ".join(str(file) for file in (settings.recipe_choice_file, settings.plc.sequence_file) if file)
    why = "the disk does not answer, and registers are not served before it does"
    remedy = "mount it again, or name files on another one (recipe_choice_file, plc.sequence_file)"
    late = threading.Timer(LATE_S, log.error, ("%s: %s; %s", files, why, remedy))
    late.daemon = True
    late.start()
    try:
        yield
    finally:
        late.cancel()


def _make_folder(settings: Settings) -> None:
    """Make the archive's folder, where small files are kept too; a disk that refuses is told when it is used."""
    if settings.archive is not None and settings.archive.disk is None:
        with suppress(OSError):
            settings.archive.folder.mkdir(parents=True, exist_ok=True)


def described(snapshot: Snapshot, settings: Settings, settings_hash: int, *events: Event) -> Snapshot:
    """The snapshot with what it says of the settings brought up to date. ``settings_hash`` is theirs, and of the
    calibration file (:func:`inspector.settings.configuration_hash`)."""
    return replace(
        snapshot,
        state=after(snapshot.state, *events),
        recipe_id=settings.recipe.id,
        recipe_hash=content_hash(settings.recipe),
        lamp_set_v=settings.lamp.volts(settings.recipe.lamp_percent),
        configuration_hash=settings_hash,
    )
