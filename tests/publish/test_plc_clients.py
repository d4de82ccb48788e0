"""Bad company and rights, from outside: floods, half-open and dribbling clients, readers that write."""

from __future__ import annotations

import contextlib
import os
import random
import resource
import socket
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from plc_wire import ask, connect, is_closed, receive

from firmware_bridge.wire.modbus import IllegalValue
from inspector.model import PlcSide, Snapshot
from inspector.publish import plc_clients
from inspector.publish.plc_server import PlcServer
from inspector.publish.registers import CONTROL_ADDRESS, CONTROL_WORDS

Wait = Callable[..., Any]
Start = Callable[..., PlcServer]
READ = bytes.fromhex("0001 0000 0006 01 03 0000 0001")
ANSWER = bytes.fromhex("0001 0000 0005 01 03 02 0000")
FUZZ_BYTES = int(os.environ.get("FUZZ_BYTES", "300000"))


def is_served(client: socket.socket) -> bool:
    client.sendall(READ)
    return receive(client, len(ANSWER)) == ANSWER


# Rights.


class Station:
    """Takes every write into the control block and shows it."""

    server: PlcServer

    def __init__(self) -> None:
        self.written: list[tuple[int, Sequence[int]]] = []
        self._words = (0,) * CONTROL_WORDS

    def take(self, address: int, words: Sequence[int]) -> None:
        at = address - CONTROL_ADDRESS
        self.written.append((address, words))
        self._words = (*self._words[:at], *words, *self._words[at + len(words) :])
        self.server.show(Snapshot(plc=PlcSide(control=self._words)))


WRITES = (
    "05 1f40 ff00",
    "06 01f4 0001",
    "0f 1f40 0001 01 01",
    "10 01f4 0001 02 0001",
    "16 01f4 0000 0001",
    "17 0000 0001 01f4 0001 02 0001",
    "08 000a 0000",
)


@pytest.mark.parametrize("write", WRITES)
def test_a_reader_that_writes_is_told_that_it_may_not(start: Start, write: str) -> None:
    station = Station()
    server = station.server = start(on_control=station.take, allow_write=("127.0.0.1",))
    with connect(server, "127.0.0.2") as reader:
        assert ask(reader, f"01 {write}") == f"01 {int(write[:2], 16) | 0x80:02x} 01"
        assert is_served(reader)
    assert not station.written
    assert server.diagnostics.exceptions == {1: 1}


def test_a_writer_writes_the_control_block_and_everybody_reads_it(start: Start) -> None:
    station = Station()
    server = station.server = start(on_control=station.take, allow_write=("127.0.0.1",))
    with connect(server) as writer, connect(server, "127.0.0.2") as reader:
        assert ask(reader, "01 03 01f4 0002") == "01 03 04 00 00 00 00"
        assert ask(writer, "01 10 01f4 0002 04 1234 5678") == "01 10 01 f4 00 02"
        assert ask(reader, "01 03 01f4 0002") == "01 03 04 12 34 56 78"
        assert ask(writer, "01 16 01f5 ff00 0001") == "01 16 01 f5 ff 00 00 01"
        assert ask(reader, "01 04 01f5 0001") == "01 04 02 56 01"
        assert ask(writer, "01 17 01f5 0001 01f5 0001 02 0002") == "01 17 02 00 02"
        assert ask(writer, "01 17 0000 0002 01f6 0001 02 0003") == "01 17 04 00 00 00 01", (
            "one area read, another written"
        )
        assert ask(writer, "01 17 03e8 0001 01f6 0001 02 0004") == "01 17 02 00 00"
        assert ask(writer, "01 17 007c 0002 01f6 0001 02 0005") == "01 97 02", "and nothing written"
        assert ask(reader, "01 03 01f4 0003") == "01 03 06 12 34 00 02 00 04"
    written = [(500, (0x1234, 0x5678)), (501, (0x5601,)), (501, (2,)), (502, (3,)), (502, (4,))]
    assert station.written == written


