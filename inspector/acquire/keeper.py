"""Keeps one device usable: opens it, closes it when it fails, and tries again with back-off, for that device alone."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

from firmware_bridge.errors import BridgeError, NoTrigger
from inspector.acquire.device_faults import fault_of
from inspector.outage import Outage


class Device(Protocol):
    """What every contract has."""

    simulated: bool

    def open(self) -> None: ...
    def close(self) -> None: ...


@dataclass(frozen=True, slots=True)
class Retry:
    """After a failure a device is left alone for ``first_s``, doubled with each further failure up to ``longest_s``."""

    first_s: float
    longest_s: float


Waiting = Callable[[], AbstractContextManager[object]]
"""Makes what is entered around a wait that a stop need not sit out."""

DeviceT = TypeVar("DeviceT", bound=Device)
ResultT = TypeVar("ResultT")


class Keeper(Generic[DeviceT]):
    """One device, closed after a failure and opened again as ``retry`` says.

    An outage ends when the device has done something again, not when its port could be opened. ``waiting`` is
    entered around opening, which may take long.
    """

    def __init__(
        self,
        name: str,
        device: DeviceT,
        retry: Retry,
        *,
        waiting: Waiting = nullcontext,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.device, self.retry, self._waiting, self._clock = device, retry, waiting, clock
        self._outage = Outage(name, clock)
        self._open = self._broken = False
        self._error: BridgeError | None = None
        self._delay_s = retry.first_s
        self._due_s = clock()
        self._works_since_s: float | None = None

    @property
    def works(self) -> bool:
        """Whether the last thing asked of the device was done."""
        return self._works_since_s is not None

    @property
    def worked_s(self) -> float:
        """For how long the device has worked without a failure, seconds."""
        return 0.0 if self._works_since_s is None else self._clock() - self._works_since_s

    @property
    def due_s(self) -> float:
        """When the device may be tried again, on the clock."""
        return self._due_s

    def use(self, work: Callable[[DeviceT], ResultT]) -> ResultT:
        """Do ``work`` with the open device. Raises BridgeError; until the next try is due, the last one again.

        A camera that only waits for its trigger (NoTrigger) has not failed.
        """
        self.ready()
        if self._error is not None:
            raise self._error.with_traceback(None)
        try:
            result = work(self.device)
        except NoTrigger:
            self._worked()
            raise
        except BridgeError as error:
            self._failed(error)
            raise
        self._worked()
        return result

    def ready(self) -> None:
        """Open the device if it is closed and a try is due; a failure shows in :meth:`use`.

        A device that failed is closed here and not at once: closing may wait for it, and the PLC is told first.
        """
        if self._broken:
            self.device.close()
            self._broken = False
        if self._open or self._clock() < self._due_s:
            return
        try:
            with self._waiting():
                self.device.open()
        except BridgeError as error:
            self._failed(error)
        else:
            self._open, self._error = True, None

    def close(self) -> None:
        """Close the device for good, or until the next use."""
        self._open, self._broken, self._works_since_s = False, False, None
        self.device.close()

    def try_again(self) -> None:
        """Open a device that has failed, at once: the last chance before it is closed. Whether it could is no news."""
        if self._error is not None:
            self.device.close()
            with suppress(BridgeError):
                self.device.open()

    def hurry(self) -> None:
        """A device that has failed may be tried at once; further tries come as after a first failure."""
        if self._error is not None:
            self._delay_s, self._due_s = self.retry.first_s, self._clock()

    def replace(self, device: DeviceT) -> None:
        """Close the device and take another one in its place, to be opened at the next use."""
        self.close()
        self.device, self._error = device, None
        self._delay_s, self._due_s = self.retry.first_s, self._clock()

    def _failed(self, error: BridgeError) -> None:
        self._error = error
        self._outage.begins(error, device=error.device, fault_code=fault_of(error))
        self._open, self._broken, self._works_since_s = False, True, None
        self._due_s = self._clock() + self._delay_s
        self._delay_s = min(2 * self._delay_s, self.retry.longest_s)

    def _worked(self) -> None:
        self._delay_s = self.retry.first_s
        if self._works_since_s is None:
            self._works_since_s = self._clock()
            self._outage.ends()
