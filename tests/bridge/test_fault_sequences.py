"""Random sequences of faults on a lamp and its module, in memory and on a clock that runs when it is waited for.

Whatever happens: a level that is reported as set was read back in tolerance and stands on the terminal, every request
ends within its deadline, and when the faults are over the lamp works again by itself.

FAULT_SEQUENCES sets how many sequences are tried (ten thousand take minutes).
"""

from __future__ import annotations

import os
from typing import Any

import pytest
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule
from memory_line import Clock, MemoryLine

from firmware_bridge.drivers.lamp import FostecLamp
from firmware_bridge.drivers.modbus_module import ModbusModule
from firmware_bridge.errors import BridgeError
from firmware_bridge.links.modbus_master import ModbusMaster
from firmware_bridge.settings import LampSettings
from firmware_bridge.simulators.module_server import WireFault
from firmware_bridge.wire.module_setup import Safety
from firmware_bridge.wire.profiles import PROFILES
from inspector.acquire.keeper import Keeper, Retry

SEQUENCES = int(os.environ.get("FAULT_SEQUENCES", "100"))
UNIT, CHANNEL, DEADLINE_S, WATCHDOG_S = 3, 0, 0.5, 4.0
LAMP = LampSettings()
LONGEST_RETRY_S = 2.0
SERIAL = [name for name, profile in PROFILES.items() if profile.has_serial]


class TimedMaster(ModbusMaster):
    """A master whose every request is held to the deadline, with the time that its clock says."""

    def read(self, *arguments: Any) -> list[int]:
        return self._held_to_deadline(super().read, *arguments)

    def write(self, *arguments: Any) -> None:
        self._held_to_deadline(super().write, *arguments)

    def _held_to_deadline(self, request: Any, *arguments: Any) -> Any:
        started_s = self._clock()
        try:
            return request(*arguments)
        finally:
            assert self._clock() - started_s <= DEADLINE_S + 1e-9


class LampUnderFaults(RuleBasedStateMachine):
    """The lamp as the service keeps it, on a line where everything happens."""

    @initialize(name=st.sampled_from(SERIAL), seed=st.integers(0, 2**32))
    def station(self, name: str, seed: int) -> None:
        self.profile = PROFILES[name]
        self.clock = Clock()
        self.line = MemoryLine(self.profile, UNIT, self.clock, seed)
        has = self.profile.watchdog is not None and self.profile.watchdog.timeout is not None
        safety = Safety(safe_v=1.0, power_on_v=0.5, watchdog_s=WATCHDOG_S) if has else Safety()
        master = TimedMaster("module", UNIT, self.line.open_port, rtu=True, deadline_s=DEADLINE_S, clock=self.clock)
        self.lamp = FostecLamp(ModbusModule(self.profile, master, [CHANNEL], safety=safety), LAMP, clock=self.clock)
        self.keeper = Keeper("lamp", self.lamp, Retry(0.1, LONGEST_RETRY_S), clock=self.clock)
        self.hours = 0.0
        self.complaint: BridgeError | None = None

    def _set(self, volts: float) -> None:
        """Raises BridgeError; else the level stands."""
        read_back_v = self.keeper.use(lambda lamp: lamp.set_volts(volts))
        assert abs(read_back_v - volts) <= LAMP.tolerance_v
        assert abs(self.line.module.output_v(CHANNEL) - volts) <= LAMP.tolerance_v + self.profile.span.step_v
        self.wanted_v = volts

    @rule(volts=st.floats(0, 5))
    def set_level(self, volts: float) -> None:
        try:
            self._set(volts)
        except BridgeError as error:
            self.complaint = error
            assert not self.keeper.works

    @rule()
    def stand_still(self) -> None:
        """The line stands: only the idle wait speaks to the module."""
        if self.keeper.works:
            try:
                self.keeper.use(lambda lamp: lamp.keep_alive())
            except BridgeError:
                assert not self.keeper.works
            else:
                assert abs(self.line.module.output_v(CHANNEL) - self.wanted_v) <= LAMP.tolerance_v + 0.01

    @rule(fault=st.sampled_from(WireFault), late_s=st.floats(DEADLINE_S + 0.01, 2 * DEADLINE_S - 0.01))
    def answers_go_wrong(self, fault: WireFault, late_s: float) -> None:
        self.line.fault, self.line.late_s = fault, late_s

    @rule(babbling=st.booleans())
    def line_babbles(self, babbling: bool) -> None:
        self.line.babbling = babbling

    @rule(gone=st.booleans())
    def adapter_is_pulled(self, gone: bool) -> None:
        self.line.gone = gone

    @rule(stuck=st.booleans())
    def output_sticks(self, stuck: bool) -> None:
        self.line.module.stuck = stuck

    @rule(spoken=st.booleans())
    def module_speaks_ascii(self, spoken: bool) -> None:
        self.line.module.ascii = spoken

    @rule()
    def watchdog_trips(self) -> None:
        if self.profile.watchdog:
            self.line.module.trip()

    @rule()
    def power_fails(self) -> None:
        self.line.module.power_cycle()

    @rule(pause_s=st.floats(0, 3 * WATCHDOG_S))
    def time_passes(self, pause_s: float) -> None:
        self.clock.now_s += pause_s

    @rule()
    def service_restarts(self) -> None:
        self.keeper.close()

    @rule(volts=st.floats(0, 5))
    def faults_end(self, volts: float) -> None:
        """Everything is right again; only what needs the maker's tool is done by hand."""
        line, profile = self.line, self.profile
        line.fault, line.gone, line.babbling, line.module.stuck, line.module.ascii = WireFault.NONE, *[False] * 4
        if profile.watchdog and profile.watchdog.clear is None:
            line.module.set_value(profile.watchdog.tripped, 0)
        ends_s = self.clock() + 4 * LONGEST_RETRY_S
        while True:
            self.clock.now_s = max(self.clock.now_s, self.keeper.due_s)
            try:
                self._set(volts)
                return
            except BridgeError:
                assert self.clock() < ends_s, "the lamp did not recover"

    @invariant()
    def complaints_name_the_device_and_the_remedy(self) -> None:
        assert self.complaint is None or (self.complaint.device in ("lamp", "module") and self.complaint.remedy)

    @invariant()
    def nothing_above_the_clamp(self) -> None:
        assert self.line.module.output_v(CHANNEL) <= 5.0

    @invariant()
    def hours_count_up_and_never_faster_than_time(self) -> None:
        assert self.hours <= self.lamp.burnt_hours() <= self.clock() / 3600
        self.hours = self.lamp.burnt_hours()

    def teardown(self) -> None:
        if not hasattr(self, "keeper"):
            return
        self.faults_end(3.0)
        self.keeper.close()
        assert self.line.module.output_v(CHANNEL) == pytest.approx(0.0, abs=0.005)


LampUnderFaults.TestCase.settings = settings(
    max_examples=SEQUENCES,
    stateful_step_count=20,
    deadline=None,
    suppress_health_check=list(HealthCheck),
    phases=(Phase.explicit, Phase.reuse, Phase.generate),  # twenty steps can be read; shrinking them takes minutes
)
TestLampUnderFaults = pytest.mark.timeout(3600 if SEQUENCES > 1000 else 120)(LampUnderFaults.TestCase)
