"""The wire of a simulated module: a pseudo-terminal speaking Modbus RTU, or a TCP port, with faults on request."""

from __future__ import annotations

import contextlib
import enum
import os
import random
import select
import selectors
import socket
import threading
import tty
from collections.abc import Callable
from pathlib import Path

from firmware_bridge.simulators.module_state import SimulatedModule
from firmware_bridge.wire.modbus import Slave
from firmware_bridge.wire.modbus_frames import RtuSession, TcpSession

SILENCE_S = 0.05
"""A pause in which an unfinished frame is given up. A real line's is 3.5 characters; relays between ptys are slower."""

READ_BYTES = 4096


class WireFault(enum.StrEnum):
    """What goes wrong with an answer."""

    NONE = "none"
    SILENT = "silent"
    LATE = "late"
    GARBAGE = "garbage"
    BAD_CRC = "bad-crc"
    WRONG_UNIT = "wrong-unit"
    TRUNCATED = "truncated"


def spoil(fault: WireFault, answer: bytes, unit_at: int) -> bytes:
    """An RTU or TCP answer as the fault leaves it; ``unit_at`` is where the frame has its unit id.

    A TCP answer has no checksum: there bad-crc damages its last data byte, which only TCP's own would notice.
    """
    match fault:
        case WireFault.SILENT:
            return b""
        case WireFault.GARBAGE:
            return random.Random(len(answer)).randbytes(len(answer))
        case WireFault.BAD_CRC:
            return answer[:-1] + bytes((answer[-1] ^ 0xFF,))
        case WireFault.WRONG_UNIT:
            return _for_another_unit(answer, unit_at)
        case WireFault.TRUNCATED:
            return answer[: len(answer) // 2]
        case _:
            return answer


class ModuleServer:
    """Serves one module on a pseudo-terminal (``tcp`` False) or on a free TCP port of this machine.

    ``address`` is the terminal's path, or host:port. ``symlink`` is made to point at the terminal, and taken away
    at the end. ``fault`` may be set at any time, from any thread: it spoils answers ``fault_after`` to ``fault_after
    + fault_count`` (None: without end), counted from 0 since it was made. Serve in a thread (:meth:`start`,
    :meth:`stop`) or in this one (:meth:`serve`).
    """

    def __init__(self, module: SimulatedModule, unit: int, *, tcp: bool = False, symlink: Path | None = None) -> None:
        self.module, self._unit_at = module, 6 if tcp else 0
        self.fault, self.fault_after = WireFault.NONE, 0
        self.fault_count: int | None = None
        self.late_s = 1.0
        self._slave = Slave({unit: module})
        self._answers = 0
        self._selector = selectors.DefaultSelector()
        self._cleanup = contextlib.ExitStack()
        self._stop_fd, self._stopping_fd = os.pipe()
        self._cleanup.callback(os.close, self._stop_fd)
        self._cleanup.callback(os.close, self._stopping_fd)
        self._cleanup.callback(self._selector.close)
        self._when_silent: Callable[[], None] | None = None
        self._thread: threading.Thread | None = None
        self.address = self._listen() if tcp else self._open_terminal(symlink)

    def start(self) -> ModuleServer:
        """Serve in a thread of its own."""
        self._thread = threading.Thread(target=self.serve, name="module-simulator", daemon=True)
        self._thread.start()
        return self

    def stop(self) -> None:
        """Stop serving and take everything away: for the other side, the cable is pulled. May be called twice."""
        if self._thread:
            os.write(self._stopping_fd, b"x")
            self._thread.join()
            self._thread = None
        self._cleanup.close()

    def serve(self, until_closed_fd: int | None = None) -> None:
        """Answer until :meth:`stop`, or until the other end of ``until_closed_fd`` is closed."""
        self._selector.register(self._stop_fd, selectors.EVENT_READ, lambda: True)
        if until_closed_fd is not None:
            self._selector.register(until_closed_fd, selectors.EVENT_READ, lambda: not os.read(until_closed_fd, 512))
        done = False
        while not done:
            ready = self._selector.select(SILENCE_S if self._when_silent else None)
            if not ready and self._when_silent:
                self._when_silent()
                self._when_silent = None
            done = any(key.data() for key, _ in ready)

    def _open_terminal(self, symlink: Path | None) -> str:
        master, slave = os.openpty()
        # The slave side stays open here: while nobody has it open, reading the master fails.
        self._cleanup.callback(os.close, master)
        self._cleanup.callback(os.close, slave)
        tty.setraw(slave)
        os.set_blocking(master, False)
        path = os.ttyname(slave)
        if symlink:
            _point(symlink, path)
            self._cleanup.callback(_unpoint, symlink, path)
        session = RtuSession(self._slave)
        self._selector.register(master, selectors.EVENT_READ, lambda: self._terminal_readable(master, session))
        return path

    def _terminal_readable(self, master: int, session: RtuSession) -> bool:
        with contextlib.suppress(OSError):
            self._send(session.receive(os.read(master, READ_BYTES)), lambda data: os.write(master, data))
        self._when_silent = lambda: self._send(session.silence(), lambda data: os.write(master, data))
        return False

    def _listen(self) -> str:
        listener = self._cleanup.enter_context(socket.create_server(("127.0.0.1", 0)))
        self._selector.register(listener, selectors.EVENT_READ, lambda: self._accept(listener))
        host, port = listener.getsockname()
        return f"{host}:{port}"

    def _accept(self, listener: socket.socket) -> bool:
        connection = self._cleanup.enter_context(listener.accept()[0])
        session = TcpSession(self._slave)
        self._selector.register(
            connection, selectors.EVENT_READ, lambda: self._connection_readable(connection, session)
        )
        return False

    def _connection_readable(self, connection: socket.socket, session: TcpSession) -> bool:
        try:
            data = connection.recv(READ_BYTES)
            self._send(session.receive(data), connection.send)
        except OSError:
            data = b""
        if not data or session.broken:
            self._selector.unregister(connection)
            connection.close()
        return False

    def _send(self, answer: bytes, send: Callable[[bytes], object]) -> None:
        if not answer:
            return
        number, self._answers = self._answers - self.fault_after, self._answers + 1
        due = number >= 0 and (self.fault_count is None or number < self.fault_count)
        fault = self.fault if due else WireFault.NONE
        if fault is WireFault.LATE:
            select.select([self._stop_fd], [], [], self.late_s)
        if spoiled := spoil(fault, answer, self._unit_at):
            send(spoiled)


def _for_another_unit(answer: bytes, unit_at: int) -> bytes:
    from firmware_bridge.wire.modbus_frames import rtu_frame

    other = answer[unit_at] % 247 + 1
    if unit_at == 0:
        return rtu_frame(other, answer[1:-2])
    return answer[:unit_at] + bytes((other,)) + answer[unit_at + 1 :]


def _point(symlink: Path, target: str) -> None:
    """Make or move the link in one step; what is not a link is left alone. Raises FileExistsError."""
    if symlink.exists() and not symlink.is_symlink():
        raise FileExistsError(f"{symlink} is in the way and is not a symbolic link: give another name")
    fresh = symlink.with_name(f".{symlink.name}.{os.getpid()}")
    fresh.symlink_to(target)
    fresh.replace(symlink)


def _unpoint(symlink: Path, target: str) -> None:
    """Take the link away, unless it is another's by now."""
    with contextlib.suppress(OSError):
        if os.readlink(symlink) == target:
            symlink.unlink()
