"""The same registers over a serial line: a Modbus RTU slave in a thread of its own.

The thread owns the port. It never waits for the inspection, nor the inspection for it; a port that is missing, or is
pulled, is looked for until it is back.
"""

from __future__ import annotations

import logging
import threading
from typing import Protocol

from firmware_bridge.errors import BridgeError
from firmware_bridge.links.ports import CHARACTER_BITS, QUIET_CHARACTERS, QUIET_LEAST_S, Port, open_serial
from firmware_bridge.wire.modbus import Slave
from firmware_bridge.wire.modbus_frames import RtuSession

log = logging.getLogger(__name__)

DEVICE = "PLC's serial line"
LOOK_S = 0.25
"""How often the thread looks whether it is to stop."""
GIVEN_UP_S = 0.05
"""An unfinished message is given up after such a pause at the least: adapters hand bytes over in lots, 16 ms apart."""
WRITE_S = 1.0
RETRY_FIRST_S, RETRY_LONGEST_S = 0.1, 2.0


class SerialLine(Protocol):
    """A serial line to listen on."""

    @property
    def port(self) -> str: ...
    @property
    def baud(self) -> int: ...
    @property
    def parity(self) -> str: ...
    @property
    def stop_bits(self) -> int: ...
    @property
    def unit(self) -> int: ...
    @property
    def allow_write(self) -> bool: ...


class SerialShell:
    """Serves ``slave`` on ``line`` from :meth:`start` to :meth:`stop`. ``is_open`` says whether the port is there."""

    def __init__(self, slave: Slave, line: SerialLine) -> None:
        self._slave, self._line = slave, line
        self._quiet_s = max(QUIET_CHARACTERS * CHARACTER_BITS / line.baud, QUIET_LEAST_S)
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="plc-serial", daemon=True)
        self.is_open = False

    def start(self) -> None:
        """Begin; a port that is not there yet is waited for."""
        self._thread.start()

    def stop(self) -> None:
        """Close the port and end the thread."""
        self._stopping.set()
        self._thread.join(WRITE_S + LOOK_S)

    def _run(self) -> None:
        said, retry_s = "", RETRY_FIRST_S
        while not self._stopping.is_set():
            try:
                port = self._open()
                said, retry_s = "", RETRY_FIRST_S
                self._serve(port)
            except BridgeError as error:
                if str(error) != said:
                    said = str(error)
                    log.warning("%s; looking for it again", error)
                self._stopping.wait(retry_s)
                retry_s = min(2 * retry_s, RETRY_LONGEST_S)

    def _open(self) -> Port:
        line = self._line
        port = open_serial(DEVICE, line.port, baud=line.baud, parity=line.parity, stop_bits=line.stop_bits)
        log.info("%s: unit %d answers on %s, %d baud", DEVICE, line.unit, line.port, line.baud)
        return port

    def _serve(self, port: Port) -> None:
        """Answer until the port fails or the thread is to end."""
        session = RtuSession(self._slave, may_write=self._line.allow_write)
        self.is_open = True
        try:
            while not self._stopping.is_set():
                self._turn(port, session)
        finally:
            self.is_open = False
            port.close()

    def _turn(self, port: Port, session: RtuSession) -> None:
        """Take what comes; answer once the line is quiet, as a slave has to wait 3.5 characters before it speaks."""
        data = port.read(max(GIVEN_UP_S, 2 * self._quiet_s) if session.unfinished else LOOK_S)
        answers = session.receive(data) if data else session.silence()
        if answers:
            answers += session.receive(port.read(self._quiet_s))
            port.write(answers, WRITE_S)
