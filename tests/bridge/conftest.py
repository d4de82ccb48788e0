"""Module simulators in threads, scripted peers on a socket pair, and devices built as the service builds them."""

from __future__ import annotations

import contextlib
import os
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from firmware_bridge.factory import build_master, build_module
from firmware_bridge.links.modbus_master import ModbusMaster
from firmware_bridge.links.ports import Port
from firmware_bridge.settings import ModuleSettings
from firmware_bridge.simulators.module_server import ModuleServer
from firmware_bridge.simulators.module_state import SimulatedModule
from firmware_bridge.wire.profiles import PROFILES

UNIT = 3


@pytest.fixture
def serve() -> Iterator[Callable[..., ModuleServer]]:
    """``serve(profile, tcp=False, symlink=None, clock=...)``: a simulated module, served until the test ends."""
    with contextlib.ExitStack() as stack:

        def start(
            profile: str, *, tcp: bool = False, symlink: Path | None = None, clock: Callable[[], float] = time.monotonic
        ) -> ModuleServer:
            module = SimulatedModule(PROFILES[profile], clock)
            server = ModuleServer(module, UNIT, tcp=tcp, symlink=symlink).start()
            stack.callback(server.stop)
            return server

        yield start


@pytest.fixture
def settings_for() -> Callable[..., ModuleSettings]:
    """``settings_for(profile, address, **more)``: settings of a module at a port's path or at host:port."""

    def make(profile: str, address: str, **more: Any) -> ModuleSettings:
        host, _, port = address.rpartition(":")
        link = {"kind": "tcp", "host": host, "port": int(port)} if host else {"kind": "serial", "port": address}
        return ModuleSettings.model_validate({"profile": profile, "unit": UNIT, "link": link} | more)

    return make


@pytest.fixture
def module_at(settings_for: Callable[..., ModuleSettings]) -> Iterator[Callable[..., Any]]:
    """``module_at(profile, address, **settings)``: the driver, built by the factory, not yet open."""
    with contextlib.ExitStack() as stack:

        def make(profile: str, address: str, **more: Any) -> Any:
            driver = build_module(settings_for(profile, address, **more))
            stack.callback(driver.close)
            return driver

        yield make


@pytest.fixture
def master_at(settings_for: Callable[..., ModuleSettings]) -> Iterator[Callable[..., ModbusMaster]]:
    """``master_at(address, deadline_s=...)``: an open Modbus master."""
    with contextlib.ExitStack() as stack:

        def make(address: str, deadline_s: float = 2.0) -> ModbusMaster:
            master = build_master(settings_for("ato-4ch", address, deadline_s=deadline_s))
            stack.callback(master.close)
            master.open()
            return master

        yield make


class ScriptedPeer:
    """The other end of a master's port: keeps what it was sent, and answers each request with the next of a script."""

    def __init__(self, answers: list[bytes]) -> None:
        self.requests: list[bytes] = []
        self.near, self._far = socket.socketpair()
        self._thread = threading.Thread(target=self._run, args=(answers,), daemon=True)
        self._thread.start()

    def _run(self, answers: list[bytes]) -> None:
        for answer in answers:
            request = self._far.recv(512)
            if not request:
                return
            self.requests.append(request)
            self._far.sendall(answer)

    def send(self, data: bytes) -> None:
        self._far.sendall(data)

    def drip(self, data: bytes) -> None:
        """Answer the next request byte by byte."""
        self.requests.append(self._far.recv(512))
        for byte in data:
            self._far.sendall(bytes((byte,)))

    def hang_up(self) -> None:
        self._far.shutdown(socket.SHUT_RDWR)

    def stop(self) -> None:
        with contextlib.suppress(OSError):
            self._far.shutdown(socket.SHUT_RDWR)
        self._thread.join()
        self._far.close()


@pytest.fixture
def scripted() -> Iterator[Callable[..., tuple[ModbusMaster, ScriptedPeer]]]:
    """``scripted(answers, rtu=True, deadline_s=0.3)``: an open master and the peer that its port leads to."""
    with contextlib.ExitStack() as stack:

        def make(
            answers: list[bytes], *, rtu: bool = True, deadline_s: float = 0.3
        ) -> tuple[ModbusMaster, ScriptedPeer]:
            peer = ScriptedPeer(answers)
            port = Port("module", "pair", peer.near)
            master = ModbusMaster("module", UNIT, lambda: port, rtu=rtu, deadline_s=deadline_s)
            master.open()
            stack.callback(master.close)
            stack.callback(peer.stop)
            return master, peer

        yield make


@pytest.fixture
def descriptors() -> Callable[[], int]:
    """How many file descriptors this process has open."""
    return lambda: len(os.listdir("/proc/self/fd"))
