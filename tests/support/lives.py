"""The service many times over: each life forked from a process that has imported it already, so that a thousand kills
take minutes; and a PLC that notes, as fast as it can poll, what it is shown."""

from __future__ import annotations

import contextlib
import re
import signal
import socket
import struct
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from inspector.publish.registers import CONTROL_ADDRESS, RESULT_ADDRESS, RESULT_REGISTERS, Status
from tests.support.forked import Command
from tests.support.plc_program import PlcProgram

_AT = {row.name: row.address - RESULT_ADDRESS for row in RESULT_REGISTERS}
_HEAD_WORDS = 64
_PAUSE_S = 0.0005
"""Between polls, so that the processor is left to the service: no result is shown for a shorter time."""


class Life:
    """The service at work, until it is killed or asked to stop."""

    def __init__(self, config: Path, output: Path, wait_until: Callable[..., Any]) -> None:
        self._output, self._wait_until = output, wait_until
        output.write_bytes(b"")
        self.process = Command("run", "--config", config, output=output)

    @property
    def log(self) -> str:
        return self._output.read_text()

    @property
    def port(self) -> int:
        return int(self._wait_until(self._said_port, "a port", 30.0))

    def _said_port(self) -> int | None:
        found = re.search(r"-p (\d+) ", self.log)
        assert found or self.process.poll() is None, self.log
        return int(found[1]) if found else None

    def watched(self, program: PlcProgram | None = None) -> Watcher:
        """A PLC that has had its first answer."""
        watcher = Watcher(self.port, program)
        self._wait_until(lambda: watcher.polls, f"an answer; log: {self.log}", 60)
        return watcher

    def shows(self, watcher: Watcher, results: int) -> None:
        """Wait until so many were seen."""
        self._wait_until(lambda: len(watcher.shown) >= results, f"{results} results; log: {self.log}", 60)

    def kill(self) -> None:
        self.process.kill()
        self.process.wait(30)

    def stop(self) -> None:
        """Ask it to stop, and wait until it has."""
        self.process.send_signal(signal.SIGTERM)
        assert self.process.wait(30) == 0, self.log

    def __enter__(self) -> Life:
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()


class Watcher:
    """A PLC that polls the head of the result block in a thread of its own, a thousand times a second, until the
    service is gone.

    ``stored`` are the sequences that it saw without STORE_DEGRADED beside them, ``shown`` all, each once, in the order
    seen. With a ``program`` it takes results as that does.
    """

    def __init__(self, port: int, program: PlcProgram | None = None) -> None:
        self._program = program
        self.shown: list[int] = []
        self.stored: set[int] = set()
        self.polls = 0
        self.status = 0
        self.first: int | None = None
        self._socket = socket.create_connection(("127.0.0.1", port), timeout=30)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._stream = self._socket.makefile("rb")
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def join(self) -> None:
        """Wait until the service is gone."""
        self._thread.join(30)
        assert not self._thread.is_alive()
        self._stream.close()
        self._socket.close()

    def _run(self) -> None:
        pause = threading.Event()
        with contextlib.suppress(OSError, EOFError):
            while not pause.wait(_PAUSE_S):
                self._note(self._read())

    def _read(self) -> tuple[int, ...]:
        return struct.unpack(f">{_HEAD_WORDS}H", self._ask(3, struct.pack(">HH", RESULT_ADDRESS, _HEAD_WORDS))[1:])

    def _ask(self, function: int, data: bytes) -> bytes:
        self._socket.sendall(struct.pack(">HHHBB", 1, 0, 2 + len(data), 1, function) + data)
        head = self._stream.read(8)
        if len(head) < 8:
            raise EOFError
        body = self._stream.read(struct.unpack(">H", head[4:6])[0] - 2)
        assert head[7] == function, f"exception {body!r}"
        return body

    def _note(self, words: tuple[int, ...]) -> None:
        at = _AT["sequence_u32"]
        sequence, self.status = words[at] << 16 | words[at + 1], words[_AT["status"]]
        self.polls += 1
        if self.first is None:
            self.first = sequence  # what the service begins with: the number of the last life's result, or of none
        if sequence != self.first:
            if not self.shown or self.shown[-1] != sequence:
                self.shown.append(sequence)
            if not self.status & Status.STORE_DEGRADED:
                self.stored.add(sequence)
        if self._program is not None:
            names = ("handshake", "sequence", "verdict")
            read = {name: words[_AT[name]] for name in names} | {"sequence_u32": sequence}
            bits, number = self._program.scan(read)
            self._ask(16, struct.pack(">HHBHH", CONTROL_ADDRESS, 2, 4, bits, number))
