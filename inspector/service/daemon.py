"""The service behind its registers (:mod:`inspector.service.front`): for each trigger one cycle and one result.

The cycle (:mod:`inspector.service.cycle`) runs in the main thread, and that is all that feeds the watchdogs: the PLC's,
systemd's and, while the station waits, the I/O module's. The service ends only when it is asked to.
"""

from __future__ import annotations

import contextlib
import logging
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from firmware_bridge import factory
from firmware_bridge.errors import BridgeError, NoTrigger
from inspector import calibration_file, snapshots
from inspector.acquire.trigger import Trigger
from inspector.clock import ClockWatch
from inspector.faults import Fault
from inspector.handshake_table import Command
from inspector.lifecycle import Event, after
from inspector.model import Frame, PanelResult, Snapshot
from inspector.publish import console
from inspector.publish.plc_server import PlcServerError
from inspector.publish.result_log import Tell, on_terminal
from inspector.service import line_history, pace, recipe_choice
from inspector.service.cycle import Cycle
from inspector.service.front import Front, described
from inspector.service.last_good import Begun, log_problems
from inspector.service.ledger import Ledger
from inspector.service.panel_work import PanelWork
from inspector.service.plc_commands import carried_out
from inspector.service.settings_trial import SettingsTrial
from inspector.settings import Settings, SettingsError, configuration_hash, load, with_recipe
from inspector.signals import Signals, StopRequested
from inspector.stages import Inspection, inspection_of

log = logging.getLogger(__name__)

BEAT_S = 0.25
"""While it waits, the cycle shows this often that it lives."""
IDLE_CHECK_S = 2.0
"""While the station waits, lamp and module are looked at this often, so that what is shown stays true."""

INSPECTION_S = 1.5
"""An inspection that takes longer hangs: the PLC is told before two seconds are over."""


@dataclass(frozen=True, slots=True)
class Limits:
    """When the service ends by itself: after so many results, or so many seconds; None: never."""

    panels: int | None = None
    duration_s: float | None = None


