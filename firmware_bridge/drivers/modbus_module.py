"""An analogue output module, from its row of the profile table. Raw counts stay in here."""

from __future__ import annotations

from collections.abc import Sequence

from firmware_bridge.errors import BridgeError, OutOfRange, ReadBackWrong, Refused, WatchdogTripped
from firmware_bridge.links.modbus_master import ModbusMaster
from firmware_bridge.wire.profiles import Point, Profile, Setup, Watchdog


class ModbusModule:
    """Implements :class:`firmware_bridge.contracts.AnalogueModule` for ``channels`` of a profile, over a master.

    Opening checks that the module is set up as the profile says (and sets it so where the profile allows), clears
    a tripped watchdog, and sets safe level and watchdog if they are given.
    """

    def __init__(
        self,
        profile: Profile,
        master: ModbusMaster,
        channels: Sequence[int] | None = None,
        *,
        safe_v: float | None = None,
        watchdog_s: float | None = None,
        simulated: bool = False,
        device: str = "module",
    ) -> None:
        self.simulated = simulated
        self._profile, self._master, self._device = profile, master, device
        self._channels = tuple(range(profile.channels) if channels is None else channels)
        self._safe_v, self._watchdog_s = safe_v, watchdog_s

    def open(self) -> None:
        """Open the link and set the module up. Raises DeviceGone, NoReply, ReplyWrong, Refused, ReadBackWrong."""
        self._master.open()
        try:
            for setup in self._profile.setup:
                self._apply(setup)
            self._clear_trip()
            self._set_safety()
        except BridgeError:
            self._master.close()
            raise

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
        """See the contract."""
        point = self._profile.read_back_of(self._checked(channel))
        registers = self._master.read(point.table, point.address, self._profile.read_back_holds.words)
        return self._profile.decode_read_back(registers)

    def check_trip(self) -> None:
        """Raise WatchdogTripped if the module ignores writes until its trip is cleared, which opening does."""
        for point in self._trip_points():
            if self._read(point):
                self._tripped(point)

    def _checked(self, channel: int) -> int:
        if channel not in self._channels:
            listed = ", ".join(map(str, self._channels))
            raise OutOfRange(self._device, f"channel {channel} is not in use", f"channels in use: {listed}")
        return channel

    def _read(self, point: Point) -> int:
        return self._master.read(point.table, point.address)[0]

    def _write(self, point: Point, value: int) -> None:
        self._master.write(point.table, point.address, value)

    def _hold(self, point: Point, value: int, meaning: str) -> None:
        """Make a point hold a value, writing only if it does not: these live in memory that wears out."""
        if self._read(point) == value:
            return
        self._write(point, value)
        if (read_back := self._read(point)) != value:
            what = f"{meaning}: wrote {value} to {point.manual}, reads back {read_back}"
            raise ReadBackWrong(self._device, what, "check profile and firmware")

    def _apply(self, setup: Setup) -> None:
        for point in self._per_channel(setup.point, setup.per_channel):
            if setup.writable:
                self._hold(point, setup.value, setup.meaning)
            elif (found := self._read(point)) != setup.value:
                what = f"{point.manual} reads {found:#x}, not {setup.value:#x} ({setup.meaning})"
                raise Refused(self._device, what, "set the module's range with its maker's tool, or use its profile")

    def _per_channel(self, first: Point, per_channel: bool) -> list[Point]:
        return [first.plus(channel) for channel in self._channels] if per_channel else [first]

    def _trip_points(self) -> list[Point]:
        watchdog = self._profile.watchdog
        return self._per_channel(watchdog.tripped, watchdog.per_channel) if watchdog else []

    def _clear_trip(self) -> None:
        watchdog = self._profile.watchdog
        for index, point in enumerate(self._trip_points()):
            if not self._read(point):
                continue
            if watchdog is None or watchdog.clear is None:
                self._tripped(point)
            else:
                self._write(self._per_channel(watchdog.clear, watchdog.per_channel)[index], watchdog.clear_value)
                if self._read(point):
                    self._tripped(point)

    def _tripped(self, point: Point) -> None:
        what = f"watchdog tripped ({point.manual} is set): the module is at its safe value and ignores writes"
        remedy = "reopening clears it" if self._can_clear() else "clear it with the maker's tool"
        raise WatchdogTripped(self._device, what, remedy)

    def _can_clear(self) -> bool:
        return self._profile.watchdog is not None and self._profile.watchdog.clear is not None

    def _set_safety(self) -> None:
        if self._safe_v is not None and self._profile.safe_value:
            for point in self._per_channel(self._profile.safe_value, True):
                self._hold(point, self._profile.span.counts(self._safe_v), "safe value")
        if self._watchdog_s is not None and self._profile.watchdog:
            self._set_watchdog(self._profile.watchdog, self._watchdog_s)

    def _set_watchdog(self, watchdog: Watchdog, watchdog_s: float) -> None:
        """Time first, then what feeds it, then on: enabled earlier it could trip on its old time."""
        if watchdog.timeout:
            counts = max(1, round(watchdog_s / watchdog.timeout_s_per_count))
            self._hold(watchdog.timeout, counts, "watchdog time")
        if watchdog.any_request_feeds:
            self._hold(watchdog.any_request_feeds, 1, "what feeds the watchdog")
        if watchdog.enable:
            self._hold(watchdog.enable, 1, "watchdog on")
