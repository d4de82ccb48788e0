"""The registers over a serial line: masters nobody here wrote, through a pair of pseudo-terminals."""

from __future__ import annotations

import contextlib
import os
import re
import subprocess
import tty
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from firmware_bridge.links.ports import Port, open_serial
from firmware_bridge.wire.modbus_frames import rtu_frame
from inspector.model import PlcSide, Snapshot, Verdict
from inspector.publish import plc_serial
from inspector.publish.plc_server import PlcServer
from inspector.publish.plc_settings import SerialSettings
from inspector.publish.registers import RESULT_WORDS, decode

UNIT = 17
SHOWN = Snapshot(sequence=4711, panel_id=70000, verdict=Verdict.FAIL)
ASK, ANSWER = rtu_frame(UNIT, bytes.fromhex("03 0000 0001")), rtu_frame(UNIT, bytes.fromhex("03 02 1267"))


class Line:
    """A pair of terminals joined by socat: the station's end, by a name that outlives it, and the master's."""

    def __init__(self, socat: str, folder: Path, wait_until: Callable[..., Any]) -> None:
        self._socat, self._folder, self._wait_until, self._number = socat, folder, wait_until, 0
        self.station, self.master = folder / "station", folder / "master"
        self.plug_in()

    def plug_in(self) -> None:
        self._number += 1
        ends = [self._folder / f"{name}-{self._number}" for name in ("station", "master")]
        self._process = subprocess.Popen([self._socat, *(f"pty,raw,echo=0,link={end}" for end in ends)])
        self._wait_until(lambda: all(end.exists() for end in ends), "socat made its pair of terminals")
        for link, end in zip((self.station, self.master), ends, strict=True):
            with contextlib.suppress(FileNotFoundError):
                link.unlink()
            link.symlink_to(os.path.realpath(end))

    def pull(self) -> None:
        self._process.kill()
        self._process.communicate(timeout=30)


@pytest.fixture
def line(peer: Any, tmp_path: Path, wait_until: Any) -> Iterator[Line]:
    pair = Line(peer("socat", "socat"), tmp_path, wait_until)
    yield pair
    pair.pull()


Start = Callable[..., PlcServer]


@pytest.fixture
def start(line: Line, wait_until: Any) -> Iterator[Start]:
    """``start(**serial settings)``: a server on the line's end, showing SHOWN, which takes every write."""
    with contextlib.ExitStack() as stack:

        def run(**serial: Any) -> PlcServer:
            def take(address: int, words: Sequence[int]) -> None:
                server.show(Snapshot(sequence=4711, plc=PlcSide(control=(*[0] * (address - 500), *words))))

            settings = SerialSettings(port=str(line.station), unit=UNIT, **serial)
            server = PlcServer(port=0, stall_after_s=60.0, serial=settings, on_control=take)
            server.start()
            stack.callback(server.stop)
            server.publish(SHOWN)
            wait_until(lambda: server.diagnostics.serial_open, "the line is open")
            return server

        yield run


Poll = Callable[..., list[str]]


@pytest.fixture
def mbpoll(peer: Any, line: Line) -> Poll:
    """``mbpoll(address, *options)``: what mbpoll prints for values; arguments after ``--`` are written."""
    program = peer("mbpoll", "mbpoll")

    def poll(address: int, *options: str, write: Sequence[int] = ()) -> list[str]:
        command = [program, "-m", "rtu", "-a", str(UNIT), "-b", "9600", "-P", "none", "-0", "-r", str(address), "-1"]
        command += [*options, str(line.master), *map(str, write)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=30, check=False)
        return re.findall(r"^\[\d+\]:\s+(\S+)", done.stdout, re.MULTILINE) or [done.stdout + done.stderr]

    return poll


def test_mbpoll_reads_and_writes(start: Start, mbpoll: Poll) -> None:
    start()
    block = [int(word) % 65536 for word in mbpoll(0, "-t", "4", "-c", str(RESULT_WORDS))]
    assert (decode(block)["sequence"], decode(block)["panel_id"]) == (4711, 70000)
    assert mbpoll(0, "-t", "3", "-c", "1") == ["4711"]
    assert "Written 2 references" in mbpoll(500, "-t", "4", write=(1, 77))[0]
    assert mbpoll(500, "-t", "4", "-c", "2") == ["1", "77"]
    assert "Illegal data address" in mbpoll(0, "-t", "4", write=(1, 2))[0]


def test_a_line_may_be_for_reading_only(start: Start, mbpoll: Poll) -> None:
    server = start(allow_write=False)
    assert "Illegal function" in mbpoll(500, "-t", "4", write=(1, 2))[0]
    assert server.diagnostics.exceptions == {1: 1}


