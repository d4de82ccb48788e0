"""Modbus out of byte streams: in pieces, in a row, among garbage and among other units' traffic."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_bridge.wire.modbus import DataModel, IllegalAddress, Slave, Table
from firmware_bridge.wire.modbus_frames import RtuSession, TcpSession, crc16, rtu_frame

UNIT = 5
READ = bytes.fromhex("03 0001 0002")
ANSWER = bytes.fromhex("03 04 0001 0002")


class Counting:
    """Registers that hold their own address, and a log of what was written."""

    def __init__(self) -> None:
        self.written: list[tuple[int, bytes]] = []

    def read_registers(self, table: Table, address: int, count: int) -> bytes:
        return b"".join(i.to_bytes(2, "big") for i in range(address, address + count))

    def write_registers(self, address: int, data: bytes) -> None:
        self.written.append((address, data))

    def read_bits(self, table: Table, address: int, count: int) -> Sequence[bool]:
        raise IllegalAddress

    def write_bits(self, address: int, bits: Sequence[bool]) -> None:
        raise IllegalAddress


def tcp(transaction: int, pdu: bytes, unit: int = UNIT) -> bytes:
    return transaction.to_bytes(2, "big") + b"\0\0" + (len(pdu) + 1).to_bytes(2, "big") + bytes((unit,)) + pdu


def session(model: DataModel | None = None) -> RtuSession:
    return RtuSession(Slave({UNIT: model or Counting()}))


def in_pieces(data: bytes, cuts: list[int]) -> list[bytes]:
    edges = [0, *sorted(cut % (len(data) + 1) for cut in cuts), len(data)]
    return [data[a:b] for a, b in itertools.pairwise(edges)]


def test_tcp_answers_a_row_of_requests_in_order() -> None:
    requests = b"".join(tcp(i, READ) for i in range(300))
    assert TcpSession(Slave({UNIT: Counting()})).receive(requests) == b"".join(tcp(i, ANSWER) for i in range(300))


@given(st.lists(st.integers(0, 10**4)))
def test_tcp_does_not_mind_how_the_stream_is_cut(cuts: list[int]) -> None:
    requests = tcp(1, READ) + tcp(2, b"\x55") + tcp(3, READ, unit=99) + tcp(4, READ)
    stream = TcpSession(Slave({UNIT: Counting()}))
    answers = b"".join(stream.receive(piece) for piece in in_pieces(requests, cuts))
    assert answers == tcp(1, ANSWER) + tcp(2, b"\xd5\x01") + tcp(3, b"\x83\x0b", unit=99) + tcp(4, ANSWER)


@pytest.mark.parametrize(
    "garbage",
    [
        "0001 0001 0006 05 03 0001 0002",
        "0001 0000 0000 05",
        "0001 0000 0001 05",
        "0001 0000 00ff 05",
        "0001 0000 ffff 05",
        b"GET / HTTP/1.1\r\n\r\n".hex(),
    ],
)
def test_tcp_gives_up_a_stream_that_is_not_modbus(garbage: str) -> None:
    stream = TcpSession(Slave({UNIT: Counting()}))
    assert stream.receive(tcp(1, READ) + bytes.fromhex(garbage)) == tcp(1, ANSWER)
    assert stream.broken
    assert stream.receive(tcp(2, READ)) == b""


@given(st.lists(st.binary(max_size=40)))
def test_tcp_survives_anything(pieces: list[bytes]) -> None:
    stream = TcpSession(Slave({UNIT: Counting()}))
    for piece in pieces:
        stream.receive(piece)


def test_crc_is_the_published_one() -> None:
    assert crc16(b"123456789") == 0x4B37  # CRC-16/MODBUS, check value of the CRC catalogue
    assert rtu_frame(1, bytes.fromhex("03 0000 000a")).hex(" ") == "01 03 00 00 00 0a c5 cd"


@given(st.lists(st.integers(0, 10**4)))
def test_rtu_does_not_mind_how_the_stream_is_cut(cuts: list[int]) -> None:
    write = bytes.fromhex("10 0001 0002 04 000a 0102")
    line = session()
    answers = [line.receive(p) for p in in_pieces(rtu_frame(UNIT, READ) + rtu_frame(UNIT, write), cuts)]
    assert b"".join(answers) == rtu_frame(UNIT, ANSWER) + rtu_frame(UNIT, write[:5])


@pytest.mark.parametrize(
    "foreign",
    [
        "03 0001 0002",
        "03 04 0001 0002",
        "83 02",
        "01 01 05",
        "10 0001 0002 04 000a 0102",
        "10 0001 0002",
        "06 0001 0002",
        "16 0004 00f2 0025",
        "17 0003 0001 000e 0001 02 00ff",
        "17 02 00ff",
    ],
)
def test_rtu_passes_over_what_others_say(foreign: str) -> None:
    model = Counting()
    line = session(model)
    told = [line.receive(bytes((byte,))) for byte in rtu_frame(UNIT + 1, bytes.fromhex(foreign))]
    assert b"".join(told) == b""
    assert line.receive(rtu_frame(UNIT, READ)) == rtu_frame(UNIT, ANSWER)
    assert model.written == []


def test_rtu_broadcast_is_done_and_not_answered() -> None:
    model = Counting()
    assert session(model).receive(rtu_frame(0, bytes.fromhex("06 0007 1234"))) == b""
    assert model.written == [(7, b"\x12\x34")]


def test_rtu_refuses_an_unknown_function_of_unknown_length() -> None:
    assert session().receive(rtu_frame(UNIT, bytes.fromhex("55 010203"))) == rtu_frame(UNIT, b"\xd5\x01")


def test_rtu_does_not_answer_a_damaged_request() -> None:
    request = bytearray(rtu_frame(UNIT, READ))
    request[3] ^= 4
    line = session()
    assert line.receive(bytes(request)) + line.silence() == b""
    assert line.receive(rtu_frame(UNIT, READ)) == rtu_frame(UNIT, ANSWER)


@given(st.binary(max_size=600))
def test_rtu_finds_the_request_after_garbage_and_a_pause(garbage: bytes) -> None:
    line = session()
    line.receive(garbage)
    line.silence()
    assert line.receive(rtu_frame(UNIT, READ)) == rtu_frame(UNIT, ANSWER)


@given(st.binary(max_size=20))
def test_rtu_finds_requests_after_garbage_without_a_pause(garbage: bytes) -> None:
    line = session()
    requests = rtu_frame(UNIT, READ) * 40
    assert rtu_frame(UNIT, ANSWER) in line.receive(garbage + requests) + line.silence()


def test_a_serial_line_counts_what_it_hears() -> None:
    slave = Slave({UNIT: Counting()})
    line = RtuSession(slave, may_write=False)
    line.receive(rtu_frame(9, READ) + b"\xff" * 5 + rtu_frame(UNIT, READ) + rtu_frame(0, bytes.fromhex("06 0001 0001")))
    assert line.receive(rtu_frame(UNIT, bytes.fromhex("06 0001 0001"))) == rtu_frame(UNIT, b"\x86\x01")
    counters = slave.counters
    assert (counters.requests, counters.overheard, counters.unanswered) == (3, 1, 1)
    assert counters.errors >= 1
    assert counters.exceptions == {1: 1}
    assert not line.unfinished
