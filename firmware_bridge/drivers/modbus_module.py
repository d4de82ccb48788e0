"""An I/O module, from its row of the profile table. Raw counts stay in here."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from firmware_bridge.errors import BridgeError, NoReply, OutOfRange, ReadBackWrong, Refused, ReplyWrong, WatchdogTripped
from firmware_bridge.links.modbus_master import ModbusMaster
from firmware_bridge.wire.module_setup import AS_SET_UP, Held, Safety, clear_points, held, trip_points
from firmware_bridge.wire.profiles import Bank, Point, Profile


@dataclass(frozen=True, slots=True)
class Found:
    """What a module holds at a point, and what it should."""

    held: Held
    value: int

    @property
    def right(self) -> bool:
        """Whether it is what the station needs."""
        return self.held.value in (None, self.value)


class ModbusModule:
    """Implements :class:`firmware_bridge.contracts.AnalogueModule` and :class:`firmware_bridge.contracts.DigitalIO`.

    ``channels`` are the analogue outputs in use (None: all of the profile's). Opening clears a tripped watchdog,
    checks that the module is set up as the profile says (and sets it so where the profile allows), and sets what
    ``safety`` asks for; everything written is read back.
    """

    def __init__(
        self,
        profile: Profile,
        master: ModbusMaster,
        channels: Sequence[int] | None = None,
        *,
        safety: Safety = AS_SET_UP,
        simulated: bool = False,
        device: str = "module",
    ) -> None:
        self.simulated = simulated
        self._profile, self._master, self._device = profile, master, device
        self._channels = tuple(range(profile.channels) if channels is None else channels)
        self._safety = safety

    def open(self) -> None:
        """Connect and set the module up. Raises DeviceGone, NoReply, ReplyWrong, Refused, ReadBackWrong."""
        self.connect()
        try:
            self._first_words()
            for wanted in self._held():
                self._hold(wanted)
        except BridgeError:
            self.close()
            raise

    def connect(self) -> None:
        """Open the link alone: nothing is asked of the module, and nothing written to it. Raises DeviceGone."""
        self._master.open()

    def close(self) -> None:
        """Close the link; outputs stay as they are. May be called twice, never raises."""
        self._master.close()

    def write_volts(self, channel: int, volts: float) -> None:
        """See the contract. The level is rounded down to the module's step."""
        span = self._profile.span
        if not span.low_v <= volts <= span.high_v:
            what = f"{volts} V is outside {span.low_v:g} to {span.high_v:g} V of {self._profile.model}"
            raise OutOfRange(self._device, what, "ask for a level in that range")
        self._write(self._profile.output_of(self._checked(channel)), span.counts(volts))

    def read_volts(self, channel: int) -> float:
        """See the contract. Raises ReplyWrong for what is no number."""
        point = self._profile.read_back_of(self._checked(channel))
        registers = self._master.read(point.table, point.address, self._profile.read_back_holds.words)
        volts = self._profile.decode_read_back(registers)
        if not math.isfinite(volts):
            raise ReplyWrong(self._device, f"{point.manual} reads {volts} V", "check the module's scaling and profile")
        return volts

    def read_inputs(self) -> tuple[bool, ...]:
        """See the contract."""
        return self._read_bank(self._profile.digital_inputs)

    def read_outputs(self) -> tuple[bool, ...]:
        """See the contract."""
        return self._read_bank(self._profile.digital_outputs)

    def write_output(self, channel: int, on: bool) -> None:
        """See the contract."""
        bank = self._profile.digital_outputs
        if bank is None or not 0 <= channel < bank.count:
            there = f"0 to {bank.count - 1}" if bank else "none"
            raise OutOfRange(self._device, f"no digital output {channel}", f"{self._profile.model} has {there}")
        point = bank.points[channel]
        self._write(point, int(on))
        if bool(self._read(point)) is not on:
            self.check_trip()
            what = f"digital output {channel} set {'on' if on else 'off'}, reads back {'off' if on else 'on'}"
            raise ReadBackWrong(self._device, what, "check the module and its profile")

    def check_trip(self) -> None:
        """See the contract: raise WatchdogTripped if the module ignores writes until its trip is cleared."""
        for point in trip_points(self._profile, self._channels):
            if self._read(point):
                self._tripped(point)

    def clear_trip(self) -> None:
        """Clear a trip, if there is one. Raises WatchdogTripped if this module's cannot be cleared from here."""
        tripped, clear = trip_points(self._profile, self._channels), clear_points(self._profile, self._channels)
        for index, point in enumerate(tripped):
            if not self._read(point):
                continue
            if clear and self._profile.watchdog:
                self._write(clear[index], self._profile.watchdog.clear_value)
            if not clear or self._read(point):
                self._tripped(point)

    def found(self) -> list[Found]:
        """What the module holds where opening would set it; writes nothing."""
        return [Found(wanted, self._read(wanted.point)) for wanted in self._held()]

    def _held(self) -> list[Held]:
        return held(self._profile, self._channels, self._safety)

    def _first_words(self) -> None:
        """The first requests since the module was last known to be there. What may be wrong with it is said here."""
        try:
            self.clear_trip()
        except NoReply as error:
            hints = "; ".join(filter(None, (error.remedy, self._profile.if_silent)))
            raise NoReply(error.device, error.message, hints) from error

    def _hold(self, wanted: Held) -> None:
        """Make a point hold its value, writing only if it does not: these live in memory that wears out."""
        if wanted.value is None or (found := self._read(wanted.point)) == wanted.value:
            return
        where = wanted.point.manual
        if not wanted.writable:
            what = f"{where} reads {found:#x}, not {wanted.value:#x} ({wanted.meaning})"
            raise Refused(self._device, what, "set the module's range with its maker's tool, or use its profile")
        self._write(wanted.point, wanted.value)
        if (read_back := self._read(wanted.point)) != wanted.value:
            what = f"{wanted.meaning}: wrote {wanted.value} to {where}, reads back {read_back}"
            raise ReadBackWrong(self._device, what, "check profile and firmware")

    def _checked(self, channel: int) -> int:
        if channel not in self._channels:
            listed = ", ".join(map(str, self._channels))
            raise OutOfRange(self._device, f"channel {channel} is not in use", f"channels in use: {listed}")
        return channel

    def _read(self, point: Point) -> int:
        return self._master.read(point.table, point.address)[0]

    def _read_bank(self, bank: Bank | None) -> tuple[bool, ...]:
        if bank is None:
            return ()
        return tuple(map(bool, self._master.read(bank.first.table, bank.first.address, bank.count)))

    def _write(self, point: Point, value: int) -> None:
        self._master.write(point.table, point.address, value)

    def _tripped(self, point: Point) -> None:
        what = f"watchdog tripped ({point.manual} is set): the module is at its safe value and ignores writes"
        clearable = clear_points(self._profile, self._channels)
        raise WatchdogTripped(
            self._device, what, "reopening clears it" if clearable else "clear it with the maker's tool"
        )
