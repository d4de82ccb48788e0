"""A serial line in memory with a clock of its own: a module simulator at one end, a driver's port at the other.

No call takes real time. What goes wrong is set on the line: ``fault`` for answers, ``gone`` for the adapter,
``babbling`` for a line that never stops.
"""

from __future__ import annotations

import random

from firmware_bridge.errors import DeviceGone
from firmware_bridge.simulators.module_server import WireFault, spoil
from firmware_bridge.simulators.module_state import SimulatedModule
from firmware_bridge.wire.modbus import Slave
from firmware_bridge.wire.modbus_frames import RtuSession
from firmware_bridge.wire.profiles import Profile

ANSWER_S = 0.01
"""How long the module thinks."""


class Clock:
    """Seconds that pass when they are waited for."""

    def __init__(self) -> None:
        self.now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


class MemoryLine:
    """The line and the module at its end. ``open_port`` is what a master opens."""

    def __init__(self, profile: Profile, unit: int, clock: Clock, seed: int = 0) -> None:
        self.module = SimulatedModule(profile, clock)
        self.clock = clock
        self.fault, self.late_s = WireFault.NONE, 0.0
        self.gone = self.babbling = False
        self.requests: list[bytes] = []
        self._session = RtuSession(Slave({unit: self.module}))
        self._random = random.Random(seed)
        self._coming: list[tuple[float, bytes]] = []

    def open_port(self) -> MemoryPort:
        if self.gone:
            raise DeviceGone("module", "cannot open memory: No such file or directory", "check the adapter's cable")
        return MemoryPort(self)

    def hear(self, request: bytes) -> None:
        """A request arrives; its answer, as the fault leaves it, is on its way."""
        self.requests.append(request)
        if self.module.ascii:
            return
        self._session.silence()
        answer = self._session.receive(request)
        delay_s = self.late_s if self.fault is WireFault.LATE else ANSWER_S
        if answer and (spoiled := self._spoiled(answer)):
            self._coming.append((self.clock() + delay_s, spoiled))

    def say(self, timeout_s: float) -> bytes:
        """What comes within the time, which passes meanwhile."""
        self.check()
        until_s = self.clock.now_s + max(timeout_s, 0.0)
        if self.babbling:
            return self._random.randbytes(64)
        self._coming.sort()
        if self._coming and self._coming[0][0] <= until_s:
            due_s, data = self._coming.pop(0)
            self.clock.now_s = max(due_s, self.clock.now_s)
            return data
        self.clock.now_s = until_s
        return b""

    def drop(self) -> None:
        """Throw away what has arrived; what is on its way still comes."""
        self._coming = [(due_s, data) for due_s, data in self._coming if due_s > self.clock.now_s]

    def check(self) -> None:
        if self.gone:
            raise DeviceGone("module", "memory: Input/output error", "check its cable and power")

    def _spoiled(self, answer: bytes) -> bytes:
        if self.fault is WireFault.GARBAGE:
            return self._random.randbytes(len(answer))
        return spoil(self.fault, answer, 0)


class MemoryPort:
    """What :class:`firmware_bridge.links.ports.Port` is to a real line."""

    name = "memory"

    def __init__(self, line: MemoryLine) -> None:
        self._line = line

    def read(self, timeout_s: float) -> bytes:
        return self._line.say(timeout_s)

    def write(self, data: bytes, timeout_s: float) -> None:
        self._line.check()
        self._line.hear(data)

    def settle(self) -> None:
        self._line.check()
        self._line.drop()

    def discard(self, for_s: float) -> None:
        self._line.check()
        self._line.clock.now_s += max(for_s, 0.0)
        self._line.drop()

    def close(self) -> None:
        self._line.drop()
