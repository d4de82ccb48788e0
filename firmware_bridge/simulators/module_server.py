"""The wire of a simulated module: a pseudo-terminal speaking Modbus RTU, or a TCP port, with faults on request."""

from __future__ import annotations

import enum
import random
import selectors
import socket
from collections.abc import Callable
from pathlib import Path

from firmware_bridge.simulators.module_state import SimulatedModule
from firmware_bridge.simulators.server import READ_BYTES, Server
from firmware_bridge.wire.modbus import Slave
from firmware_bridge.wire.modbus_frames import RtuSession, TcpSession


class WireFault(enum.StrEnum):
    """What goes wrong with an answer."""

    NONE = "none"
    SILENT = "silent"
    LATE = "late"
    GARBAGE = "garbage"
    BAD_CRC = "bad-crc"
    WRONG_UNIT = "wrong-unit"
    TRUNCATED = "truncated"
    TWICE = "twice"


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
        case WireFault.TWICE:
            return answer + answer
        case _:
            return answer


class ModuleServer(Server):
    """Serves one module on a pseudo-terminal (``tcp`` False) or on a TCP port of this machine (0: any free one).

    ``address`` is the terminal's path, or host:port. ``symlink`` is made to point at the terminal, and taken away
    at the end. ``fault`` may be set at any time, from any thread: it spoils answers ``fault_after`` to ``fault_after
    + fault_count`` (None: without end), counted from 0 since it was made.
    """

    def __init__(
        self, module: SimulatedModule, unit: int, *, tcp: bool = False, tcp_port: int = 0, symlink: Path | None = None
    ) -> None:
        super().__init__()
        self.module, self._unit_at = module, 6 if tcp else 0
        self.fault, self.fault_after = WireFault.NONE, 0
        self.fault_count: int | None = None
        self.late_s = 1.0
        self._slave = Slave({unit: module})
        self._answers = 0
        self.address = self._listen(tcp_port) if tcp else self._open_terminal(symlink)

    def _open_terminal(self, symlink: Path | None) -> str:
        session = RtuSession(self._slave)
        path, send = self.open_terminal(
            # To what is no command of its maker's protocol a module in ASCII mode keeps silent.
            lambda data: None if self.module.ascii else self._send(session.receive(data), send),
            symlink,
            lambda: self._send(session.silence(), send),
        )
        return path

    def _listen(self, tcp_port: int) -> str:
        listener = self.cleanup.enter_context(socket.create_server(("127.0.0.1", tcp_port)))
        self._selector.register(listener, selectors.EVENT_READ, lambda: self._accept(listener))
        host, port = listener.getsockname()
        return f"{host}:{port}"

    def _accept(self, listener: socket.socket) -> bool:
        connection = self.cleanup.enter_context(listener.accept()[0])
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
            self.wait(self.late_s)
        if spoiled := spoil(fault, answer, self._unit_at):
            send(spoiled)


def _for_another_unit(answer: bytes, unit_at: int) -> bytes:
    from firmware_bridge.wire.modbus_frames import rtu_frame

    other = answer[unit_at] % 247 + 1
    if unit_at == 0:
        return rtu_frame(other, answer[1:-2])
    return answer[:unit_at] + bytes((other,)) + answer[unit_at + 1 :]
