"""Random faults on module, lamp and camera: no PASS but for a frame taken as it should be, and no turn without an end.

The devices are fakes that know the truth; everything between them and the registers is the service's own. As many
sequences as FAULT_SEQUENCES says are run, a few hundred without it.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from firmware_bridge.contracts import CameraCapabilities, CameraFrame
from firmware_bridge.errors import (
    BridgeError,
    DeviceGone,
    NoReply,
    NoTrigger,
    ReadBackWrong,
    Refused,
    ReplyWrong,
    WatchdogTripped,
)
from firmware_bridge.factory import Devices
from inspector.faults import Fault
from inspector.model import Frame, FrameResult, Snapshot, State, Verdict
from inspector.publish.registers import decode, encode
from inspector.service.cycle import Cycle
from inspector.settings import Settings

SEQUENCES = int(os.environ.get("FAULT_SEQUENCES", "200"))
MODULE_DEADLINE_S, CAMERA_DEADLINE_S, WATCHDOG_S = 0.3, 1.0, 4.0
LONGEST_TURN_S = 2 * CAMERA_DEADLINE_S + 6 * MODULE_DEADLINE_S
TOLERANCE_V, EXPOSURE_TOLERANCE, LIGHT_TOLERANCE = 0.05, 0.01, 0.15
FULL_LIGHT_DN = 200.0
"""The reference with a new bulb at 5 V and 1000 us."""


class World:
    """The clock, and what is really so, whatever the devices say."""

    def __init__(self) -> None:
        self.now_s = 1000.0
        self.bulb = 1.0
        self.turn = 0
        self.truth: dict[int, Truth] = {}
        self.next_grab: list[Callable[[], None]] = []

    def clock(self) -> float:
        return self.now_s

    def wait(self, wait_s: float) -> None:
        self.now_s += wait_s


@dataclass(frozen=True)
class Truth:
    """How a frame was really taken: level on the terminal before and after, exposure, light on the reference."""

    turn: int
    before_v: float
    after_v: float
    exposure_us: float
    light_dn: float


class Module:
    """A lamp on a module with a watchdog, that fails as it is told."""

    simulated = False

    def __init__(self, world: World) -> None:
        self.world, self.fault = world, "none"
        self.output_v, self.is_open, self.tripped = 0.0, False, False
        self.spoken_s = world.now_s

    def open(self) -> None:
        self._talk()
        self.is_open, self.tripped = True, False

    def close(self) -> None:
        if self.is_open and self.fault == "none" and not self.tripped:
            self.output_v = 0.0
        self.is_open = False

    def set_volts(self, volts: float) -> float:
        self._talk()
        if self.fault != "stuck" and not self.tripped:
            self.output_v = volts
        if abs(self.output_v - volts) > TOLERANCE_V:
            raise (WatchdogTripped if self.tripped else ReadBackWrong)("lamp", "another level", "look")
        return self.output_v

    def read_volts(self) -> float:
        self._talk()
        return self.output_v

    def keep_alive(self) -> None:
        self._talk()
        if self.tripped:
            raise WatchdogTripped("module", "tripped", "reopen")

    def burnt_hours(self) -> float:
        return 0.0

    def watch(self) -> None:
        """What the module's own watchdog does while time passes."""
        if self.world.now_s - self.spoken_s > WATCHDOG_S:
            self.tripped, self.output_v = True, 0.0

    def _talk(self) -> None:
        self.watch()
        failures: dict[str, tuple[float, BridgeError]] = {
            "silent": (MODULE_DEADLINE_S, NoReply("module", "silent")),
            "gone": (0.0, DeviceGone("module", "unplugged")),
            "garbled": (0.01, ReplyWrong("module", "bad checksum")),
            "another unit": (0.02, ReplyWrong("module", "unit 7 answered")),
            "late": (MODULE_DEADLINE_S, NoReply("module", "late")),
            "refuses": (0.01, Refused("module", "exception 4")),
        }
        if self.fault in failures:
            wait_s, error = failures[self.fault]
            self.world.wait(wait_s)
            raise error
        self.world.wait(0.005)
        self.spoken_s = self.world.now_s


