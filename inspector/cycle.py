"""From trigger to result: lamp -> exposure -> grab -> inspect. Whatever goes wrong on the way is a result too.

Knows no thread, socket or file; the time comes from ``clock``. It keeps the devices, each opened with back-off of its
own, and moves what they are set to from panel to panel (:mod:`inspector.acquire.tuning`).
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from contextlib import nullcontext, suppress
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
from inspector.acquire.outage import Outage
from inspector.acquire.tuning import LightWrong, Tuning
from inspector.faults import Fault
from inspector.model import Frame, FrameResult, Snapshot, Verdict
from inspector.settings import Settings

log = logging.getLogger(__name__)

OUTAGE_CYCLE_S = 0.5
"""A free-running cycle without its devices comes round this often at least, so that what is shown stays true."""

STALL_MARGIN_S = 1.5
"""What a cycle may take beyond its devices' deadlines before the PLC is told that it has stalled."""
LAMP_REQUESTS = 4
"""Requests to the lamp's module around a frame: write and read back, read after the grab, and 0 V when that fails."""

Inspection = Callable[[Frame], FrameResult]


def _nothing() -> None:
    """Nobody wants to look in the middle of a cycle."""


@dataclass(frozen=True, slots=True)
class Turn:
    """What a cycle came to: the result, the frame's name and id (empty and None without a frame), and the reasons."""

    snapshot: Snapshot
    name: str = ""
    frame_id: int | None = None
    why: tuple[str, ...] = ()


