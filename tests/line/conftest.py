"""A station on loopback: settings in a folder of the test's own, the service as a process, a PLC that polls it."""

from __future__ import annotations

import contextlib
import re
import shutil
import signal
import socket
import struct
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from firmware_bridge.simulators.module_server import ModuleServer
from firmware_bridge.simulators.module_state import SimulatedModule
from firmware_bridge.wire.profiles import PROFILES
from inspector.publish.registers import RESULT_ADDRESS, RESULT_WORDS, Status, decode
from tests.support.forked import Command

CONFIG = Path(__file__).parents[2] / "config"
PROFILE = "tm-da1p1r1"
FRAMES = ("A000.png", "C006.png", "F000.png")


class Plc:
    """A PLC: reads the result block over a socket of its own."""

    def __init__(self, port: int) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port), timeout=10)
        self._stream = self._socket.makefile("rb")

    def read(self, address: int = RESULT_ADDRESS, words: int = RESULT_WORDS) -> dict[str, Any]:
        """The result block, or another area, by name. Raises OSError when the service has gone."""
        self._socket.sendall(struct.pack(">HHHBBHH", 1, 0, 6, 1, 3, address, words))
        answer = self._stream.read(9 + 2 * words)
        if len(answer) < 9 + 2 * words:
            raise ConnectionResetError
        return decode(struct.unpack(f">{words}H", answer[9:]), address)

    def write(self, address: int, *words: int) -> int:
        """Write registers by function 16; the exception code, 0 if it was done."""
        self._socket.sendall(self.write_request(address, *words))
        answer = self._stream.read(8)
        if len(answer) < 8:
            raise ConnectionResetError
        if answer[7] & 0x80:
            return self._stream.read(1)[0]
        self._stream.read(4)
        return 0

    @staticmethod
    def write_request(address: int, *words: int) -> bytes:
        """A whole request of function 16."""
        data = struct.pack(f">{len(words)}H", *words)
        return struct.pack(">HHHBBHHB", 1, 0, 7 + len(data), 1, 16, address, len(words), len(data)) + data

    def reset(self, request: bytes = b"") -> None:
        """Send these bytes and break the connection, without waiting for an answer."""
        self._socket.sendall(request)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self.close()

    def until(self, wait_until: Callable[..., Any], condition: Callable[[dict[str, Any]], Any], what: str) -> Any:
        """The first registers that the condition holds for."""

        def met() -> dict[str, Any] | None:
            registers = self.read()
            return registers if condition(registers) else None

        return wait_until(met, what)

    def close(self) -> None:
        self._stream.close()
        self._socket.close()


class Service:
    """The service as a process; what it writes is gathered line by line."""

    def __init__(self, config: Path, wait_until: Callable[..., Any], options: list[str], **environment: str) -> None:
        self._wait_until = wait_until
        self.process = Command("run", "--config", config, *options, **environment)
        self.out: list[str] = []
        self.log: list[str] = []
        self._readers = [self._gather(self.process.stdout, self.out), self._gather(self.process.stderr, self.log)]
        self._clients = contextlib.ExitStack()

    @staticmethod
    def _gather(stream: Any, lines: list[str]) -> threading.Thread:
        def run() -> None:
            for line in stream:
                lines.append(line.rstrip("\n"))

        thread = threading.Thread(target=run, daemon=True)
        thread.start()
        return thread

    @property
    def port(self) -> int:
        """The port that the service says it serves."""
        return int(self._wait_until(lambda: self._said(r"-p (\d+) "), f"a port; log: {self.log}"))

    def _said(self, pattern: str) -> str | None:
        return next((found[1] for line in self.out if (found := re.search(pattern, line))), None)

    @property
    def results(self) -> list[str]:
        """The lines of panels so far."""
        return [line for line in self.out if line.startswith("#")]

    def lines_to(self, sequence: int) -> list[str]:
        """The lines of panels 1 to ``sequence``; a line follows its registers."""
        self._wait_until(lambda: len(self.results) >= sequence, f"the line of panel {sequence}")
        return self.results[:sequence]

    def plc(self) -> Plc:
        """A client, closed with the service."""
        return self._clients.enter_context(contextlib.closing(Plc(self.port)))

    def until(self, condition: Callable[[dict[str, Any]], Any], what: str) -> dict[str, Any]:
        """The first registers that the condition holds for."""
        plc = self.plc()
        last: dict[str, Any] = {}

        def met() -> dict[str, Any] | None:
            last.update(plc.read())
            return dict(last) if condition(last) else None

        try:
            found: dict[str, Any] = self._wait_until(met, what)
        except pytest.fail.Exception:
            pytest.fail(f"{what}; registers: {last}; log: {self.log}; results: {self.results[-5:]}")
        return found

    def until_fault(self, code: int) -> dict[str, Any]:
        """The registers as soon as they show this fault code; they must then show no verdict."""
        shown = self.until(lambda r: r["fault_code"] == code, f"fault {code}")
        assert shown["verdict"] == 0
        return shown

    def until_inspecting(self, after: int = 0) -> dict[str, Any]:
        """The registers as soon as they show a PASS or FAIL later than result ``after``."""
        return self.until(lambda r: r["verdict"] and r["sequence"] > after, "a verdict")

    def send(self, number: signal.Signals) -> None:
        self.process.send_signal(number)

    def ended(self) -> int:
        """The exit status, once all its output is here."""
        status = self.process.wait(30)
        for reader in self._readers:
            reader.join(10)
        return status

    def close(self) -> None:
        self._clients.close()
        if self.process.poll() is None:
            self.process.kill()
        self.ended()
        for stream in (self.process.stdout, self.process.stderr):
            stream.close()


