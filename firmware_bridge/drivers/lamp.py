"""A halogen lamp with a 0-5 V level input (Fostec DCR II), behind an analogue output."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable

from firmware_bridge.contracts import AnalogueModule
from firmware_bridge.drivers.burn_hours import BurnHours
from firmware_bridge.errors import BridgeError, OutOfRange, ReadBackWrong
from firmware_bridge.settings import LampSettings
from firmware_bridge.wire.lamp_curve import CLAMP_V


class FostecLamp:
    """Implements :class:`firmware_bridge.contracts.Lamp`. Never writes above 5.0 V, whatever the module can put out."""

    def __init__(
        self,
        module: AnalogueModule,
        settings: LampSettings,
        device: str = "lamp",
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.simulated = module.simulated
        self._module, self._settings, self._device = module, settings, device
        self._burnt = BurnHours(settings.hours_file, clock)
        self._set_v: float | None = None
        self._stands_v = 0.0

    @property
    def lit_share(self) -> float:
        """The light at the level last read back, as a share of the full intensity; nothing is asked of the module."""
        return self._settings.percent(self._stands_v) / 100

    def open(self) -> None:
        """Open the module. The level stays as it is until it is set."""
        self._module.open()

    def close(self) -> None:
        """See the contract."""
        self._set_v = None
        with contextlib.suppress(BridgeError):
            self._module.write_volts(self._settings.channel, 0.0)
        self._burnt.level(0.0)
        self._stands_v = 0.0
        self._module.close()

    def set_volts(self, volts: float) -> float:
        """See the contract. Raises WatchdogTripped if that is why the level read back is another."""
        if not 0.0 <= volts <= CLAMP_V:
            raise OutOfRange(self._device, f"{volts} V is outside 0 to {CLAMP_V} V", "ask for a level in that range")
        self._set_v = None
        self._module.write_volts(self._settings.channel, volts)
        read_back_v = self._read_near(volts)
        self._set_v = volts
        return read_back_v

    def set_percent(self, percent: float) -> float:
        """Set the intensity by the lamp's curve; the level as read back, volts. Raises as :meth:`set_volts`."""
        if not 0.0 <= percent <= 100.0:
            raise OutOfRange(self._device, f"{percent} % is outside 0 to 100 %", "ask for an intensity in that range")
        return self.set_volts(self._settings.volts(percent))

    def read_volts(self) -> float:
        """See the contract."""
        read_back_v = self._module.read_volts(self._settings.channel)
        self._burnt.level(read_back_v)
        self._stands_v = read_back_v
        return read_back_v

    def keep_alive(self) -> None:
        """See the contract."""
        if self._set_v is None:
            self.read_volts()
        else:
            self._read_near(self._set_v)

    def burnt_hours(self) -> float:
        """See the contract."""
        return self._burnt.hours

    def _read_near(self, volts: float) -> float:
        read_back_v = self.read_volts()
        if not abs(read_back_v - volts) <= self._settings.tolerance_v:
            self._module.check_trip()
            what = f"set to {volts:.3f} V, reads back {read_back_v:.3f} V (tolerance {self._settings.tolerance_v:g} V)"
            raise ReadBackWrong(self._device, what, "check the module's range, profile and channel")
        return read_back_v
