"""The service: registers served from the first moment, one cycle lamp -> exposure -> grab -> inspect -> publish.

The cycle runs in the main thread and is all that feeds the watchdogs, the PLC's and systemd's. What a cycle meets
ends in one published result (:mod:`inspector.snapshots`); the service itself ends only when it is asked to.
"""

from __future__ import annotations

import contextlib
import logging
import math
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from firmware_bridge import factory
from firmware_bridge.contracts import Camera, Lamp
from firmware_bridge.errors import BridgeError
from inspector import calibration_file, snapshots
from inspector.acquire.capture import Wanted, capture
from inspector.acquire.device_faults import fault_of
from inspector.acquire.keeper import Keeper, Retry
from inspector.acquire.outage import Outage
from inspector.faults import Fault
from inspector.lifecycle import Event, after
from inspector.model import Frame, FrameResult, Snapshot, Verdict
from inspector.publish import console
from inspector.publish.plc_server import PlcServer, PlcServerError
from inspector.publish.systemd import Notifier
from inspector.settings import Settings, SettingsError, Timed, configuration_hash, load
from inspector.signals import Signals, StopRequested

log = logging.getLogger(__name__)

BEAT_S = 0.25
"""While it waits, the cycle shows this often that it lives."""
OUTAGE_CYCLE_S = 0.5
"""A free-running cycle without its devices comes round this often at least, so that what is shown stays true."""
STALL_MARGIN_S = 1.5
"""What a cycle may take beyond all its devices' deadlines before the PLC is told that it has stalled."""
LAMP_REQUESTS = 4
"""Requests to the lamp's module in a cycle: write and read back, read after the grab, and 0 V when that fails."""

EXIT_STOPPED, EXIT_PORT_TAKEN, EXIT_SETTINGS_REFUSED = 0, 69, 78
"""Exit statuses, as sysexits.h names them: done, EX_UNAVAILABLE, EX_CONFIG (which no restart mends)."""

Inspection = Callable[[Frame], FrameResult]


@dataclass(frozen=True, slots=True)
class Limits:
    """When the service ends by itself: after so many results, or so many seconds; None: never."""

    panels: int | None = None
    duration_s: float | None = None


def run(file: Path, limits: Limits) -> int:
    """Serve until asked to stop; the exit status. Settings that are refused are named in the log, all of them."""
    signals = Signals()
    signals.install()
    _log_to_stderr()
    try:
        daemon = Daemon(file, load(file), signals)
        daemon.start()
    except SettingsError as error:
        _log_problems(error)
        return EXIT_SETTINGS_REFUSED
    except PlcServerError as error:
        log.error("%s", error)
        return EXIT_PORT_TAKEN
    daemon.run(limits)
    return EXIT_STOPPED


def inspection_of(settings: Settings) -> Inspection:
    """What inspects a frame of this station. Imports the stages: half a second that the registers do not wait for."""
    from inspector.pipeline import Station, inspect

    station = Station(calibration_file.read(settings.calibration), settings.recipe)
    return lambda frame: inspect(frame, station)


