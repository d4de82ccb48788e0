"""An I/O module seen from the wire: its profile's points and what they do. Knows no port; time comes from outside."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence

from firmware_bridge.wire.modbus import IllegalAddress, IllegalValue, Table
from firmware_bridge.wire.module_setup import clear_points, trip_points
from firmware_bridge.wire.profiles import Point, Profile, Watchdog


class SimulatedModule:
    """A :class:`firmware_bridge.wire.modbus.DataModel` of one profile.

    Levels outside the span are refused (exception 3). After its watchdog trips it stands at its safe values and
    takes writes to its outputs without doing anything, until the trip is cleared. ``stuck``: outputs do so always,
    as with a dead converter. ``ascii``: it speaks its maker's own protocol and answers no Modbus. ``clock`` gives
    seconds. All of it may be called from any thread.
    """

    def __init__(self, profile: Profile, clock: Callable[[], float]) -> None:
        self.profile, self._clock = profile, clock
        self.stuck = self.ascii = False
        self._lock = threading.RLock()
        self._asked_s = clock()
        self._outputs = {profile.output_of(channel): channel for channel in range(profile.channels)}
        self._digital_outputs = frozenset(profile.digital_outputs.points if profile.digital_outputs else ())
        every = range(profile.channels)
        self._trips = trip_points(profile, every)
        self._clears = dict(zip(clear_points(profile, every), self._trips, strict=False))
        self._values: dict[Point, int] = dict.fromkeys(self._clears, 0)
        self._writable: set[Point] = set(self._clears)
        self._lay_out()

    def output_v(self, channel: int) -> float:
        """What stands on the terminal, volts."""
        with self._lock:
            self._watch(asked=False)
            return self.profile.span.volts(self._values[self.profile.output_of(channel)])

    def trip(self) -> None:
        """Do what the watchdog does when the host has gone: safe levels, and digital outputs off."""
        with self._lock:
            for point in self._trips:
                self._values[point] = 1
            self._all_at(self.profile.safe_value)

    def power_cycle(self) -> None:
        """Power off and on: power-on levels, or safe ones if a trip survives it; what is set up stays set up."""
        with self._lock:
            self._asked_s = self._clock()
            if self.profile.watchdog and self.profile.watchdog.survives_power and self._tripped():
                self._all_at(self.profile.safe_value)
                return
            self._values.update(dict.fromkeys(self._trips, 0))
            self._all_at(self.profile.power_on_value)

    def set_value(self, point: Point, value: int) -> None:
        """Change a point from inside: a digital input, or what a technician left another way."""
        with self._lock:
            self._values[point] = value

    def read_registers(self, table: Table, address: int, count: int) -> bytes:
        """See the data model."""
        return b"".join(value.to_bytes(2, "big") for value in self._read(table, address, count))

    def read_bits(self, table: Table, address: int, count: int) -> Sequence[bool]:
        """See the data model."""
        return [bool(value) for value in self._read(table, address, count)]

    def write_registers(self, address: int, data: bytes) -> None:
        """See the data model."""
        values = [int.from_bytes(data[at : at + 2], "big") for at in range(0, len(data), 2)]
        self._write(Point(Table.HOLDING_REGISTERS, address), values)

    def write_bits(self, address: int, bits: Sequence[bool]) -> None:
        """See the data model."""
        self._write(Point(Table.COILS, address), [int(bit) for bit in bits])

    def _read(self, table: Table, address: int, count: int) -> list[int]:
        with self._lock:
            self._watch(asked=True)
            try:
                return [self._values[Point(table, address + offset)] for offset in range(count)]
            except KeyError:
                raise IllegalAddress from None

    def _write(self, first: Point, values: Sequence[int]) -> None:
        with self._lock:
            self._watch(asked=True)
            written = {first.plus(offset): value for offset, value in enumerate(values)}
            for point, value in written.items():
                self._check(point, value)
            for point, value in written.items():
                self._take(point, value)

    def _check(self, point: Point, value: int) -> None:
        if point not in self._writable:
            raise IllegalAddress
        span = self.profile.span
        if point in self._outputs and not span.counts_low <= value <= span.counts_high:
            raise IllegalValue

    def _take(self, point: Point, value: int) -> None:
        if point in self._clears:
            if self.profile.watchdog and value == self.profile.watchdog.clear_value:
                self._values[self._clears[point]] = 0
        elif point in self._outputs or point in self._digital_outputs:
            self._take_output(point, value)
        else:
            self._values[point] = value

    def _take_output(self, point: Point, value: int) -> None:
        watchdog = self.profile.watchdog
        if watchdog and watchdog.write_clears and self._values[watchdog.write_clears]:
            self._values.update(dict.fromkeys(self._trips, 0))
        if self.stuck or self._tripped():
            return
        if point in self._outputs:
            self._stand_at(self._outputs[point], value)
        else:
            self._values[point] = value

    def _tripped(self) -> bool:
        return any(self._values[point] for point in self._trips)

    def _all_at(self, first: Point | None) -> None:
        """Every output at its level kept from ``first`` on, or at 0 V; digital ones off."""
        for channel in range(self.profile.channels):
            kept = self._values[first.plus(channel)] if first else self.profile.span.counts(0.0)
            self._stand_at(channel, kept)
        self._values.update(dict.fromkeys(self._digital_outputs, 0))

    def _stand_at(self, channel: int, counts: int) -> None:
        self._values[self.profile.output_of(channel)] = counts
        first = self.profile.read_back_of(channel)
        for offset, word in enumerate(self.profile.encode_read_back(counts)):
            self._values[first.plus(offset)] = word

    def _watch(self, *, asked: bool) -> None:
        """Trip if the host was silent for too long; ``asked``: a request has come, which the watchdog waits for."""
        now_s, watchdog = self._clock(), self.profile.watchdog
        if watchdog and self._timeout_s(watchdog) < now_s - self._asked_s:
            self.trip()
        if asked:
            self._asked_s = now_s

    def _timeout_s(self, watchdog: Watchdog) -> float:
        if watchdog.enable is None or watchdog.timeout is None or not self._values[watchdog.enable]:
            return float("inf")
        return self._values[watchdog.timeout] * watchdog.timeout_s_per_count or float("inf")

    def _lay_out(self) -> None:
        """Every point of the profile, as the module leaves its maker; outputs and safe levels at 0 V."""
        profile, zero = self.profile, self.profile.span.counts(0.0)
        for channel in range(profile.channels):
            self._stand_at(channel, zero)
            for setup in profile.setup:
                self._add(setup.point.plus(channel) if setup.per_channel else setup.point, setup.value, setup.writable)
            for level in (profile.safe_value, profile.power_on_value):
                self._add(level and level.plus(channel), zero, True)
        for tripped in self._trips:
            self._values.setdefault(tripped, 0)
        if watchdog := profile.watchdog:
            for point in (watchdog.enable, watchdog.write_clears, watchdog.timeout):
                self._add(point, 0, True)
        for bank, writable in ((profile.digital_inputs, False), (profile.digital_outputs, True)):
            for point in bank.points if bank else ():
                self._add(point, 0, writable)
        self._writable.update(self._outputs)

    def _add(self, point: Point | None, value: int, writable: bool) -> None:
        if point is not None:
            self._values[point] = value
            if writable:
                self._writable.add(point)