class Camera:
    """A camera that fails as it is told, and writes down how each frame was really taken."""

    simulated = False

    def __init__(self, world: World, module: Module) -> None:
        self.world, self.module, self.fault = world, module, "none"
        self.exposure_us, self.taken, self.counts_anew = 0.0, 0, False
        self.last: CameraFrame | None = None

    def open(self) -> None:
        if self.fault == "gone":
            raise DeviceGone("camera", "unplugged")
        if self.counts_anew:
            self.taken, self.counts_anew = 0, False

    def close(self) -> None: ...

    def capabilities(self) -> CameraCapabilities:
        return CameraCapabilities(1, 1e6, 1, 4, 3)

    def set_exposure_us(self, exposure_us: float) -> float:
        if self.fault == "gone":
            raise DeviceGone("camera", "unplugged")
        if self.fault == "refuses":
            raise Refused("camera", "no")
        self.exposure_us = exposure_us / 2 if self.fault == "clips" else exposure_us
        return self.exposure_us

    def grab(self) -> CameraFrame:
        self._fail()
        before_v = self.module.output_v
        self.world.wait(0.02)
        for happens in self.world.next_grab:
            happens()
        self.world.next_grab.clear()
        if self.fault == "old frame" and self.last is not None:
            return self.last
        self.taken += 3 if self.fault == "drops" else 1
        really_us = self.exposure_us * (3.0 if self.fault == "other exposure" else 1.0)
        light_dn = FULL_LIGHT_DN * self.world.bulb * before_v / 5 * really_us / 1000
        self.world.truth[self.taken] = Truth(self.world.turn, before_v, self.module.output_v, really_us, light_dn)
        image = np.full((3, 4), min(light_dn, 255.0), np.uint8)
        self.last = CameraFrame(image, self.taken, f"{self.taken}", really_us, self.world.now_s, self.world.now_s)
        return self.last

    def _fail(self) -> None:
        if self.fault in ("times out", "waits"):
            self.world.wait(CAMERA_DEADLINE_S)
            raise (NoReply if self.fault == "times out" else NoTrigger)("camera", "no frame")
        if self.fault == "gone":
            raise DeviceGone("camera", "unplugged")
        if self.fault == "short":
            raise ReplyWrong("camera", "short frame")


MODULE_FAULTS = ("silent", "gone", "garbled", "another unit", "late", "refuses", "stuck")
CAMERA_FAULTS = ("times out", "waits", "gone", "short", "refuses", "clips", "other exposure", "old frame", "drops")


def station(exposure_us: float, lamp_percent: float) -> Settings:
    target_dn = FULL_LIGHT_DN * lamp_percent / 100 * exposure_us / 1000
    return Settings.model_validate(
        {
            "calibration": Path("calibration.yaml"),
            "camera": {"kind": "replay", "paths": [Path("frames")], "deadline_s": CAMERA_DEADLINE_S},
            "module": {"profile": "ato-4ch", "link": {"kind": "simulated"}, "deadline_s": MODULE_DEADLINE_S},
            "recipe": {"exposure_us": exposure_us, "lamp_percent": lamp_percent},
            "cycle": {"exposure_tolerance": EXPOSURE_TOLERANCE, "retry_first_s": 0.1, "retry_longest_s": 1.0},
            "light": {
                "patch": {"x_px": 0, "y_px": 0, "width_px": 4, "height_px": 3},
                "target_dn": target_dn,
                "tolerance": LIGHT_TOLERANCE,
            },
        }
    )


def always_pass(frame: Frame) -> FrameResult:
    """The worst inspection there is: whatever reaches it is good."""
    return FrameResult(frame.name, Verdict.PASS)


LEVELS = st.tuples(st.sampled_from([500.0, 1000.0]), st.sampled_from([76.0, 80.0, 95.0]))
HAPPENINGS = st.one_of(
    st.tuples(st.just("module_fails"), st.sampled_from((*MODULE_FAULTS, "none", "none", "none"))),
    st.tuples(st.just("camera_fails"), st.sampled_from((*CAMERA_FAULTS, "none", "none", "none"))),
    st.tuples(st.sampled_from(["level_moves", "level_moves_during_the_exposure"]), st.floats(0, 5)),
    st.tuples(st.just("module_fails_during_the_exposure"), st.sampled_from(MODULE_FAULTS)),
    st.tuples(st.just("bulb_changes"), st.sampled_from([1.0, 1.0, 0.97, 0.8, 0.3, 0.0, 1.4])),
    st.tuples(st.just("watchdog_trips"), st.none()),
    st.tuples(st.just("time_passes"), st.floats(0.0, 2 * WATCHDOG_S)),
    st.tuples(st.just("settings_change"), LEVELS),
)
MEND_AFTER_TURNS = 8
LOOKED_AT_WORDS = 16
"""State, fault, verdict and acquisition id stand at the block's beginning."""


