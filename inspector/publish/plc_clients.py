"""The clients of the PLC server: who is let in, attended to in turn, and closed when it is time.

One thread, one epoll, waited on in C (:mod:`inspector.publish.plc_direct`), where reads are answered at once; the rest
is attended to here.
"""

from __future__ import annotations

import logging
import os
import select
import socket
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

from inspector.publish.plc_access import Networks, gives_way
from inspector.publish.plc_connection import Connection, Ending
from inspector.publish.plc_direct import Direct, Left

log = logging.getLogger(__name__)

NO_ROOM_S = 1.0
"""How long no newcomer is looked at when the system has no descriptor or memory for one."""
MAX_NAMED_STRANGERS = 256

Welcome = Callable[[socket.socket, str, bool], Connection]
"""Makes a connection of a socket, its address, and whether that may write."""


@dataclass(frozen=True, slots=True)
class Access:
    """Who may connect, who of those may write, and how many at once and how silent they may be."""

    allow: Networks
    allow_write: Networks
    max_connections: int
    idle_timeout_s: float


@dataclass(slots=True)
class Door:
    """What happened at the door, since start."""

    accepted: int = 0
    refused_strangers: int = 0
    refused_full: int = 0
    endings: Counter[Ending] = field(default_factory=Counter)


class Clients:
    """Accepts on listeners and attends to who came, in :meth:`run`, until :meth:`stop`."""

    def __init__(self, access: Access, direct: Direct) -> None:
        self._access, self._direct = access, direct
        self._epoll = select.epoll()
        self._listeners: dict[int, tuple[socket.socket, Welcome]] = {}
        self.connections: dict[int, Connection] = {}
        self.door = Door()
        self._strangers: set[str] = set()
        self._accepting_from_s = 0.0
        self._wake_fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._epoll.register(self._wake_fd, select.EPOLLIN)
        self._stopping = False

    def listen(self, listener: socket.socket, welcome: Welcome) -> None:
        """Accept there too."""
        listener.setblocking(False)
        self._listeners[listener.fileno()] = listener, welcome
        self._epoll.register(listener, select.EPOLLIN)

    def run(self, regularly: Callable[[], None], every_s: float) -> None:
        """Serve until stopped, then close every socket; ``regularly`` is called every ``every_s``."""
        due_s = time.monotonic()
        try:
            while not self._stopping:
                now_s = time.monotonic()
                if now_s >= due_s:
                    due_s = now_s + every_s
                    regularly()
                    self._tidy(now_s)
                self._attend(*self._direct.wait(self._epoll.fileno(), due_s - now_s))
        finally:
            self._close_sockets()

    def stop(self) -> None:
        """End :meth:`run`; from any thread, before :meth:`close`."""
        self._stopping = True
        os.eventfd_write(self._wake_fd, 1)

    def close(self) -> None:
        """Give back what is left, once :meth:`run` has ended or was never called."""
        self._close_sockets()
        self._epoll.close()
        os.close(self._wake_fd)

    def _attend(self, left: Left, fd: int, data: bytes) -> None:
        connection = self.connections.get(fd)
        if left is Left.NOTHING or connection is None:
            if left is Left.READY and fd in self._listeners:
                self._accept(*self._listeners[fd])
            return
        wanted = connection.wanted
        try:
            connection.attend(left, data)
        except Exception:
            log.exception("PLC client %s cannot be served", connection.address)
            connection.ending = Ending.FAILED
        if connection.ending:
            self._close(fd, connection.ending)
            return
        self._direct.watch(fd, connection.direct)
        if connection.wanted != wanted:
            self._epoll.modify(fd, connection.wanted)

    def _accept(self, listener: socket.socket, welcome: Welcome) -> None:
        """Look at one newcomer; the others in the queue wait while those who are in have their turn."""
        try:
            client, peer = listener.accept()
        except (BlockingIOError, ConnectionAbortedError):
            return
        except OSError as error:
            self._pause_accepting(error)
        else:
            self._welcome(client, peer[0], welcome)

    def _welcome(self, client: socket.socket, address: str, welcome: Welcome) -> None:
        may_write = address in self._access.allow_write
        if not self.admits(address, may_write):
            client.close()
            return
        try:
            connection = welcome(client, address, may_write)
        except OSError:  # gone already
            client.close()
            return
        self.door.accepted += 1
        fd = connection.fileno()
        self.connections[fd] = connection
        self._direct.take_activity(fd)  # another's
        self._direct.watch(fd, connection.direct)
        self._epoll.register(fd, connection.wanted)

    def admits(self, address: str, may_write: bool) -> bool:
        """Whether this address may connect, and room is there or made; says in the log, once an address, why not."""
        if address not in self._access.allow:
            self.door.refused_strangers += 1
            self._name_stranger(address, "is not on the allow-list")
            return False
        if len(self.connections) < self._access.max_connections:
            return True
        self._note_activity()
        yielding = gives_way(address, may_write, self.connections.values(), time.monotonic())
        if yielding is None:
            self.door.refused_full += 1
            self._name_stranger(address, f"found all {self._access.max_connections} connections taken")
            return False
        self._close(yielding.fileno(), Ending.GAVE_WAY)
        return True

    def _name_stranger(self, address: str, why: str) -> None:
        if address not in self._strangers and len(self._strangers) < MAX_NAMED_STRANGERS:
            self._strangers.add(address)
            log.warning("PLC client %s refused: it %s", address, why)

    def _pause_accepting(self, error: OSError) -> None:
        """Out of descriptors or memory: those who are in are served on, and the others wait at the door."""
        if not self._accepting_from_s:
            log.error(
                "PLC server cannot accept for now: %s; raise LimitNOFILE or lower max_connections", error.strerror
            )
        self._accepting_from_s = time.monotonic() + NO_ROOM_S
        for fd in self._listeners:
            self._epoll.modify(fd, 0)

    def _tidy(self, now_s: float) -> None:
        if self._accepting_from_s and now_s > self._accepting_from_s:
            self._accepting_from_s = 0.0
            for fd in self._listeners:
                self._epoll.modify(fd, select.EPOLLIN)
        self._note_activity()
        for fd, connection in list(self.connections.items()):
            ending = connection.overdue(now_s, self._access.idle_timeout_s)
            if ending:
                self._close(fd, ending)

    def _note_activity(self) -> None:
        """Connections learn what was answered for them in C."""
        for fd, connection in self.connections.items():
            answered, heard_s = self._direct.take_activity(fd)
            if answered:
                connection.answered, connection.heard_s = connection.answered + answered, heard_s

    def _close(self, fd: int, ending: Ending) -> None:
        self.door.endings[ending] += 1
        self._direct.watch(fd, False)
        self.connections.pop(fd).close()  # which takes it out of the epoll too

    def _close_sockets(self) -> None:
        for fd in list(self.connections):
            self._close(fd, Ending.STOPPED)
        for listener, _ in self._listeners.values():
            listener.close()
