"""One client of the PLC server: bytes in, answers out, never waiting for it."""

from __future__ import annotations

import enum
import select
import socket
import time
from typing import ClassVar

from firmware_bridge.wire.modbus_frames import TcpSession
from inspector.publish.plc_direct import RECEIVE_BYTES, Left

SLOW_READER_S = 5.0
"""How long a client may leave its answers unread."""


class Ending(enum.Enum):
    """Why a connection is over."""

    BY_CLIENT = "was closed by the client"
    IDLE = "sent no whole request in time"
    SLOW = "did not take its answers"
    OUT_OF_STEP = "does not speak Modbus TCP"
    GAVE_WAY = "gave way to another"
    NOT_SECURE = "did not prove itself in the TLS handshake"
    FAILED = "met a fault of the server's own"
    STOPPED = "was closed with the server"


class Connection:
    """A client that was let in. While answers wait to be taken, nothing is read from it: that bounds what is kept.

    ``wanted`` is what to wait for (epoll events). ``ending`` is set once it is over; whoever looks after it then
    calls :meth:`close`.
    """

    NOT_YET: ClassVar[tuple[type[OSError], ...]] = (BlockingIOError,)
    """What the socket raises where it would have to wait."""

    def __init__(self, client: socket.socket, address: str, session: TcpSession) -> None:
        self.address, self.answered = address, 0
        self.heard_s = time.monotonic()
        self.wanted = select.EPOLLIN
        self.ending: Ending | None = None
        self._client, self._session, self._unsent = client, session, b""
        self._blocked_s: float | None = None
        client.setblocking(False)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    @property
    def may_write(self) -> bool:
        """Whether its writes are carried out."""
        return self._session.may_write

    def fileno(self) -> int:
        """The socket's descriptor; -1 once it is closed."""
        return self._client.fileno()

    @property
    def direct(self) -> bool:
        """Whether what comes next may be answered by others: nothing of before is waiting."""
        return not self._unsent and not self._session.unfinished

    def attend(self, left: Left, data: bytes) -> None:
        """Something can be read or written, was received and not answered (``data``), or was answered and not sent."""
        try:
            if left is Left.READY:
                self._go_on()
            elif left is Left.UNSENT:
                self._send(data)
            else:
                self._receive(data)
        except self.NOT_YET:
            return
        except OSError:
            self.ending = self.ending or Ending.BY_CLIENT

    def overdue(self, now_s: float, idle_timeout_s: float) -> Ending | None:
        """Why it has to be closed by now, if it has."""
        if self._blocked_s is not None and now_s - self._blocked_s > SLOW_READER_S:
            return Ending.SLOW
        # Only whole requests keep a connection alive: dribbling bytes into it does not.
        return Ending.IDLE if now_s - self.heard_s > idle_timeout_s else None

    def close(self) -> None:
        """Close; may be called twice."""
        self._client.close()

    def _go_on(self) -> None:
        if self._unsent:
            self._send(self._unsent)
        else:
            self._receive(self._client.recv(RECEIVE_BYTES))

    def _receive(self, data: bytes) -> None:
        if not data:
            self.ending = Ending.BY_CLIENT
            return
        answers = self._session.receive(data)
        if answers:
            self.answered += 1
            self.heard_s = time.monotonic()
            self._send(answers)
        if self._session.broken:
            self.ending = Ending.OUT_OF_STEP

    def _send(self, data: bytes) -> None:
        try:
            sent = self._client.send(data)
        except self.NOT_YET:
            sent = 0
        if sent == len(data):
            if self._unsent:
                self._unsent, self._blocked_s, self.wanted = b"", None, select.EPOLLIN
        else:
            self._unsent, self.wanted = data[sent:], select.EPOLLOUT
            self._blocked_s = time.monotonic()  # since it last took anything