class Daemon:
    """One station at work. ``inspection`` and ``build`` are what makes the inspection and the devices of settings."""

    def __init__(
        self,
        file: Path,
        settings: Settings,
        signals: Signals,
        *,
        notifier: Notifier | None = None,
        inspection: Callable[[Settings], Inspection] = inspection_of,
        build: Callable[..., factory.Devices] = factory.build,
    ) -> None:
        self._file, self._settings, self._signals = file, settings, signals
        self._notifier = notifier or Notifier()
        self._make_inspection, self._build = inspection, build
        self._server = _server(settings)
        self._snapshot = Snapshot()
        self._frames, self._program = Outage("frame"), Outage("inspection")
        self._simulated = False
        self._due_s = time.monotonic()

    @property
    def port(self) -> int:
        """The TCP port of the registers."""
        return self._server.port

    def start(self) -> None:
        """Serve the registers, before anything else is done. Raises PlcServerError."""
        self._server.start()
        console.say(console.how_to_poll(self._settings.plc.host, self.port))
        self._show(self._described(self._snapshot, Event.CONFIGURED))

    def run(self, limits: Limits) -> None:
        """Inspect until asked to stop or a limit is reached; the lamp is then at 0 V."""
        ends_s = math.inf if limits.duration_s is None else time.monotonic() + limits.duration_s
        last = math.inf if limits.panels is None else self._snapshot.sequence + limits.panels
        with contextlib.ExitStack() as at_end, contextlib.suppress(StopRequested):
            at_end.callback(self._server_stop)
            self._prepare(at_end)
            self._notifier.send("READY=1")
            while not self._signals.stop and self._snapshot.sequence < last and time.monotonic() < ends_s:
                self._turn(ends_s)

    def _prepare(self, at_end: contextlib.ExitStack) -> None:
        """Make devices and inspection; ``at_end`` is told what to close, the lamp first."""
        settings = self._settings
        devices = self._build(settings.camera, settings.module, settings.lamp)
        retry, waiting = _retry(settings), self._signals.interruptible
        self._camera: Keeper[Camera] = Keeper("camera", devices.camera, retry, waiting=waiting)
        self._lamp: Keeper[Lamp] = Keeper("lamp", devices.lamp, retry, waiting=waiting)
        at_end.callback(self._camera.close)
        at_end.callback(self._lamp.close)
        at_end.callback(self._say_farewell)
        self._inspect = self._make_inspection(settings)
        self._simulated = devices.camera.simulated or devices.lamp.simulated
        self._show(self._described(self._snapshot))

    def _turn(self, ends_s: float) -> None:
        """Wait for the trigger, then one cycle; or take over new settings."""
        if self._signals.reload:
            self._signals.reload = False
            self._reload()
        self._wait_until(min(self._due_s, ends_s))
        if not self._signals.stop and not self._signals.reload and time.monotonic() < ends_s:
            self._cycle()

    def _wait_until(self, due_s: float) -> None:
        self._beat()
        while (left_s := due_s - time.monotonic()) > 0 and not self._signals.stop and not self._signals.reload:
            self._signals.wait(min(left_s, BEAT_S))
            self._beat()

    def _beat(self) -> None:
        self._server.beat()
        self._notifier.feed_watchdog(time.monotonic())

    def _cycle(self) -> None:
        """One frame taken, inspected and published; whatever goes wrong is published in its place."""
        started_s = time.monotonic()
        try:
            self._inspect_one(started_s)
        except BridgeError as error:
            self._fail(fault_of(error), str(error), started_s)
        except Exception as error:
            self._program.begins(f"{type(error).__name__}: {error}", traceback=True)
            self._fail(Fault.INTERNAL, f"{type(error).__name__}: {error}", started_s)
        self._schedule(started_s)

    def _inspect_one(self, started_s: float) -> None:
        frame = capture(self._lamp, self._camera, _wanted(self._settings), self._signals.interruptible)
        missing_s = self._settings.lamp.warm_up_s - self._lamp.worked_s
        if missing_s > 0:
            self._fail(Fault.LAMP_WARMING_UP, f"{missing_s:.0f} s left", started_s)
            return
        taken_s = time.monotonic()
        result = self._inspect(frame)
        self._note(result)
        now_s = time.monotonic()
        times = snapshots.Times(now_s, (now_s - taken_s) * 1e6, (now_s - started_s) * 1e6)
        self._show(snapshots.inspected(self._snapshot, frame, result, times))
        console.say(console.panel_line(self._snapshot, Path(frame.name).name, result.reasons_text))

    def _note(self, result: FrameResult) -> None:
        """The inspection works; a row of frames that cannot be judged is said once."""
        self._program.ends()
        if result.verdict is Verdict.NOT_INSPECTED:
            self._frames.begins("; ".join(result.reasons_text))
        else:
            self._frames.ends()

    def _fail(self, fault: Fault, why: str, started_s: float) -> None:
        now_s = time.monotonic()
        last = replace(self._snapshot, lamp_ok=self._lamp.works, camera_ok=self._camera.works)
        times = snapshots.Times(now_s, 0.0, (now_s - started_s) * 1e6)
        self._show(snapshots.not_inspected(last, fault, times))
        console.say(console.panel_line(self._snapshot, "", (f"{fault.name}: {why}",)))

    def _show(self, snapshot: Snapshot) -> None:
        self._server.publish(snapshot)
        self._snapshot = snapshot
        fault = f", fault {snapshot.fault_code}" if snapshot.fault_code else ""
        self._notifier.status(f"{snapshot.state.name}{fault}; registers on port {self.port}")

    def _schedule(self, started_s: float) -> None:
        """When the next cycle begins: at the next tick, when a failed device is due, or at once."""
        now_s, trigger = time.monotonic(), self._settings.cycle.trigger
        if isinstance(trigger, Timed):
            missed = max(0, math.floor((now_s - self._due_s) * trigger.rate_hz))
            self._due_s += (missed + 1) / trigger.rate_hz
            self._snapshot = replace(self._snapshot, missed_triggers=self._snapshot.missed_triggers + missed)
        elif self._program.lasts:
            self._due_s = started_s + OUTAGE_CYCLE_S
        else:
            waiting = [keeper.due_s for keeper in (self._lamp, self._camera) if keeper.due_s > now_s]
            self._due_s = min([*waiting, started_s + OUTAGE_CYCLE_S]) if waiting else now_s

    def _reload(self) -> None:
        """Take over the settings file if it is right; else say what is wrong and go on as before."""
        self._notifier.reloading()
        try:
            self._take_over(load(self._file))
            log.info("settings taken over from %s, hash %08x", self._file, self._snapshot.configuration_hash)
        except SettingsError as error:
            _log_problems(error)
            self._refuse()
        except (PlcServerError, calibration_file.CalibrationError, OSError) as error:
            log.error("%s", error)
            self._refuse()
        self._server.publish(self._snapshot)
        self._notifier.send("READY=1")

    def _refuse(self) -> None:
        fault = Fault.SETTINGS_REFUSED
        log.error("fault %d: %s. %s", fault, fault.meaning, fault.remedy)
        self._snapshot = replace(self._snapshot, settings_refused=True)

    def _take_over(self, new: Settings) -> None:
        """Change what differs and nothing else; what can be refused comes first."""
        old, inspect = self._settings, self._make_inspection(new)
        if new.plc != old.plc:
            self._serve_anew(new)
        devices = self._build(new.camera, new.module, new.lamp)
        if new.camera != old.camera:
            self._camera.replace(devices.camera)
        if (new.module, new.lamp) != (old.module, old.lamp):
            self._lamp.replace(devices.lamp)
        self._camera.retry = self._lamp.retry = _retry(new)
        self._settings, self._inspect, self._due_s = new, inspect, time.monotonic()
        self._simulated = devices.camera.simulated or devices.lamp.simulated
        anew = self._described(self._snapshot, Event.STOPPED, Event.UNPREPARED)
        self._snapshot = replace(anew, settings_refused=False)

    def _serve_anew(self, new: Settings) -> None:
        """Serve as ``new`` says. Raises PlcServerError, and then serves on as before."""
        server, in_the_way = _server(new), new.plc.port == self._settings.plc.port
        if in_the_way:
            self._server.stop()
        try:
            server.start()
        except PlcServerError:
            if in_the_way:
                self._server = _server(self._settings)
                self._server.start()
            raise
        self._server.stop()
        self._server = server
        console.say(console.how_to_poll(new.plc.host, self.port))

    def _described(self, snapshot: Snapshot, *events: Event) -> Snapshot:
        """The snapshot with what it says of the settings brought up to date."""
        settings = self._settings
        return replace(
            snapshot,
            state=after(snapshot.state, *events),
            recipe_id=settings.recipe.id,
            lamp_set_v=_wanted(settings).lamp_v,
            configuration_hash=configuration_hash(settings),
            simulated=self._simulated,
        )

    def _say_farewell(self) -> None:
        self._notifier.send("STOPPING=1")
        self._server.publish(snapshots.stopped(self._snapshot))

    def _server_stop(self) -> None:
        self._server.stop()
        log.info("stopped")


def _server(settings: Settings) -> PlcServer:
    plc = settings.plc
    longest_s = settings.camera.deadline_s + LAMP_REQUESTS * settings.module.deadline_s
    return PlcServer(stall_after_s=longest_s + STALL_MARGIN_S, **plc.model_dump())


def _retry(settings: Settings) -> Retry:
    return Retry(settings.cycle.retry_first_s, settings.cycle.retry_longest_s)


def _wanted(settings: Settings) -> Wanted:
    lamp, recipe = settings.lamp, settings.recipe
    return Wanted(
        recipe.exposure_us, lamp.volts(recipe.lamp_percent), lamp.tolerance_v, settings.cycle.exposure_tolerance
    )


def _log_problems(error: SettingsError) -> None:
    for problem in error.problems:
        log.error("settings refused: %s", problem)


def _log_to_stderr() -> None:
    """One line an event; the journal stamps its own time."""
    stamp = "" if "JOURNAL_STREAM" in os.environ else "%(asctime)s "
    logging.basicConfig(level=logging.INFO, format=f"{stamp}%(levelname)s %(message)s")