@pytest.mark.parametrize("baud", [9600, 115200])
def test_libmodbus_reads_block_after_block(start: Start, line: Line, compiled_peer: Any, baud: int) -> None:
    start(baud=baud)
    command = [compiled_peer("modbus_reader"), str(line.master), str(UNIT), "4", "0", str(RESULT_WORDS), "300"]
    done = subprocess.run(command, capture_output=True, timeout=100, check=False)
    assert done.returncode == 0, done.stderr.decode()
    blocks = np.frombuffer(done.stdout, np.uint16).reshape(300, RESULT_WORDS)
    assert (blocks[:, [0, RESULT_WORDS - 1]] == 4711).all()


class Master:
    """A master that does what it should not."""

    def __init__(self, line: Line) -> None:
        self.fd = os.open(line.master, os.O_RDWR | os.O_NOCTTY)
        tty.setraw(self.fd)

    def receive(self, size: int) -> bytes:
        data = b""
        while len(data) < size:
            data += os.read(self.fd, size - len(data))
        return data


@pytest.fixture
def master(line: Line) -> Iterator[Master]:
    made = Master(line)
    yield made
    os.close(made.fd)


@pytest.mark.parametrize(
    "noise",
    [b"", b"\xff\x00", ASK[:-1], ASK[:3], rtu_frame(9, bytes.fromhex("03 0000 0001")), bytes(300), ASK[:-2] + b"\0\0"],
    ids=["none", "stray bytes", "cut short", "shorter", "another unit's", "a long break", "wrong checksum"],
)
def test_a_request_after_noise_is_answered(start: Start, master: Master, noise: bytes, wait_until: Any) -> None:
    """At once, or, where the noise looks like the beginning of a request, after a pause."""
    server = start()
    os.write(master.fd, noise)
    os.write(master.fd, ASK)
    os.set_blocking(master.fd, False)
    answer = b""

    def answered() -> bool:
        nonlocal answer
        with contextlib.suppress(BlockingIOError):
            answer += os.read(master.fd, 512)
        return answer.endswith(ANSWER)

    wait_until(answered, "the request is answered")
    assert answer == ANSWER
    assert server.diagnostics.requests >= 1


def test_requests_in_a_row_and_in_single_bytes_are_answered_in_order(start: Start, master: Master) -> None:
    start()
    os.write(master.fd, ASK * 3)
    assert master.receive(3 * len(ANSWER)) == ANSWER * 3
    for byte in ASK:
        os.write(master.fd, bytes((byte,)))
    assert master.receive(len(ANSWER)) == ANSWER


def test_a_broadcast_is_carried_out_and_not_answered(start: Start, master: Master) -> None:
    start()
    os.write(master.fd, rtu_frame(0, bytes.fromhex("06 01f4 0001")))
    os.write(master.fd, rtu_frame(UNIT, bytes.fromhex("03 01f4 0001")))
    expected = rtu_frame(UNIT, bytes.fromhex("03 02 0001"))
    assert master.receive(len(expected)) == expected


def test_a_line_that_is_pulled_comes_back(
    start: Start, line: Line, mbpoll: Poll, wait_until: Any, caplog: pytest.LogCaptureFixture
) -> None:
    server = start()
    assert mbpoll(0, "-t", "4", "-c", "1") == ["4711"]
    for _ in range(2):
        line.pull()
        wait_until(lambda: not server.diagnostics.serial_open, "the loss is noticed")
        server.publish(SHOWN)  # nobody waits for the line
        line.plug_in()
        wait_until(lambda: server.diagnostics.serial_open, "the line is open again")
        assert mbpoll(0, "-t", "4", "-c", "1") == ["4711"]
    assert "PLC's serial line" in caplog.text


def test_a_missing_line_is_said_once_and_waited_for(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, wait_until: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    looks: list[str] = []

    def look(*arguments: Any, **options: Any) -> Port:
        looks.append(arguments[1])
        return open_serial(*arguments, **options)

    monkeypatch.setattr(plc_serial, "open_serial", look)
    server = PlcServer(port=0, serial=SerialSettings(port=str(tmp_path / "none")))
    server.start()
    server.publish(SHOWN)
    wait_until(lambda: len(looks) > 2, "it is looked for again and again")
    assert not server.diagnostics.serial_open
    server.stop()
    assert caplog.text.count("No such file or directory") == 1


def test_a_master_that_never_reads_stops_nothing(start: Start, master: Master) -> None:
    server = start()
    os.set_blocking(master.fd, False)
    with contextlib.suppress(BlockingIOError):
        for _ in range(3000):
            os.write(master.fd, ASK)
    server.publish(SHOWN)
    server.stop()
    assert not server.diagnostics.serial_open