class Line(RuleBasedStateMachine):
    """A station on a line where anything may fail at any time, and be mended."""

    def __init__(self) -> None:
        super().__init__()
        self.world = World()
        self.module = Module(self.world)
        self.camera = Camera(self.world, self.module)
        self.settings = station(1000.0, 80.0)
        self.cycle = Cycle(self.settings, Devices(self.camera, self.module), always_pass, clock=self.world.clock)
        self.shown = Snapshot(state=State.INITIALIZED)
        self.mended_turn = 0

    @rule()
    def one_cycle(self) -> None:
        self.world.turn += 1
        wanted, started_s, before = self.cycle.wanted, self.world.now_s, self.shown
        try:
            self.shown = self.cycle.turn(self.shown).snapshot
        except NoTrigger:
            self.shown = self.cycle.keep_ready(self.shown)
            assert self.shown.verdict in (before.verdict, Verdict.NOT_INSPECTED)
            return
        assert self.world.now_s - started_s <= LONGEST_TURN_S
        assert self.shown.sequence == before.sequence + 1
        registers = self._registers()
        if registers["verdict"] == Verdict.PASS:
            truth = self.world.truth[int(registers["acquisition_id"])]
            assert truth.turn == self.world.turn, "an old frame"
            assert abs(truth.before_v - wanted.lamp_v) <= TOLERANCE_V
            assert abs(truth.after_v - wanted.lamp_v) <= TOLERANCE_V
            assert abs(truth.exposure_us - wanted.exposure_us) <= EXPOSURE_TOLERANCE * wanted.exposure_us
            target_dn = self.settings.light.target_dn if self.settings.light else 0.0
            assert abs(truth.light_dn - target_dn) <= LIGHT_TOLERANCE * target_dn + 1
            assert registers["fault_code"] == 0
        else:
            assert registers["verdict"] == Verdict.NOT_INSPECTED
            assert registers["fault_code"] != 0
            settles = registers["fault_code"] == Fault.LAMP_WARMING_UP  # after a change of the lamp's level
            assert registers["state"] == (State.INITIALIZED if settles else State.ERROR)

    @rule()
    def the_line_stands(self) -> None:
        before, started_s = self.shown, self.world.now_s
        self.shown = self.cycle.keep_ready(self.shown)
        assert self.world.now_s - started_s <= LONGEST_TURN_S
        assert self.shown.sequence == before.sequence
        assert self.shown.verdict in (before.verdict, Verdict.NOT_INSPECTED)
        if self.module.fault not in ("none", "stuck"):
            assert self._registers()["fault_code"] != 0
            assert self.shown.verdict is Verdict.NOT_INSPECTED

    @rule(happenings=st.lists(HAPPENINGS, min_size=1, max_size=2), cycles=st.integers(0, 2))
    def something_happens(self, happenings: list[tuple[str, Any]], cycles: int) -> None:
        for name, value in happenings:
            getattr(self, name)(value)
        for _ in range(cycles):
            self.one_cycle()

    def module_fails(self, fault: str) -> None:
        self.module.fault = fault
        if fault == "gone":
            self.module.output_v = 0.0

    def camera_fails(self, fault: str) -> None:
        self.camera.fault = fault
        self.camera.counts_anew = fault == "gone"

    def level_moves(self, volts: float) -> None:
        self.module.output_v = volts

    def level_moves_during_the_exposure(self, volts: float) -> None:
        self.world.next_grab.append(lambda: setattr(self.module, "output_v", volts))

    def module_fails_during_the_exposure(self, fault: str) -> None:
        self.world.next_grab.append(lambda: setattr(self.module, "fault", fault))

    def bulb_changes(self, share: float) -> None:
        self.world.bulb = share

    def watchdog_trips(self, _: None) -> None:
        self.module.tripped, self.module.output_v = True, 0.0

    def time_passes(self, wait_s: float) -> None:
        self.world.wait(wait_s)
        self.module.watch()

    def settings_change(self, level: tuple[float, float]) -> None:
        self.settings = station(*level)
        self.cycle.take_over(self.settings, Devices(self.camera, self.module), always_pass)

    @precondition(lambda self: self.world.turn >= self.mended_turn + MEND_AFTER_TURNS)
    @rule()
    def all_is_mended_and_the_station_resumes_by_itself(self) -> None:
        self.module.fault = self.camera.fault = "none"
        self.world.bulb = 1.0
        self.world.next_grab.clear()
        self.settings_change((1000.0, 80.0))
        for _ in range(4):
            self.world.wait(1.0)
            self.one_cycle()
        assert self.shown.verdict is Verdict.PASS
        assert self.shown.state is State.CONTINUOUS_EXECUTION
        self.mended_turn = self.world.turn

    @invariant()
    def counts_add_up(self) -> None:
        shown = self.shown
        assert shown.panels_passed + shown.panels_failed + shown.panels_not_inspected == shown.sequence

    def _registers(self) -> dict[str, Any]:
        block = encode(self.shown, self.world.now_s, 0)
        return decode(struct.unpack_from(f">{LOOKED_AT_WORDS}H", block))

    def teardown(self) -> None:
        tripped = self.module.tripped
        self.cycle.close()
        assert not self.module.is_open
        if self.module.fault == "none" and not tripped and self.shown.lamp_set_v:
            assert self.module.output_v == 0.0


Line.TestCase.settings = settings(
    max_examples=SEQUENCES, stateful_step_count=20, deadline=None, suppress_health_check=list(HealthCheck)
)
TestLine = pytest.mark.timeout(3600 if SEQUENCES > 1000 else 120)(Line.TestCase)
