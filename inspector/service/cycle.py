"""From trigger to result: lamp -> exposure -> grab -> inspect. Whatever goes wrong on the way is a result too.

Knows no thread, socket or file; the time comes from ``clock``. It keeps the devices, each opened with back-off of its
own, and moves what they are set to from panel to panel (:mod:`inspector.acquire.tuning`).
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, replace
from pathlib import Path

from firmware_bridge.contracts import Camera, Lamp
from firmware_bridge.errors import BridgeError, DeviceGone, NoTrigger
from firmware_bridge.factory import Devices
from inspector import snapshots
from inspector.acquire.capture import Wanted, capture, prepare
from inspector.acquire.device_faults import fault_of
from inspector.acquire.fresh import FreshFrames
from inspector.acquire.keeper import Keeper, Retry, Waiting
from inspector.acquire.tuning import LightWrong, Tuning
from inspector.faults import Fault
from inspector.metrics.observed import Levels
from inspector.model import Frame, FrameResult, Snapshot, Verdict
from inspector.outage import Outage
from inspector.recipe import Recipe
from inspector.recipe_proof import beyond_camera
from inspector.settings import Settings, SettingsError
from inspector.stages import Inspection
from inspector.yaml_document import Problem, path_text, short

log = logging.getLogger(__name__)

OUTAGE_CYCLE_S = 0.5
"""A free-running cycle without its devices comes round this often at least, so that what is shown stays true."""


def _nothing(frame: Frame | None) -> None:
    """Nobody wants to look in the middle of a cycle."""


Glance = Callable[[Frame | None], None]


def _always() -> bool:
    """Every frame is of a panel."""
    return True


@dataclass(frozen=True, slots=True)
class Turn:
    """What a cycle came to: the result, the frame's name and id (empty and None without a frame), and the reasons.

    ``frame`` and ``result`` are the cycle's part of a panel (None: there was none that could be inspected, or it was
    not of a panel); where a panel has several frames the snapshot is no result yet.
    """

    snapshot: Snapshot
    name: str = ""
    frame_id: int | None = None
    why: tuple[str, ...] = ()
    frame: Frame | None = None
    result: FrameResult | None = None
    wanted: Wanted | None = None
    """What the frame was to be taken at."""


class Cycle:
    """A station's devices at work. ``waiting`` is entered around waits that a stop need not sit out; ``grab_timed`` is
    told how long each frame was waited for, seconds."""

    def __init__(
        self,
        settings: Settings,
        devices: Devices,
        inspect: Inspection,
        *,
        waiting: Waiting = nullcontext,
        grab_timed: Callable[[float], None] = lambda _: None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._settings, self._devices, self._inspect, self._clock = settings, devices, inspect, clock
        self._grab_timed = grab_timed
        camera = FreshFrames(devices.camera)
        self._camera: Keeper[Camera] = Keeper("camera", camera, _retry(settings), waiting=waiting, clock=clock)
        self._lamp: Keeper[Lamp] = Keeper("lamp", devices.lamp, _retry(settings), waiting=waiting, clock=clock)
        self._frames, self._program = Outage("frame", clock), Outage("inspection", clock)
        self._light = Outage("light", clock)
        self._tuning = Tuning(settings.recipe, settings.light)
        self._waiting = waiting
        self._prepared: Wanted | None = None
        self._weak = False
        self._lit: tuple[Frame, float] | None = None
        self._settled_s: float | None = -math.inf

    @property
    def simulated(self) -> bool:
        """Whether any device is no real one."""
        return self._devices.camera.simulated or self._devices.lamp.simulated

    @property
    def wanted(self) -> Wanted:
        """How the next frame is to be taken."""
        lamp, level = self._settings.lamp, self._tuning.level
        volts = lamp.volts(level.lamp_percent)
        return Wanted(level.exposure_us, volts, lamp.tolerance_v, self._settings.cycle.exposure_tolerance)

    @property
    def levels(self) -> Levels:
        """What lamp and exposure are asked to be now."""
        level = self._tuning.level
        return Levels(level.lamp_percent, level.exposure_us, self._lamp.device.burnt_hours())

    def resume_s(self, started_s: float) -> float:
        """When the next cycle may begin, after one that began at ``started_s``: now, unless something failed."""
        now_s = self._clock()
        waiting = [keeper.due_s for keeper in (self._lamp, self._camera) if keeper.due_s > now_s]
        if waiting or self._program.lasts:
            return min([*waiting, started_s + OUTAGE_CYCLE_S])
        return now_s

    def turn(self, last: Snapshot, glance: Glance = _nothing, wanted: Callable[[], bool] = _always) -> Turn:
        """One frame taken and inspected; ``glance`` is called with it in between (None: there was none), then
        ``wanted`` asked whether it is of a panel. Raises NoTrigger, for which there is no turn: the camera waits."""
        started_s = self._clock()
        last = replace(last, lamp_set_v=self.wanted.lamp_v)
        try:
            return self._inspected(last, started_s, glance, wanted)
        except NoTrigger:
            raise
        except BridgeError as error:
            return self._failed(last, fault_of(error), str(error), started_s)
        except LightWrong as error:
            self._light.begins(error, fault_code=error.fault)
            return self._failed(last, error.fault, str(error), started_s)
        except Exception as error:
            what = f"{type(error).__name__}: {error}"
            self._program.begins(what, traceback=True, fault_code=Fault.INTERNAL)
            return self._failed(last, Fault.INTERNAL, what, started_s)

    def keep_ready(self, last: Snapshot) -> Snapshot:
        """While the station waits: lamp and camera as wanted, and spoken to, so that no watchdog takes it for dead."""
        last = replace(last, lamp_set_v=self.wanted.lamp_v)
        try:
            if self._prepared != self.wanted or not (self._lamp.works and self._camera.works):
                prepare(self._lamp, self._camera, self.wanted)
                self._prepared = self.wanted
                self._settle()
            else:
                self._lamp.use(lambda lamp: lamp.keep_alive())
        except BridgeError as error:
            return self.waits_for(last, error)
        return self._waits(last, Fault.LAMP_WARMING_UP if self.missing_s > 0 else Fault.NONE)

    def waits_for(self, last: Snapshot, error: BridgeError) -> Snapshot:
        """While the station waits: a device has failed."""
        return self._waits(last, fault_of(error))

    def read_input(self, channel: int) -> bool:
        """A digital input of the lamp's module. Raises BridgeError."""
        digital = self._devices.digital
        if digital is None:
            raise DeviceGone("module", "it has no digital inputs", "choose another trigger")
        return self._lamp.use(lambda _: digital.read_inputs()[channel])

    def try_again(self) -> None:
        """Devices that have failed are tried at the next use, not when their time comes."""
        self._lamp.hurry()
        self._camera.hurry()

    def prove(self, recipe: Recipe) -> None:
        """Ask the camera whether it can expose as a recipe says. Raises SettingsError, also if it cannot be asked."""
        try:
            found = [*beyond_camera(recipe, self._camera.use(lambda camera: camera.capabilities()))]
        except BridgeError as error:
            found = [((), recipe.id, f"cannot be proven: {error}")]
        if found:
            problems = (Problem("", path_text(("recipe", *place)), short(value), why) for place, value, why in found)
            raise SettingsError(tuple(problems))

    def take_over(self, settings: Settings, devices: Devices, inspect: Inspection) -> None:
        """Change what differs between the settings and nothing else: a device that stays as it was stays open."""
        old, camera, module = self._settings, self._devices.camera, self._devices
        if settings.camera != old.camera:
            camera = devices.camera
            self._camera.replace(FreshFrames(camera))
        if (settings.module, settings.lamp) != (old.module, old.lamp):
            module = devices
            self._lamp.replace(module.lamp)
        level = self._tuning.level
        if (settings.recipe, settings.light) != (old.recipe, old.light):
            self._tuning = Tuning(settings.recipe, settings.light)
        if self._tuning.level.lamp_percent != level.lamp_percent:
            self._settled_s = None
        self._camera.retry = self._lamp.retry = _retry(settings)
        self._settings, self._inspect = settings, inspect
        self._devices = replace(module, camera=camera)

    def close(self) -> None:
        """Put the lamp out, also after an outage in which it stayed lit; then close the camera."""
        self._lamp.try_again()
        self._lamp.close()
        self._camera.close()

    def panel_done(self) -> None:
        """A panel of several frames has ended: exposure and lamp move for the next one."""
        if self._lit is not None:
            self._trim(*self._lit)
            self._lit = None
        self._move_level()

    @property
    def missing_s(self) -> float:
        """For how long the lamp must still be lit before its light counts as steady, seconds; 0 or less: it does."""
        lamp = self._settings.lamp
        settles_s = lamp.settle_s if self._settled_s is None else self._settled_s - self._clock()
        return max(lamp.warm_up_s - self._lamp.worked_s, settles_s)

    def _settle(self) -> None:
        """The lamp has its level: from now on it takes its time to follow, if the level is another one."""
        if self._settled_s is None:
            self._settled_s = self._clock() + self._settings.lamp.settle_s

    def _inspected(self, last: Snapshot, started_s: float, glance: Glance, wanted: Callable[[], bool]) -> Turn:
        asked = self.wanted
        try:
            frame = capture(self._lamp, self._camera, asked, self._grabbing)
        except NoTrigger:
            raise
        except BridgeError:
            glance(None)
            raise
        self._settle()
        glance(frame)
        if self.missing_s > 0:
            return self._failed(last, Fault.LAMP_WARMING_UP, f"{self.missing_s:.0f} s left", started_s, frame)
        taken_s = self._clock()
        self._check_light(frame, taken_s)
        several = self._settings.panel.several
        if several and not wanted():
            return Turn(snapshots.taken(self._with_devices(last), frame), frame_id=frame.frame_id, frame=frame)
        result = self._inspect(self._tuning.to_inspect(frame))
        self._note(result)
        now_s = self._clock()
        result = replace(result, elapsed_us=(now_s - taken_s) * 1e6)
        self._tuning.saw(result)
        last, name = self._with_devices(last), Path(frame.name).name
        if several:
            result = replace(result, highlights=None)
            shown = snapshots.taken(last, frame, result)
        else:
            self._move_level()
            shown = snapshots.inspected(
                last, frame, result, snapshots.Times(now_s, result.elapsed_us, (now_s - started_s) * 1e6)
            )
        return Turn(shown, name, frame.frame_id, result.reasons_text, frame, result, asked)

    @contextmanager
    def _grabbing(self) -> Iterator[None]:
        began_s = self._clock()
        with self._waiting():
            yield
        self._grab_timed(self._clock() - began_s)

    def _check_light(self, frame: Frame, taken_s: float) -> None:
        """Raise LightWrong if the frame was not taken in the light that it should be; the lamp is trimmed by it,
        between panels."""
        try:
            self._tuning.check(frame)
        except LightWrong:
            self._trim(frame, taken_s)
            raise
        if self._settings.panel.several:
            self._lit = frame, taken_s
        else:
            self._trim(frame, taken_s)
        self._light.ends()

    def _note(self, result: FrameResult) -> None:
        """The inspection works; a row of frames that cannot be judged is said once."""
        self._program.ends()
        if result.verdict is Verdict.NOT_INSPECTED:
            self._frames.begins("; ".join(result.reasons_text))
        else:
            self._frames.ends()

    def _move_level(self) -> None:
        """The level for the next panel. A camera that fails meanwhile is found failing there."""
        if self._tuning.follows_spots:
            with suppress(BridgeError):
                self._tuning.panel_done(self._camera.use(lambda camera: camera.capabilities()))

    def _trim(self, frame: Frame, now_s: float) -> None:
        """The lamp's level for the next frame; a lamp that comes near its end is said once."""
        self._tuning.trim(frame, now_s)
        if self._tuning.is_weak and not self._weak:
            weak = Fault.LAMP_WEAK
            log.warning("fault %d: %s. %s", weak, weak.meaning, weak.remedy, extra={"fault_code": weak})
        self._weak = self._tuning.is_weak

    def _failed(self, last: Snapshot, fault: Fault, why: str, started_s: float, frame: Frame | None = None) -> Turn:
        now_s = self._clock()
        times = snapshots.Times(now_s, 0.0, (now_s - started_s) * 1e6)
        if self._settings.panel.several:
            shown = snapshots.waiting(self._with_devices(last), fault)
        else:
            shown = snapshots.not_inspected(self._with_devices(last), fault, times)
        return Turn(shown, frame_id=frame.frame_id if frame else None, why=(f"{fault.name}: {why}",))

    def _waits(self, last: Snapshot, fault: Fault) -> Snapshot:
        return snapshots.waiting(self._with_devices(last), fault)

    def _with_devices(self, last: Snapshot) -> Snapshot:
        return replace(last, lamp_ok=self._lamp.works, camera_ok=self._camera.works, lamp_weak=self._weak)


def _retry(settings: Settings) -> Retry:
    return Retry(settings.cycle.retry_first_s, settings.cycle.retry_longest_s)
