"""What the station finds and what is done to it, kept in its archive; where settings name none, nothing is.

A result is in the store, on the disk, before anybody sees its sequence, unless the store takes longer than it may: then
the PLC is told (STORE_DEGRADED) and the line goes on. Nothing here raises, and nothing waits for an image.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from importlib.metadata import version

from firmware_bridge.wire.session import Recorded
from inspector import settings_version
from inspector.archive import entries
from inspector.archive.archive_settings import ArchiveSettings
from inspector.archive.claim import Claim
from inspector.archive.entries import Entry, Taken
from inspector.archive.recorder import Plan, Recorder, Version
from inspector.archive.session_frames import Inspected
from inspector.archive.store import Run
from inspector.archive.store_writer import StoreWriter
from inspector.metrics.observed import faults_of
from inspector.model import Image, PanelResult, Snapshot, Verdict
from inspector.outage import Outage
from inspector.recipe import Recipe, content_hash
from inspector.service.cycle import Turn
from inspector.settings import Settings

HOURS_STEP = 0.1
"""The bulb's burning hours are kept so often, hours."""
HELD_BYTES = 64_000_000
"""Images of a panel under way are held for its verdict in so much memory; more of them are not kept."""
SETTLES_S = 5.0
"""A disk that works again for so long is said to."""
CLOSE_STORE_S, CLOSE_FRAMES_S = 1.5, 1.0
"""A stop waits so long for what is still to be written."""

log = logging.getLogger(__name__)


class Ledger:
    """The archive of one station at work. ``clock`` gives Unix time."""

    def __init__(self, clock: Callable[[], float] = time.time) -> None:
        self._clock, self._started_s = clock, clock()
        self._books: _Books | None = None
        self._held: list[Taken] = []
        self._faults: dict[int, tuple[float, int]] = {}
        self._hours: float | None = None

    def take_over(self, settings: Settings) -> None:
        """Keep things by these settings from now on; before the first of them, nothing is kept."""
        archive, books = settings.archive, self._books
        self._held = []  # of a panel that has ended with the settings before
        left: list[Entry] = []
        if books is not None and (archive is None or archive.place != books.settings.place):
            left = self._closed(books)
            left, books = [*books.writer.standing, *left] if left else [], None
        if archive is None:
            _tell_lost(left)
        elif books is None:
            books = _Books(archive, Run(self._started_s, version("seed-inspector"), settings.station))
            books.go_on_with(left)
            self._hours = None  # these are to be found in each store
        if archive is not None and books is not None:
            books.go_by(archive, settings, self._clock())
        self._books = books

    def gauges(self) -> dict[str, float]:
        """How the archive stands, for who measures (:mod:`inspector.metrics.table`); empty without one."""
        return self._books.gauges() if self._books else {}

    def took(self, turn: Turn) -> None:
        """A cycle is done: its frame is of the result that comes next, or of its panel's. Without an image where that
        finds no room."""
        if self._books is None or turn.frame is None or turn.result is None or turn.wanted is None:
            return
        held = sum(taken.frame.image.nbytes for taken in self._held)
        fits = held + turn.frame.image.nbytes <= HELD_BYTES
        frame = turn.frame if fits else replace(turn.frame, image=turn.frame.image[:0].copy())
        spots = turn.result.highlights
        result = turn.result if spots is None else replace(turn.result, highlights=None)
        self._held.append(Taken(frame, result, turn.wanted.exposure_us, turn.wanted.lamp_v))

    def kept(self, result: Snapshot, texts: Sequence[str], panel: PanelResult | None = None) -> Snapshot:
        """A result as it may be shown: on the disk, or marked as not. ``panel``: what several frames say together."""
        taken, self._held = _of(self._held, panel)
        if self._books is None:
            return result
        return self._books.keep(result, self._clock(), texts, taken, panel)

    def shown(self, snapshot: Snapshot) -> Snapshot:
        """What is to be shown, with how the archive stands; faults that begin or end are kept."""
        books = self._books
        if books is None:
            return snapshot
        degraded = books.degraded
        if degraded:
            books.writer.watch()
        marked = replace(
            snapshot,
            store_degraded=degraded,
            store_damaged=books.damaged is not None,
            store_waiting=books.writer.waiting if degraded else 0,
        )
        self._note_faults(books, marked)
        return marked

    def acted(self, who: str, what: str, detail: str = "") -> None:
        """Somebody did something to the station."""
        if self._books is not None:
            self._books.writer.put(entries.action(self._clock(), who, what, detail))

    def burnt(self, hours: float) -> None:
        """How long the lamp has burnt."""
        if self._books is not None and (self._hours is None or abs(hours - self._hours) >= HOURS_STEP):
            self._hours = hours
            self._books.writer.put(entries.lamp(self._clock(), hours))

    def clear(self) -> None:
        """Somebody has seen that the store was damaged."""
        if self._books is not None:
            self._books.seen = self._books.writer.set_aside

    def close(self) -> None:
        """Write what waits; what cannot be written in a short time is lost, and said so."""
        if self._books is not None:
            _tell_lost(self._closed(self._books))
            self._books = None

    def _closed(self, books: _Books) -> list[Entry]:
        """What could not be written in a short time."""
        left_out = books.recorder.close(CLOSE_FRAMES_S)
        if left_out:
            log.warning("stopped with %d frames that were not written", left_out)
        return books.writer.close(CLOSE_STORE_S, self._clock())

    def _note_faults(self, books: _Books, snapshot: Snapshot) -> None:
        codes = {int(fault) for fault in faults_of(snapshot)}
        if codes == self._faults.keys():
            return
        now_s = self._clock()
        for code in codes - self._faults.keys():
            self._faults[code] = now_s, snapshot.sequence
            books.writer.put(entries.fault(now_s, code, snapshot.sequence))
        for code in self._faults.keys() - codes:
            began_s, sequence = self._faults.pop(code)
            books.writer.put(entries.fault(began_s, code, sequence, now_s))


