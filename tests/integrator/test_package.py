"""The integrator's package: committed copies are current, and its messages are what a running station says."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from inspector.cli.app import app
from inspector.integrator import byte_examples, package
from inspector.integrator.byte_examples import EXCHANGES, SHOWN, STATISTICS, Exchange
from inspector.model import Snapshot
from inspector.publish.plc_server import PlcServer
from inspector.publish.wire_fields import WordOrder
from inspector.service.control import PlcControl

COMMITTED = Path(__file__).parents[2] / "deploy" / "plc"


@pytest.mark.parametrize("made", package.ALL, ids=lambda made: made.name)
def test_the_committed_file_is_current(made: package.Made) -> None:
    assert (COMMITTED / made.name).read_text() == made.make(), "run: make docs"


def test_the_package_is_these_files_and_no_others(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["plc-package", "--output", str(tmp_path / "plc")])
    assert done.exit_code == 0, done.output
    written = {file.name: file.read_bytes() for file in (tmp_path / "plc").iterdir()}
    assert written == {file.name: file.read_bytes() for file in COMMITTED.iterdir()}


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "plc").write_text("a file")
    done = CliRunner().invoke(app, ["plc-package", "--output", str(tmp_path / "plc")])
    assert (done.exit_code, "plc" in done.stderr) == (1, True)


@pytest.fixture
def station() -> Iterator[Callable[[WordOrder], PlcServer]]:
    """``station(order)``: a server that shows the examples' registers and takes what the PLC writes."""
    started: list[PlcServer] = []

    def start(order: WordOrder) -> PlcServer:
        control = PlcControl(Snapshot(), lambda: None)
        server = PlcServer(port=0, stall_after_s=60.0, word_order=order, on_control=control.write)
        server.start()
        started.append(server)
        now_s = time.monotonic()
        server.publish(replace(SHOWN, result_at_s=now_s, statistics=replace(STATISTICS, at_s=now_s)))
        return server

    yield start
    for server in started:
        server.stop()


@pytest.mark.parametrize("exchange", EXCHANGES, ids=lambda exchange: exchange.title)
def test_a_running_station_answers_to_the_byte(station: Callable[[WordOrder], PlcServer], exchange: Exchange) -> None:
    expected = byte_examples.answer(exchange)
    with socket.create_connection(("127.0.0.1", station(exchange.order).port), timeout=10) as client:
        client.sendall(exchange.request)
        answer = b""
        while len(answer) < len(expected):
            piece = client.recv(1024)
            assert piece, f"closed after {answer.hex(' ')}"
            answer += piece
    moving = byte_examples.moving_bytes(exchange)
    assert len(answer) == len(expected)
    assert [i for i in range(len(answer)) if answer[i] != expected[i] and i not in moving] == []


def test_every_byte_of_a_message_is_explained_once() -> None:
    """But for registers that read 0; what is moved by word order and what is refused is among the examples."""
    page = byte_examples.as_markdown()
    for exchange in EXCHANGES:
        assert page.count(f"## {exchange.title}\n") == 1
        section = page.split(f"## {exchange.title}\n")[1].split("\n## ")[0]
        rows = [line.split(" | ") for line in section.splitlines() if line.startswith(("| request", "| answer"))]
        told = {side: b"".join(bytes.fromhex(r[1].strip("`")) for r in rows if r[0] == f"| {side}") for side in
                ("request", "answer")}  # fmt: skip
        assert told["request"] == exchange.request
        answer = byte_examples.answer(exchange)
        head = 8 if answer[7] & 0x80 else 9
        assert told["answer"][:head] == answer[:head]
        assert told["answer"].replace(b"\0", b"") == answer.replace(b"\0", b"")
    assert page.count("an exception") == 3


def test_word_orders_differ_in_the_order_of_registers_alone() -> None:
    told = {exchange.title: byte_examples.answer(exchange)[9:] for exchange in EXCHANGES}
    floats = bytes.fromhex("44e4 7333")
    assert told["A float32, high word first"] == floats
    assert floats[2:] + floats[:2] in told.values()
    assert bytes.fromhex("0001 1170") in told.values()
    assert bytes.fromhex("1170 0001") in told.values()
