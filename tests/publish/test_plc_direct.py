"""Reads answered in C are those that the core answers, byte for byte; all else comes through untouched."""

from __future__ import annotations

import select
import socket
from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_bridge.wire.modbus import Counters, Slave
from firmware_bridge.wire.modbus_frames import TcpSession
from inspector.publish.plc_direct import Direct, Left
from inspector.publish.plc_registers import ServedRegisters
from inspector.publish.published_image import PublishedImage
from inspector.publish.registers import Image

UNITS = (0, 1, 255)
IMAGE = Image(((0, bytes(range(250))), (500, b"\xab\xcd" * 16), (1000, bytes(range(256)) * 2), (65535, b"\x12\x34")))


class Pair:
    """A client and the server's end of its connection, the latter answered in C."""

    def __init__(self) -> None:
        self.counters = Counters()
        self.published = PublishedImage()
        self.direct = Direct(self.published, UNITS, self.counters)
        self.published.show(IMAGE)
        self.client, self.served = socket.socketpair()
        self.client.setblocking(False)
        self.epoll = select.epoll()
        self.epoll.register(self.served, select.EPOLLIN)
        self.direct.watch(self.served.fileno(), True)

    def wait(self, seconds: float = 0.0) -> tuple[Left, int, bytes]:
        return self.direct.wait(self.epoll.fileno(), seconds)

    def close(self) -> None:
        self.client.close()
        self.served.close()
        self.epoll.close()


@pytest.fixture
def pair() -> Iterator[Pair]:
    made = Pair()
    yield made
    made.close()


def core() -> TcpSession:
    published = PublishedImage()
    published.show(IMAGE)
    return TcpSession(Slave(dict.fromkeys(UNITS, ServedRegisters(published))))


def request(transaction: int, unit: int, function: int, address: int, count: int) -> bytes:
    head = transaction.to_bytes(2, "big") + b"\0\0\0\6" + bytes((unit, function))
    return head + address.to_bytes(2, "big") + count.to_bytes(2, "big")


edges = st.sampled_from((0, 1, 124, 125, 126, 499, 500, 515, 516, 999, 1000, 1255, 1256, 65534, 65535))
requests = st.builds(
    request,
    st.integers(0, 0xFFFF),
    st.sampled_from((*UNITS, 2, 254)),
    st.sampled_from((3, 4, 3, 4, 1, 6, 16, 0x83)),
    edges | st.integers(0, 0xFFFF),
    st.sampled_from((1, 2, 16, 17, 125, 126)) | st.integers(0, 0xFFFF),
)


@given(st.lists(requests | requests | st.binary(min_size=1, max_size=14), min_size=1, max_size=4))
def test_what_is_answered_is_answered_as_the_core_does(asked: list[bytes]) -> None:
    pair, stream = Pair(), b"".join(asked)
    try:
        pair.client.send(stream)
        left, descriptor, data = pair.wait()
        if left is Left.NOTHING:
            assert pair.client.recv(65536) == core().receive(stream)
            assert pair.counters.requests == len(stream) // 12
        else:
            assert (left, descriptor, data) == (Left.RECEIVED, pair.served.fileno(), stream)
            with pytest.raises(BlockingIOError):
                pair.client.recv(1)
    finally:
        pair.close()


def test_whole_reads_are_answered_there(pair: Pair) -> None:
    """All that were received together, of every unit and area, to the last register."""
    reads = [(0, 125), (0, 1), (124, 1), (500, 16), (1000, 125), (1255, 1), (65535, 1)]
    stream = b"".join(request(n, unit, fc, *r) for n, r in enumerate(reads) for unit in UNITS for fc in (3, 4))
    pair.client.send(stream)
    assert pair.wait()[0] is Left.NOTHING
    assert pair.client.recv(1 << 16) == core().receive(stream)
    assert pair.direct.take_activity(pair.served.fileno())[0] == len(reads) * 6
    assert pair.direct.take_activity(pair.served.fileno())[0] == 0


def test_the_end_of_a_connection_comes_through(pair: Pair) -> None:
    pair.client.close()
    assert pair.wait() == (Left.RECEIVED, pair.served.fileno(), b"")


def test_a_connection_that_is_not_direct_is_left_alone(pair: Pair) -> None:
    pair.direct.watch(pair.served.fileno(), False)
    pair.client.send(request(1, 1, 3, 0, 1))
    assert pair.wait() == (Left.READY, pair.served.fileno(), b"")
    assert pair.served.recv(100) == request(1, 1, 3, 0, 1)


def test_answers_that_are_not_taken_come_through_to_the_last_byte(pair: Pair) -> None:
    asked, session, expected, received = request(7, 1, 4, 0, 125) * 300, core(), b"", b""
    for _ in range(100):
        pair.client.send(asked)
        expected += session.receive(asked)
        left, _, rest = pair.wait()
        if left is Left.UNSENT:
            break
        assert left is Left.NOTHING
    assert left is Left.UNSENT
    while len(received) + len(rest) < len(expected):
        received += pair.client.recv(1 << 20)
    assert received + rest == expected


def test_nobodys_turn_is_lost(pair: Pair) -> None:
    """Of several that came together each is attended to, though one after the other comes to the caller."""
    others = [socket.socketpair() for _ in range(5)]
    for _, served in others:
        pair.epoll.register(served, select.EPOLLIN)
    for client, _ in [*others, (pair.client, None)]:
        client.send(request(1, 1, 3, 0, 1))
    ready = {pair.wait()[1] for _ in range(6)}
    assert ready >= {served.fileno() for _, served in others}
    assert pair.client.recv(100) == core().receive(request(1, 1, 3, 0, 1))
    for ends in others:
        for end in ends:
            end.close()


def test_more_registers_than_there_is_room_for_are_refused(pair: Pair) -> None:
    with pytest.raises(ValueError, match="2 areas of registers are more"):
        pair.published.show(Image(((0, bytes(16384)), (9000, bytes(2)))))
    pair.client.send(request(1, 1, 3, 0, 1))
    pair.wait()
    assert pair.client.recv(100).endswith(b"\x02\x00\x01")