class Cycle:
    """A station's devices at work. ``waiting`` is entered around waits that a stop need not sit out."""

    def __init__(
        self,
        settings: Settings,
        devices: Devices,
        inspect: Inspection,
        *,
        waiting: Waiting = nullcontext,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._settings, self._devices, self._inspect, self._clock = settings, devices, inspect, clock
        camera = FreshFrames(devices.camera)
        self._camera: Keeper[Camera] = Keeper("camera", camera, _retry(settings), waiting=waiting, clock=clock)
        self._lamp: Keeper[Lamp] = Keeper("lamp", devices.lamp, _retry(settings), waiting=waiting, clock=clock)
        self._frames, self._program = Outage("frame", clock), Outage("inspection", clock)
        self._light = Outage("light", clock)
        self._tuning = Tuning(settings.recipe, settings.light)
        self._waiting = waiting
        self._prepared: Wanted | None = None
        self._weak = False

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

    def resume_s(self, started_s: float) -> float:
        """When the next cycle may begin, after one that began at ``started_s``: now, unless something failed."""
        now_s = self._clock()
        waiting = [keeper.due_s for keeper in (self._lamp, self._camera) if keeper.due_s > now_s]
        if waiting or self._program.lasts:
            return min([*waiting, started_s + OUTAGE_CYCLE_S])
        return now_s

    def turn(self, last: Snapshot, glance: Callable[[], None] = _nothing) -> Turn:
        """One frame taken and inspected; ``glance`` is called in between. Raises NoTrigger, for which there is no turn:
        the camera still waits."""
        started_s = self._clock()
        last = replace(last, lamp_set_v=self.wanted.lamp_v)
        try:
            return self._inspected(last, started_s, glance)
        except NoTrigger:
            raise
        except BridgeError as error:
            return self._failed(last, fault_of(error), str(error), started_s)
        except LightWrong as error:
            self._light.begins(error)
            return self._failed(last, error.fault, str(error), started_s)
        except Exception as error:
            what = f"{type(error).__name__}: {error}"
            self._program.begins(what, traceback=True)
            return self._failed(last, Fault.INTERNAL, what, started_s)

    def keep_ready(self, last: Snapshot) -> Snapshot:
        """While the station waits: lamp and camera as wanted, and spoken to, so that no watchdog takes it for dead."""
        last = replace(last, lamp_set_v=self.wanted.lamp_v)
        try:
            if self._prepared != self.wanted or not (self._lamp.works and self._camera.works):
                prepare(self._lamp, self._camera, self.wanted)
                self._prepared = self.wanted
            else:
                self._lamp.use(lambda lamp: lamp.keep_alive())
        except BridgeError as error:
            return self.waits_for(last, error)
        return self._waits(last, Fault.LAMP_WARMING_UP if self._missing_s > 0 else Fault.NONE)

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

    def take_over(self, settings: Settings, devices: Devices, inspect: Inspection) -> None:
        """Change what differs between the settings and nothing else: a device that stays as it was stays open."""
        old, camera, module = self._settings, self._devices.camera, self._devices
        if settings.camera != old.camera:
            camera = devices.camera
            self._camera.replace(FreshFrames(camera))
        if (settings.module, settings.lamp) != (old.module, old.lamp):
            module = devices
            self._lamp.replace(module.lamp)
        if (settings.recipe, settings.light) != (old.recipe, old.light):
            self._tuning = Tuning(settings.recipe, settings.light)
        self._camera.retry = self._lamp.retry = _retry(settings)
        self._settings, self._inspect = settings, inspect
        self._devices = replace(module, camera=camera)

    def close(self) -> None:
        """Put the lamp out, also after an outage in which it stayed lit; then close the camera."""
        self._lamp.try_again()
        self._lamp.close()
        self._camera.close()

    def _inspected(self, last: Snapshot, started_s: float, glance: Callable[[], None]) -> Turn:
        frame = capture(self._lamp, self._camera, self.wanted, self._waiting)
        with suppress(BridgeError):  # whoever looks next will see it
            glance()
        if self._missing_s > 0:
            return self._failed(last, Fault.LAMP_WARMING_UP, f"{self._missing_s:.0f} s left", started_s, frame)
        taken_s = self._clock()
        try:
            self._tuning.check(frame)
        finally:
            self._trim(frame, taken_s)
        self._light.ends()
        result = self._inspect(self._tuning.to_inspect(frame))
        self._note(result)
        now_s = self._clock()
        times = snapshots.Times(now_s, (now_s - taken_s) * 1e6, (now_s - started_s) * 1e6)
        self._panel_done(result)
        shown = snapshots.inspected(self._with_devices(last), frame, result, times)
        return Turn(shown, Path(frame.name).name, frame.frame_id, result.reasons_text)

    @property
    def _missing_s(self) -> float:
        """For how long the lamp must still be lit before it counts as warm, seconds."""
        return self._settings.lamp.warm_up_s - self._lamp.worked_s

    def _note(self, result: FrameResult) -> None:
        """The inspection works; a row of frames that cannot be judged is said once."""
        self._program.ends()
        if result.verdict is Verdict.NOT_INSPECTED:
            self._frames.begins("; ".join(result.reasons_text))
        else:
            self._frames.ends()

    def _panel_done(self, result: FrameResult) -> None:
        """The level for the next panel. A camera that fails meanwhile is found failing there."""
        if self._tuning.follows_spots:
            with suppress(BridgeError):
                self._tuning.panel_done(result, self._camera.use(lambda camera: camera.capabilities()))

    def _trim(self, frame: Frame, now_s: float) -> None:
        """The lamp's level for the next frame; a lamp that comes near its end is said once."""
        self._tuning.trim(frame, now_s)
        if self._tuning.is_weak and not self._weak:
            log.warning("fault %d: %s. %s", Fault.LAMP_WEAK, Fault.LAMP_WEAK.meaning, Fault.LAMP_WEAK.remedy)
        self._weak = self._tuning.is_weak

    def _failed(self, last: Snapshot, fault: Fault, why: str, started_s: float, frame: Frame | None = None) -> Turn:
        now_s = self._clock()
        times = snapshots.Times(now_s, 0.0, (now_s - started_s) * 1e6)
        shown = snapshots.not_inspected(self._with_devices(last), fault, times)
        return Turn(shown, frame_id=frame.frame_id if frame else None, why=(f"{fault.name}: {why}",))

    def _waits(self, last: Snapshot, fault: Fault) -> Snapshot:
        return snapshots.waiting(self._with_devices(last), fault)

    def _with_devices(self, last: Snapshot) -> Snapshot:
        return replace(last, lamp_ok=self._lamp.works, camera_ok=self._camera.works, lamp_weak=self._weak)


def longest_silence_s(settings: Settings) -> float:
    """How long a cycle may be silent: the longest step around which it waits, opening the module or taking a frame."""
    module = settings.module
    frame_s = settings.camera.slowest_s + LAMP_REQUESTS * module.deadline_s
    return max(frame_s, module.opening_s) + STALL_MARGIN_S


def _retry(settings: Settings) -> Retry:
    return Retry(settings.cycle.retry_first_s, settings.cycle.retry_longest_s)
