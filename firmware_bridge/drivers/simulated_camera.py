"""A camera that draws what its settings would show: for a station without hardware whose light can be tuned."""

from __future__ import annotations

import time
from collections.abc import Callable

from firmware_bridge.contracts import CameraCapabilities, CameraFrame
from firmware_bridge.drivers.pace import Pace
from firmware_bridge.errors import OutOfRange
from firmware_bridge.simulators.ccd_state import Sensor

EXPOSURE_MIN_US, EXPOSURE_MAX_US, EXPOSURE_STEP_US = 1.0, 1e6, 1.0
"""The range of the line camera that it stands for: 1 us to 1 s in steps of 1 us."""


class SimulatedCamera:
    """Implements :class:`firmware_bridge.contracts.Camera` over a scene that ``sensor`` sees.

    ``lit_share`` is the lamp's light at the moment, as a share of its full intensity: dark without the lamp, brighter
    with light and exposure, and full where there is too much of them.
    """

    simulated = True

    def __init__(
        self,
        sensor: Sensor,
        lit_share: Callable[[], float],
        *,
        rate_hz: float = 0.0,
        deadline_s: float = 5.0,
        device: str = "camera",
    ) -> None:
        self._sensor, self._lit_share, self._device = sensor, lit_share, device
        self._pace = Pace(rate_hz, deadline_s, device)
        self._taken = 0
        self._exposure_us = EXPOSURE_MIN_US

    def open(self) -> None:
        """Let frames come."""
        self._pace.start()

    def close(self) -> None:
        """See the contract; a grab that waits in another thread ends at once."""
        self._pace.stop()

    def capabilities(self) -> CameraCapabilities:
        """See the contract."""
        height_px, width_px = self._sensor.shape
        return CameraCapabilities(EXPOSURE_MIN_US, EXPOSURE_MAX_US, EXPOSURE_STEP_US, width_px, height_px)

    def set_exposure_us(self, exposure_us: float) -> float:
        """See the contract; rounded to the step."""
        if not EXPOSURE_MIN_US <= exposure_us <= EXPOSURE_MAX_US:
            what = f"exposure {exposure_us} us is outside {EXPOSURE_MIN_US:g} to {EXPOSURE_MAX_US:g} us"
            raise OutOfRange(self._device, what, "ask for an exposure in that range")
        self._exposure_us = float(round(exposure_us / EXPOSURE_STEP_US) * EXPOSURE_STEP_US)
        return self._exposure_us

    def grab(self) -> CameraFrame:
        """See the contract."""
        self._pace.wait()
        self._taken += 1
        taken_at_s, taken_s = time.time(), time.monotonic()
        image = self._sensor.take(self._exposure_us * self._lit_share())
        name = f"drawn#{self._taken}"
        return CameraFrame(image, self._taken, name, self._exposure_us, taken_at_s, taken_s)