class _Books:
    """Store and recorder of one folder."""

    def __init__(self, settings: ArchiveSettings, run: Run) -> None:
        self.settings = settings
        about = {"station": run.station, "program": run.program}
        folder, claim = settings.folder, Claim(*settings.place)
        self.recorder = Recorder(
            folder, settings.frames, about, Outage("keeping of frames", settles_s=SETTLES_S), claim.holds
        )
        store, store_log = Outage("results' store", settles_s=SETTLES_S), Outage("working in the store's log")
        self.writer = StoreWriter(folder, run, claim, store, store_log, self.recorder.make_room)
        self.seen: object = None
        self._last = 0
        self._version = Version("", "")
        self._recipe = ""

    @property
    def degraded(self) -> bool:
        """Whether a result that is shown, or would be next, may not be on the disk."""
        return not self.writer.has(self._last) or self.writer.hangs

    @property
    def damaged(self) -> object:
        """Where a damaged store was put, until somebody has seen it."""
        return self.writer.set_aside if self.writer.set_aside != self.seen else None

    def gauges(self) -> dict[str, float]:
        """By the names of the table of metrics."""
        return {
            "inspector_store_waiting_entries": self.writer.waiting,
            "inspector_store_lag_seconds": self.writer.lag_s(),
            "inspector_store_lost_entries_total": self.writer.lost,
            "inspector_archive_image_bytes": self.recorder.waiting_bytes,
            "inspector_archive_left_out_frames_total": self.recorder.left_out,
        }

    def go_on_with(self, left: Sequence[Entry]) -> None:
        """Write what another folder did not take."""
        for entry in left:
            self._last = self.writer.put(entry)

    def go_by(self, archive: ArchiveSettings, settings: Settings, now_s: float) -> None:
        """What comes is found by these settings: they are kept, whole."""
        self.settings, self.recorder.settings = archive, archive.frames
        try:
            found = settings_version.of(settings)
        except OSError as error:
            log.error("%s: the settings of what is inspected now are not kept (%s)", settings.calibration, error)
            self._version = Version("", "")
            return
        self._version = Version(found.name, found.as_json())
        self._recipe = f"{content_hash(settings.recipe):08x}"
        self.writer.stands("settings", entries.settings_version(found.name, now_s, self._version.text))
        recipe: Recipe = settings.recipe
        text = recipe.model_dump_json(indent=1)
        self.writer.stands("recipe", entries.recipe_version(self._recipe, recipe.id, recipe.name, now_s, text))

    def keep(
        self, result: Snapshot, at_s: float, texts: Sequence[str], taken: Sequence[Taken], panel: PanelResult | None
    ) -> Snapshot:
        """The result in the store, its frames on their way."""
        passed = result.verdict is Verdict.PASS
        plan = self.recorder.plan(passed, len(taken), at_s) if taken else None
        files = [f"{result.sequence:010d}-{number:02d}.png" for number in range(len(taken))]
        places = [
            plan.place(file) if plan and part.frame.image.size else None
            for file, part in zip(files, taken, strict=True)
        ]
        degraded = self.degraded
        marked = replace(result, store_degraded=degraded)
        names = self._version.name, self._recipe
        self._last = self.writer.put(entries.of_result(marked, at_s, texts, taken, places, names))
        if not degraded:
            self.writer.wait(self._last, self.settings.commit_wait_s)
        if plan is not None:
            self.recorder.put(plan, self._version, self._frames(plan, result, taken, files, panel))
        return result

    def _frames(
        self, plan: Plan, result: Snapshot, taken: Sequence[Taken], files: Sequence[str], panel: PanelResult | None
    ) -> list[tuple[Image, Recorded]]:
        """The frames with what their session is to say of them."""
        found = []
        for number, (part, file) in enumerate(zip(taken, files, strict=True)):
            frame, is_last = part.frame, number == len(taken) - 1
            if not frame.image.size:
                continue
            said = Inspected(
                self._version.name,
                plan.kept,
                part.result,
                result.sequence,
                panel.panel_id if panel else result.panel_id,
                number,
                part.travel_mm,
                panel if is_last else None,
                panel.gathered.missing if is_last and panel and panel.gathered else (),
                len(taken),
            )
            values = (frame.frame_id, frame.taken_at_s, frame.exposure_us, part.exposure_set_us, frame.lamp_v)
            found.append((frame.image, Recorded(file, *values, part.lamp_set_v, said.as_dict())))
        return found


def _tell_lost(left: Sequence[Entry]) -> None:
    if left:
        log.error("stopped with %d entries that were not in the store: they are lost", len(left))


def _of(held: list[Taken], panel: PanelResult | None) -> tuple[list[Taken], list[Taken]]:
    """The frames held that are of a result, and those that are of later ones."""
    if panel is None or panel.gathered is None:
        return held, []
    travels = [(part.result, part.travel_mm) for part in panel.gathered.frames]
    taken, after = [], 0
    for number, part in enumerate(held):
        travel_mm = next((travel for result, travel in travels if result is part.result), None)
        if travel_mm is not None:
            taken.append(replace(part, travel_mm=travel_mm))
            after = number + 1
    return taken, held[after:]
