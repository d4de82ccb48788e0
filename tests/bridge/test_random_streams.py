"""Wire parsers fed byte by byte with random streams: garbage, damaged and foreign frames before, between and after.

None crashes, none answers what was not asked, and the next good frame is understood.

RANDOM_STREAMS sets how many streams each parser gets (a hundred thousand take minutes).
"""

from __future__ import annotations

import contextlib
import os
import random
from collections.abc import Iterator, Sequence

import pytest
from memory_line import Clock

from firmware_bridge.errors import BridgeError
from firmware_bridge.links.modbus_master import ModbusMaster
from firmware_bridge.wire.modbus import Slave, Table
from firmware_bridge.wire.modbus_frames import MAX_RTU_BYTES, RtuSession, TcpSession, crc16, rtu_answer, rtu_frame

STREAMS = int(os.environ.get("RANDOM_STREAMS", "1500"))
UNIT, DEADLINE_S, BYTE_S = 3, 0.5, 0.001
READ, ANSWER = bytes.fromhex("03 0001 0002"), bytes.fromhex("03 04 0001 0002")
GOOD_ANSWER = rtu_frame(UNIT, ANSWER)

pytestmark = pytest.mark.timeout(4 * 3600 if STREAMS > 10_000 else 120)


class Constant:
    """Registers and bits that hold their address; every write is taken."""

    def read_registers(self, table: Table, address: int, count: int) -> bytes:
        return b"".join((address + n & 0xFFFF).to_bytes(2, "big") for n in range(count))

    def read_bits(self, table: Table, address: int, count: int) -> Sequence[bool]:
        return [True] * count

    def write_registers(self, address: int, data: bytes) -> None: ...

    def write_bits(self, address: int, bits: Sequence[bool]) -> None: ...


def streams(seed: int) -> Iterator[tuple[random.Random, bytes]]:
    """Random streams of up to six pieces, and the generator they come from."""
    for number in range(STREAMS):
        chance = random.Random(f"{seed}/{number}")
        yield chance, b"".join(_piece(chance) for _ in range(chance.randrange(6)))


def _piece(chance: random.Random) -> bytes:
    unit, body = (
        chance.choice((UNIT, UNIT, 0, 9, 255)),
        chance.choice((READ, ANSWER, chance.randbytes(chance.randrange(1, 12)))),
    )
    whole = rtu_frame(unit, body)
    match chance.randrange(5):
        case 0:
            return chance.randbytes(chance.randrange(24))
        case 1:
            return whole[: chance.randrange(len(whole))]
        case 2:
            at = chance.randrange(len(whole))
            return whole[:at] + bytes((whole[at] ^ 1 << chance.randrange(8),)) + whole[at + 1 :]
        case 3:
            length = len(body) + 1
            return bytes((0, chance.randrange(256), 0, 0, 0, length, unit)) + body
        case _:
            return whole


def test_a_slave_on_a_serial_line() -> None:
    for _, stream in streams(1):
        line = RtuSession(Slave({UNIT: Constant()}))
        for byte in stream:
            answer = line.receive(bytes((byte,)))
            assert not answer or answer[0] == UNIT
        line.silence()
        assert b"".join(line.receive(bytes((byte,))) for byte in rtu_frame(UNIT, READ)) == GOOD_ANSWER


def test_a_slave_on_a_connection() -> None:
    request = bytes.fromhex("0007 0000 0006") + bytes((UNIT,)) + READ
    for _, stream in streams(2):
        connection = TcpSession(Slave({UNIT: Constant()}))
        for byte in stream:
            connection.receive(bytes((byte,)))
        fresh = TcpSession(Slave({UNIT: Constant()}))
        answer = b"".join(fresh.receive(bytes((byte,))) for byte in request)
        assert answer == bytes.fromhex("0007 0000 0007") + bytes((UNIT,)) + ANSWER


def test_a_masters_search_for_its_answer() -> None:
    for _, noise in streams(3):
        stream, found = b"", b""
        for byte in noise + GOOD_ANSWER:
            stream += bytes((byte,))
            found = rtu_answer(stream[-MAX_RTU_BYTES:], UNIT, 3)
            if found:
                break
        assert found
        assert (found[0], found[1] & 0x7F, crc16(found)) == (UNIT, 3, 0)


class Dripping:
    """A port from which a stream comes byte by byte once something was asked, while the clock runs."""

    name = "dripping"

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self.stream = b""
        self._left = b""

    def read(self, timeout_s: float) -> bytes:
        if timeout_s <= 0 or not self._left:
            self._clock.now_s += max(timeout_s, 0.0)
            return b""
        self._clock.now_s += BYTE_S
        data, self._left = self._left[:1], self._left[1:]
        return data

    def write(self, data: bytes, timeout_s: float) -> None:
        self._left = self.stream

    def settle(self) -> None:
        self._left = b""

    def discard(self, for_s: float) -> None:
        self._clock.now_s += max(for_s, 0.0)

    def close(self) -> None: ...


@pytest.mark.parametrize("rtu", [True, False], ids=["rtu", "tcp"])
def test_a_master_and_its_deadline(rtu: bool) -> None:
    clock = Clock()
    port = Dripping(clock)
    master = ModbusMaster("module", UNIT, lambda: port, rtu=rtu, deadline_s=DEADLINE_S, clock=clock)
    for chance, stream in streams(4 + rtu):
        port.stream = stream + chance.choice((b"", GOOD_ANSWER))
        master.open()
        started_s = clock()
        with contextlib.suppress(BridgeError):  # which one is the business of the master's own tests
            assert len(master.read(Table.HOLDING_REGISTERS, 1, 2)) == 2
        assert clock() - started_s <= DEADLINE_S + BYTE_S
        if rtu:
            port.stream = GOOD_ANSWER
            assert master.read(Table.HOLDING_REGISTERS, 1, 2) == [1, 2]