def test_coils_are_the_control_blocks_bits_and_leave_the_others_as_they_are(start: Start) -> None:
    """Coil 8000 is bit 0 of register 500: functions 1, 2, 5 and 15."""
    station = Station()
    station.server = start(on_control=station.take)
    with connect(station.server) as writer:
        assert ask(writer, "01 10 01f4 0002 04 0004 8001") == "01 10 01 f4 00 02"
        assert ask(writer, "01 05 1f40 ff00") == "01 05 1f 40 ff 00"
        assert ask(writer, "01 03 01f4 0002") == "01 03 04 00 05 80 01"
        assert ask(writer, "01 05 1f42 0000") == "01 05 1f 42 00 00"
        assert ask(writer, "01 0f 1f4c 0008 01 5a") == "01 0f 1f 4c 00 08"
        assert ask(writer, "01 03 01f4 0002") == "01 03 04 a0 01 80 05"
        for function in ("01", "02"):
            assert ask(writer, f"01 {function} 1f40 0020") == f"01 {function} 04 01 a0 05 80"
            assert ask(writer, f"01 {function} 1f4f 0003") == f"01 {function} 01 03"
        before = list(station.written)
        for outside in ("05 1f3f ff00", "05 2040 ff00", "0f 203f 0002 01 03", "0f 1f3f 0002 01 03", "05 0130 ff00"):
            assert ask(writer, f"01 {outside}") == f"01 {int(outside[:2], 16) | 0x80:02x} 02"
    assert station.written == before


@pytest.mark.parametrize("write", ["06 01f3 0001", "06 0204 0001", "10 0203 0002 04 0001 0001", "06 0000 0001"])
def test_only_the_control_block_can_be_written(start: Start, write: str) -> None:
    server = start(on_control=lambda *_: None)
    with connect(server) as writer:
        assert ask(writer, f"01 {write}") == f"01 {int(write[:2], 16) | 0x80:02x} 02"


def test_what_the_station_refuses_is_not_kept(start: Start, caplog: pytest.LogCaptureFixture) -> None:
    def refuse(address: int, words: tuple[int, ...]) -> None:
        if words == (1,):
            raise IllegalValue
        raise ZeroDivisionError

    server = start(on_control=refuse)
    with connect(server) as writer:
        assert ask(writer, "01 06 01f4 0001") == "01 86 03"
        assert ask(writer, "01 06 01f4 0002") == "01 86 04"
        assert ask(writer, "01 03 01f4 0001") == "01 03 02 00 00"
    assert caplog.text.count("write of 1 registers at 500 met a fault") == 1


# Company.


def test_a_client_that_reconnects_each_time_and_never_closes_is_always_served(start: Start) -> None:
    server = start(max_connections=4)
    with ExitStack() as leaked, connect(server, "127.0.0.2") as other:
        for _ in range(40):
            assert is_served(leaked.enter_context(connect(server)))
            assert is_served(other)
    assert server.diagnostics.gave_way == 37


def test_the_plc_finds_a_place_among_a_crowd(start: Start) -> None:
    server = start(max_connections=4)
    with ExitStack() as stack:
        crowd = [stack.enter_context(connect(server, "127.0.0.2")) for _ in range(4)]
        assert all(map(is_served, crowd))
        plc = stack.enter_context(connect(server))
        assert is_served(plc)
        for _ in range(20):
            stack.enter_context(connect(server, "127.0.0.2"))
            assert is_served(plc)


def test_where_each_address_holds_one_place_a_reader_waits_and_a_writer_does_not(start: Start) -> None:
    server = start(max_connections=2, allow_write=("127.0.0.9",))
    with ExitStack() as stack:
        readers = [stack.enter_context(connect(server, f"127.0.0.{n}")) for n in (2, 3)]
        assert all(map(is_served, readers))
        assert is_closed(stack.enter_context(connect(server, "127.0.0.4")))
        assert is_served(stack.enter_context(connect(server, "127.0.0.9")))
    assert server.diagnostics.refused_full == 1


def test_five_hundred_connections_cost_the_plc_nothing(start: Start) -> None:
    server = start()
    with ExitStack() as stack:
        plc = stack.enter_context(connect(server))
        assert is_served(plc)
        for number in range(500):
            crowd = stack.enter_context(connect(server, f"127.0.{number % 7}.2"))
            if number % 2:
                with contextlib.suppress(OSError):
                    crowd.sendall(READ[: number % len(READ)])
            assert is_served(plc)
        assert server.diagnostics.connected <= 16
        assert is_served(stack.enter_context(connect(server)))