class Daemon:
    """One station at work, behind its ``front``, which serves already. ``inspection`` and ``build`` make the inspection
    and the devices of settings; ``tell`` is told each result."""

    def __init__(
        self,
        file: Path,
        front: Front,
        signals: Signals,
        *,
        trial: SettingsTrial | None = None,
        inspection: Callable[[Settings], Inspection] = inspection_of,
        build: Callable[..., factory.Devices] = factory.build,
        tell: Tell = on_terminal,
    ) -> None:
        self._file, self._front, self._signals = file, front, signals
        self._settings, self._settings_recipe_id = front.settings, front.settings_recipe_id
        self._trial = trial or SettingsTrial(file, Begun(front.settings))
        self._notifier, self._snapshot, self._clock = front.notifier, front.snapshot, ClockWatch()
        self._make_inspection, self._build_devices = inspection, build
        self._sequence, self._control, self._outlets = front.sequence, front.control, front.outlets
        self._observed = front.observed
        self._online = self._control.online
        self._handlers: dict[Command, Callable[[int], None]] = {
            Command.CHANGE_RECIPE: self._change_recipe,
            Command.DISCARD_RESULTS: lambda _: self._control.discard_results(),
            Command.RESET_STATISTICS: self._reset_statistics,
        }
        self._tell = tell
        self._ledger = Ledger()
        self._panels: PanelWork | None = None
        self._spoken_s = -math.inf

    @property
    def port(self) -> int:
        """The TCP port of the registers."""
        return self._front.port

    @property
    def stall_after_s(self) -> float:
        """How long the cycle may be silent before the PLC is told, seconds."""
        return self._outlets.server.stall_after_s

    def run(self, limits: Limits) -> None:
        """Inspect until asked to stop or a limit is reached; the lamp is then at 0 V."""
        ends_s = math.inf if limits.duration_s is None else time.monotonic() + limits.duration_s
        last = math.inf if limits.panels is None else self._snapshot.sequence + limits.panels
        with contextlib.ExitStack() as at_end, contextlib.suppress(StopRequested):
            at_end.callback(self._stop)
            self._prepare(at_end)
            self._notifier.send("READY=1")
            while not self._signals.stop and self._snapshot.sequence < last and time.monotonic() < ends_s:
                self._turn(ends_s)

    def _prepare(self, at_end: contextlib.ExitStack) -> None:
        """Make devices and inspection; ``at_end`` is told what to close."""
        settings = self._settings
        devices = self._build(settings)
        inspect = self._make_inspection(settings)
        self._cycle = Cycle(settings, devices, inspect, waiting=self._waiting, grab_timed=self._observed.grab.add)
        self._history = line_history.LineHistory(settings)
        at_end.callback(self._ledger.close)
        self._outlets.gauges.append(self._ledger.gauges)
        self._ledger.take_over(settings)
        at_end.callback(self._history.close)
        at_end.callback(self._cycle.close)
        at_end.callback(self._say_farewell)
        self._trigger = self._triggered()
        self._panels = self._panel_work(settings)
        self._show(replace(self._snapshot, simulated=self._cycle.simulated))

    def _build(self, settings: Settings) -> factory.Devices:
        timed = self._observed.module_request.add
        return self._build_devices(settings.camera, settings.module, settings.lamp, module_timed=timed)

    def _panel_work(self, settings: Settings) -> PanelWork | None:
        return PanelWork.of(settings, lambda channel: self._cycle.read_input(channel), self._missed)

    @property
    def _missed(self) -> int:
        """Triggers that brought no cycle."""
        return self._trigger.missed + self._control.missed

    def _triggered(self, missed: int = 0, late: int = 0) -> Trigger:
        """What begins a cycle, by the settings."""
        cycle, control = self._settings.cycle, self._control
        if not pace.by_plc(cycle):
            control.cycle_lost()
        sources = pace.Sources(self._cycle.read_input, self._signals.take_triggers, lambda: control.trigger_s)
        return pace.trigger_of(cycle, sources, self._online, missed, late)

    def _turn(self, ends_s: float) -> None:
        """Wait for the trigger, then one cycle; or take over new settings."""
        if self._signals.reload:
            self._signals.reload = False
            self._reload()
        if self._trial.overdue:
            self._go_back()
        self._due_s()  # what was missed meanwhile is known before a panel's end is
        self._obey()
        if self._triggered_before(ends_s):
            self._inspect_one()

    def _triggered_before(self, ends_s: float) -> bool:
        """Wait, alive, until a cycle is to begin; False if something else is to be done first."""
        self._beat()
        while not self._interrupted:
            due_s = min(self._due_s(), ends_s)  # first: what was missed is told before a panel ends
            look_s = min(self._trigger.look_s, self._look_at_panels())
            now_s = time.monotonic()
            if due_s <= now_s:  # what the PLC wrote together with its trigger comes first: the trigger stays due
                return now_s < ends_s and not self._interrupted
            if now_s >= self._spoken_s + self._silence_s and due_s - now_s > BEAT_S:
                self._keep_ready()
            # Last: a recipe changed by people must not take back the TRIGGER_READY that the PLC may just have read.
            self._control.ready(self._awaits_plc)
            self._signals.wait(min(due_s - time.monotonic(), BEAT_S, look_s))
            self._beat()
            self._show_changed(self._ledger.shown(self._snapshot))
        return False

    @property
    def _interrupted(self) -> bool:
        """Whether something else is to be done than to wait for a trigger."""
        signals, control = self._signals, self._control
        asked = signals.stop or signals.reload or control.asks or control.online is not self._online
        return asked or self._trial.overdue

    @property
    def _awaits_plc(self) -> bool:
        """Whether a TRIGGER of the PLC would be taken."""
        return pace.by_plc(self._settings.cycle) and snapshots.can_inspect(self._snapshot)

    def _due_s(self) -> float:
        """When the next cycle begins; a trigger that cannot be read is a fault, and waited for."""
        try:
            return self._trigger.due_s(time.monotonic())
        except BridgeError as error:
            self._trigger_unread(error)
            self._show_changed(self._cycle.waits_for(self._snapshot, error))
            return math.inf

    def _trigger_unread(self, error: BridgeError) -> None:
        if self._panels is not None:
            self._panels.unread(f"whether a trigger came could not be read: {error}")

    def _keep_ready(self) -> None:
        self._show_changed(self._counted(self._cycle.keep_ready(self._snapshot)))
        self._trial.saw(self._snapshot)
        self._spoken_s = time.monotonic()

    @property
    def _silence_s(self) -> float:
        """How long the module may go unasked while the station waits: well under its watchdog's time."""
        watchdog_s = self._settings.module.watchdog_s or math.inf
        settles_s = self._cycle.missing_s
        return min(IDLE_CHECK_S, watchdog_s / 3, settles_s if settles_s > 0 else math.inf)

    @contextlib.contextmanager
    def _waiting(self) -> Iterator[None]:
        """Around what a device may take long for, within a deadline of its own: the cycle lives before and after."""
        self._beat()
        with self._signals.interruptible():
            yield
        self._beat()

    def _beat(self) -> None:
        self._outlets.server.beat()
        self._notifier.feed_watchdog(time.monotonic())

    def _inspect_one(self) -> None:
        """One cycle, and its result for everybody."""
        started_s, panel_id, missed_before = time.monotonic(), self._control.panel_id, self._control.missed_before
        self._trigger.begins(started_s)
        one_by_one = pace.one_by_one(self._settings.cycle)
        if one_by_one:
            self._show_changed(replace(self._snapshot, state=after(self._snapshot.state, Event.STARTED_SINGLE)))
        try:
            turn = self._cycle.turn(self._counted(self._snapshot), self._taken, self._wants_frame)
        except NoTrigger as waits:
            self._trigger.passed_over(waits.passed_over)
            self._keep_ready()
            return
        self._spoken_s = time.monotonic()
        inspection_us = None if turn.result is None else turn.result.elapsed_us
        self._observed.turned(self._spoken_s - started_s, inspection_us, self._cycle.levels)
        self._ledger.took(turn)
        shown = turn.snapshot
        if one_by_one:
            shown = replace(shown, state=after(shown.state, Event.FINISHED, Event.STOPPED))
        if self._panels is not None:
            self._panels.took(turn, self._trigger.missed_before + missed_before, panel_id)
        # Before anybody sees the result: whoever then triggers again is in time.
        self._trigger.ended(time.monotonic(), self._cycle.resume_s(started_s))
        if self._panels is None:
            self._publish(replace(shown, panel_id=panel_id or shown.panel_id), turn.name, turn.why)
        else:
            self._show(shown)
            self._outlets.server.beat(INSPECTION_S)
            self._publish_panels(self._panels)
        self._control.cycle_ended(self._awaits_plc)
        self._show_changed(self._counted(self._snapshot))
        self._trial.saw(self._snapshot)

    def _taken(self, frame: Frame | None) -> None:
        """The frame is there, or will not be: what is left waits for no device, so that silence is soon a stall."""
        try:
            if frame is not None:
                self._trigger.took(frame.frame_id, frame.taken_s)
            self._trigger.glance()
        except BridgeError as error:
            self._trigger_unread(error)
        try:
            if self._panels is not None:
                if frame is not None:
                    before_s = min(self._control.trigger_s, frame.taken_s)
                    self._panels.mark(self._control.take_panel_marks(), before_s, self._trigger.missed)
                self._panels.glance(self._missed)
        finally:
            self._outlets.server.beat(INSPECTION_S)

    def _wants_frame(self) -> bool:
        return self._panels is None or self._panels.wants_frame()

    def _look_at_panels(self) -> float:
        """See whether a panel has come or gone while the station waits; how soon to look again, seconds."""
        if self._panels is None:
            return math.inf
        # What was missed after a TRIGGER that waits to begin its cycle is told after that one's frame.
        self._panels.look(self._trigger.missed + self._control.missed_before)
        self._publish_panels(self._panels)
        return self._panels.look_s

    def _publish_panels(self, panels: PanelWork) -> None:
        """The results of panels that are done, and how far the one under way has come."""
        for panel in panels.results():
            self._cycle.panel_done()
            shown = snapshots.of_panel(self._counted(self._snapshot), panel, time.monotonic())
            self._publish(shown, console.frames_of(shown), panel.reasons_text, panel)
        self._show_changed(replace(self._snapshot, frames_so_far=panels.frames_so_far))

    def _publish(self, result: Snapshot, name: str, why: tuple[str, ...], panel: PanelResult | None = None) -> None:
        """A result for everybody, on the disk before anybody sees it."""
        self._ledger.burnt(self._cycle.levels.burnt_hours)
        kept = self._ledger.kept(self._history.after(result), why, panel)
        came_s = self._trigger.came_s
        self._show(replace(kept, response_us=None if came_s is None else 1e6 * (time.monotonic() - came_s)))
        self._tell(self._settings.log, self._snapshot, name, why)

    def _obey(self) -> None:
        """Do what the PLC asks besides inspections."""
        marks = self._control.take_panel_marks()
        if self._panels is not None:
            self._panels.mark(marks, self._control.trigger_s, self._trigger.missed)
            self._publish_panels(self._panels)
        if self._control.take_clear():
            self._cycle.try_again()
            self._ledger.clear()
            self._ledger.acted("PLC", "CLEAR_FAULT")
            self._show_changed(snapshots.cleared(self._snapshot))
            self._spoken_s = -math.inf
        if self._control.online is not self._online:
            self._online = self._control.online
            self._ledger.acted("PLC", "online" if self._online else "offline")
            self._trigger = self._triggered(self._trigger.missed, self._trigger.late)
            self._show_changed(replace(self._snapshot, state=after(self._snapshot.state, Event.STOPPED)))
        command = self._control.take_command()
        if command is not None:
            outcome = carried_out(command, self._handlers)
            self._ledger.acted(command.asker, f"command {command.command}", f"{command.argument}: {outcome.name}")
            self._control.command_ended(outcome)

    def _change_recipe(self, recipe_id: int) -> None:
        """Inspect by another recipe, once it has proved whole. Raises SettingsError, and then the old one stays."""
        new = with_recipe(self._settings, recipe_id)
        self._cycle.prove(new.recipe)
        self._take_over(new)
        self._show(self._snapshot)
        if self._settings.recipe_choice_file is not None:
            try:
                recipe_choice.keep(self._settings.recipe_choice_file, recipe_id, self._settings_recipe_id)
            except OSError as error:
                log.error("recipe %d is in use, but not after a restart: %s", recipe_id, error)

    def _reset_statistics(self, what: int) -> None:
        """Begin the statistics anew, as the command's argument says. Raises SettingsError if it says nothing."""
        self._history.reset(what)
        self._show(replace(self._snapshot, statistics=None))

    def _counted(self, snapshot: Snapshot) -> Snapshot:
        missed, late, unsynchronised = self._trigger.missed, self._trigger.late, self._clock.unsynchronised
        return replace(snapshot, missed_triggers=missed, late_triggers=late, clock_unsynchronised=unsynchronised)

    def _show_changed(self, snapshot: Snapshot) -> None:
        if snapshot != self._snapshot:
            self._show(snapshot)

    def _show(self, snapshot: Snapshot) -> None:
        snapshot = self._ledger.shown(snapshot)
        self._front.show(snapshot)
        self._snapshot = snapshot

    def _reload(self) -> None:
        """Take over the settings file if it is right; else say what is wrong and go on as before."""
        self._notifier.reloading()
        before = self._snapshot
        try:
            found = load(self._file)
            self._adopt(found)
            self._trial.tries(found, before)
            self._snapshot = replace(self._snapshot, settings_refused=False)
            log.info("settings taken over from %s, hash %08x", self._file, self._snapshot.configuration_hash)
            self._ledger.acted("settings", "taken over", f"{self._snapshot.configuration_hash:08x}")
        except SettingsError as error:
            log_problems(error)
            self._refuse()
        except (PlcServerError, calibration_file.CalibrationError, OSError) as error:
            log.error("%s", error)
            self._refuse()
        self._show(self._snapshot)
        self._notifier.send("READY=1")

    def _go_back(self) -> None:
        """The last good settings are in force again, since the new ones did not bring the station to Ready."""
        try:
            self._adopt(self._trial.go_back())
            self._ledger.acted("settings", "last good again", f"{self._snapshot.configuration_hash:08x}")
        except (SettingsError, PlcServerError, calibration_file.CalibrationError, OSError) as error:
            log.error("the last good settings cannot be used either: %s", error)
        self._refuse()
        self._show(self._snapshot)

    def _adopt(self, found: Settings) -> None:
        """Take settings over as they were read, with the recipe that the PLC chose after that."""
        self._take_over(recipe_choice.resumed(found), renews_certificates=True)
        self._settings_recipe_id = found.recipe.id

    def _refuse(self) -> None:
        fault = Fault.SETTINGS_REFUSED
        log.error("fault %d: %s. %s", fault, fault.meaning, fault.remedy, extra={"fault_code": fault})
        self._ledger.acted("settings", "refused")
        self._snapshot = replace(self._snapshot, settings_refused=True)

    def _take_over(self, new: Settings, *, renews_certificates: bool = False) -> None:
        """Change what differs and nothing else; all that can be refused comes before the first change."""
        old, inspect, panels = self._settings, self._make_inspection(new), self._panel_work(new)
        one_frame, new_hash = line_history.one_frame(new), configuration_hash(new)
        devices = self._build(new)
        self._outlets.reach(new, renews_certificates=renews_certificates)
        if self._panels is not None:
            self._panels.interrupted("recipe or settings were changed")
            self._publish_panels(self._panels)
        self._cycle.take_over(new, devices, inspect)
        self._history.take_over(new, one_frame)
        self._ledger.take_over(new)
        self._panels = panels.after(self._panels, new.camera == old.camera) if panels else None
        self._settings = new
        self._outlets.take_over(new, self._snapshot)
        self._sequence.move(new.plc.sequence_file)
        self._spoken_s = -math.inf
        self._trigger = self._triggered(self._trigger.missed, self._trigger.late)
        anew = described(self._snapshot, new, new_hash, Event.STOPPED, Event.UNPREPARED)
        if new_hash != self._snapshot.configuration_hash:
            anew = snapshots.taken_back(anew)
        self._snapshot = replace(anew, frames_so_far=0, simulated=self._cycle.simulated)

    def _say_farewell(self) -> None:
        self._notifier.send("STOPPING=1")
        if self._panels is not None and self._panels.under_way:
            log.warning("stopped within a panel: it has no result")
        self._control.ready(False)
        self._control.publish(snapshots.stopped(self._snapshot))

    def _stop(self) -> None:
        self._outlets.stop()
        self._sequence.ends(self._snapshot.sequence)
        log.info("stopped")