class Station:
    """Settings in ``folder`` that tests change; frames beside them; the module's serial port is a link there."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.file = folder / "station.yaml"
        self.frames = folder / "frames"
        self.serial = folder / "module"
        self.frames.mkdir()
        for name in FRAMES:
            shutil.copy(CONFIG / "frames" / name, self.frames)
        self.settings: dict[str, Any] = {
            "calibration": str(CONFIG / "calibration" / "demo.yaml"),
            "camera": {"kind": "replay", "paths": ["frames"], "rate_hz": 20, "deadline_s": 1},
            "module": {
                "profile": PROFILE,
                "unit": 1,
                "deadline_s": 0.2,
                "link": {"kind": "serial", "port": str(self.serial)},
            },
            "plc": {"port": 0},
            "recipe": {"limits": {"max_height_um": 2000}},
            "cycle": {"retry_first_s": 0.05, "retry_longest_s": 0.2},
        }
        self.write()

    def write(self) -> Path:
        """Put the settings into the file."""
        self.file.write_text(yaml.safe_dump(self.settings))
        return self.file


def simulated_module(station: Station) -> ModuleServer:
    """A simulated module at the station's serial port, to be stopped by whoever asked for it."""
    simulated = SimulatedModule(PROFILES[PROFILE], lambda: 0.0)
    return ModuleServer(simulated, 1, symlink=station.serial).start()


@pytest.fixture
def station(tmp_path: Path) -> Station:
    return Station(tmp_path)


@pytest.fixture
def module(station: Station) -> Iterator[Callable[[], ModuleServer]]:
    """``module()``: a simulated module plugged in at the station's serial port, until it is stopped."""
    with contextlib.ExitStack() as stack:

        def plug_in() -> ModuleServer:
            server = simulated_module(station)
            stack.callback(server.stop)
            return server

        yield plug_in


@pytest.fixture
def service(station: Station, wait_until: Callable[..., Any]) -> Iterator[Callable[..., Service]]:
    """``service(*options, **environment)``: the service at work with the station's settings."""
    with contextlib.ExitStack() as stack:

        def start(*options: str, **environment: str) -> Service:
            started = Service(station.file, wait_until, list(options), **environment)
            stack.callback(started.close)
            return started

        yield start


@pytest.fixture(scope="session")
def kept(tmp_path_factory: pytest.TempPathFactory, wait_until: Callable[..., Any]) -> tuple[Station, dict[int, Any]]:
    """A station that has inspected a while and stopped, with its archive; and registers as they were shown, by
    sequence. One of its three frames is black; its settings were refused for a time."""
    station = Station(tmp_path_factory.mktemp("kept"))
    (station.frames / "C006.png").write_bytes(cv2.imencode(".png", np.zeros((480, 640), np.uint8))[1].tobytes())
    station.settings |= {
        "module": {"profile": PROFILE, "link": {"kind": "simulated"}},
        "archive": {"folder": "archive", "frames": {"min_free_mb": 0}},
        "shifts": {"round the clock": "00:00-00:00"},
    }
    station.settings["recipe"]["name"] = "black gloss"
    station.settings["camera"]["rate_hz"] = 0
    station.write()
    service, shown = Service(station.file, wait_until, []), {}

    def until(condition: Callable[[dict[str, Any]], Any], what: str) -> None:
        def met(registers: dict[str, Any]) -> Any:
            shown[registers["sequence_u32"]] = dict(registers)
            return condition(registers)

        service.until(met, what)

    with contextlib.closing(service):
        until(lambda r: r["sequence"] > 6, "results")
        station.file.write_text("nonsense")
        service.send(signal.SIGHUP)
        until(lambda r: r["status"] & Status.SETTINGS_REFUSED, "settings refused")
        station.write()
        service.send(signal.SIGHUP)
        until(lambda r: not r["status"] & Status.SETTINGS_REFUSED, "settings taken")
        service.send(signal.SIGTERM)
        assert service.ended() == 0
    return station, shown
