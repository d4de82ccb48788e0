"""pymodbus, fenced in: its PDUs and framers over our ports, with a deadline that holds.

pymodbus' own synchronous clients count their time-out anew with each piece received and sleep between looks, so a
babbling line stretches a request. Here one request has one deadline, over sending, every piece and all waiting.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable

from pymodbus.client.base import ModbusBaseSyncClient
from pymodbus.framer import FramerType
from pymodbus.transport import CommParams, CommType

from firmware_bridge.errors import ReplyWrong
from firmware_bridge.links.ports import Port
from firmware_bridge.wire.modbus_frames import rtu_answer

MAX_REPLY_BYTES = 1024
"""Four of the longest frames: a line that sends more for one request is babbling, and is left at once."""

# It reports each failed request on several lines; the service says an outage once, in its own words.
logging.getLogger("pymodbus.logging").setLevel(logging.CRITICAL)


class DeadlineClient(ModbusBaseSyncClient):
    """pymodbus' requests over an open port. ``received`` counts the bytes that came since the last request."""

    def __init__(
        self, device: str, port: Port, *, rtu: bool, deadline_s: float, clock: Callable[[], float] = time.monotonic
    ) -> None:
        # For pymodbus every port is a serial one: it would otherwise try to take down a transport that it has not.
        params = CommParams(comm_type=CommType.SERIAL, host=port.name, timeout_connect=deadline_s)
        framer = FramerType.RTU if rtu else FramerType.SOCKET
        super().__init__(framer, 0, params, self._whole_answer if rtu else None, None, None)
        self._device, self._port, self._deadline_s, self._clock = device, port, deadline_s, clock
        self._until_s = 0.0
        self._unit = self._function = 0
        self.received = 0

    def connect(self) -> bool:
        """Nothing to do: the port is open, or the first use of it says why not."""
        return True

    def send(self, request: bytes, addr: tuple[str, int] | None = None) -> int:
        """Start a request: what came unasked is thrown away, since it answers nothing."""
        self._until_s = self._clock() + self._deadline_s
        self.received = 0
        self._port.settle()
        self._port.write(request, self._deadline_s)
        return len(request)

    def recv(self, size: int | None) -> bytes:
        """What comes before the deadline; empty after it, which pymodbus takes for a time-out."""
        data = self._port.read(self._until_s - self._clock())
        self.received += len(data)
        if self.received > MAX_REPLY_BYTES:
            raise ReplyWrong(self._device, f"{self._port.name} babbles", "check termination, A/B wiring and baud rate")
        return data

    def _whole_answer(self, sending: bool, data: bytes) -> bytes:
        """Hand pymodbus a whole answer or nothing yet: on a false start it would throw away all that has come."""
        if sending:
            self._unit, self._function = data[:2]
            return data
        return rtu_answer(data, self._unit, self._function)