def test_half_open_and_dribbling_clients_are_closed_while_others_are_served(start: Start, wait_until: Wait) -> None:
    server = start(idle_timeout_s=0.4, max_connections=64)
    with ExitStack() as stack:
        plc = stack.enter_context(connect(server))
        half_open = [stack.enter_context(connect(server, "127.0.0.2")) for _ in range(20)]
        dribblers = [stack.enter_context(connect(server, "127.0.0.3")) for _ in range(20)]

        def only_the_plc_is_left() -> bool:
            assert is_served(plc)
            for client in dribblers:
                with contextlib.suppress(OSError):
                    client.send(READ[:1])  # protocol id 0000, a length never reached
            return server.diagnostics.connected == 1

        wait_until(only_the_plc_is_left, "who never finishes a request is closed")
        assert all(map(is_closed, half_open))
    assert server.diagnostics.closed_idle + server.diagnostics.out_of_step == 40


def test_no_descriptor_left_is_survived(start: Start, monkeypatch: pytest.MonkeyPatch, wait_until: Wait) -> None:
    """With no descriptor for a newcomer those who are in are served, and the newcomer when there is room again."""
    monkeypatch.setattr(plc_clients, "NO_ROOM_S", 0.05)
    server = start()
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    with connect(server) as plc, socket.socket() as late, ExitStack() as stack:
        late.settimeout(20)
        assert is_served(plc)
        try:
            highest = max(map(int, os.listdir("/proc/self/fd")))
            resource.setrlimit(resource.RLIMIT_NOFILE, (highest + 1, hard))
            with contextlib.suppress(OSError):
                while True:
                    stack.callback(os.close, os.dup(0))
            late.connect(("127.0.0.1", server.port))
            late.sendall(READ)
            for _ in range(20):
                assert is_served(plc)
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
            stack.close()
        assert receive(late, len(ANSWER)) == ANSWER


@pytest.mark.timeout(120 + FUZZ_BYTES / 20_000)
def test_a_fuzzer_costs_the_others_nothing(start: Start) -> None:
    """Noise, damaged requests and sound ones in random pieces; FUZZ_BYTES sets how many. Nothing grows by them."""
    server = start(on_control=lambda *_: None)
    chance, left = random.Random(5), FUZZ_BYTES
    with connect(server) as plc:
        assert is_served(plc)
        half, at_half = left // 2, 0
        while left > 0:
            left -= fuzz_one(server, chance)
            assert is_served(plc)
            if left < half and not at_half:
                at_half = resident_bytes()
    assert resident_bytes() < at_half + 4 * 2**20
    assert server.diagnostics.out_of_step > 1
    assert server.diagnostics.requests > FUZZ_BYTES / 200


def resident_bytes() -> int:
    """Memory of this process, server and clients."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


def fuzz_one(server: PlcServer, chance: random.Random) -> int:
    """One connection full of noise; the bytes it sent."""
    sent = 0
    with contextlib.suppress(OSError), connect(server, "127.0.0.2") as client:
        client.setblocking(False)
        for _ in range(chance.randrange(1, 30)):
            piece = b"".join(fuzzed(chance) for _ in range(chance.randrange(1, 40)))
            with contextlib.suppress(BlockingIOError):
                sent += client.send(piece)
            with contextlib.suppress(BlockingIOError):
                client.recv(1 << 20)
        client.shutdown(socket.SHUT_WR)
        client.settimeout(20)
        while client.recv(1 << 20):  # to the last answer: all that was sent has been looked at
            pass
    return sent


def fuzzed(chance: random.Random) -> bytes:
    """A request: sound in its frame, with any function and data; damaged; or noise."""
    body = bytes((chance.choice((0, 1, 255, 7)), chance.randrange(256))) + chance.randbytes(chance.randrange(12))
    if chance.random() < 0.3:
        body += chance.randbytes(chance.randrange(240))
    frame = bytearray(chance.randbytes(2) + b"\0\0" + len(body).to_bytes(2, "big") + body)
    kind = chance.random()
    if kind < 0.0005:
        frame[chance.randrange(len(frame))] ^= 1 << chance.randrange(8)
    elif kind < 0.001:
        return chance.randbytes(chance.randrange(60))
    return bytes(frame)
