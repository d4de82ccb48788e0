"""The slave's answers, byte for byte, against the worked examples of the specification and its rules for refusals."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_bridge.wire.modbus import (
    MAX_PDU_BYTES,
    DeviceBusy,
    IllegalAddress,
    Slave,
    Table,
    pack_bits,
    unpack_bits,
)

UNIT = 17
SIZE = 200


class Memory:
    """200 coils and 200 registers; discrete inputs and input registers show the same."""

    def __init__(self) -> None:
        self.registers = bytearray(b"".join(i.to_bytes(2, "big") for i in range(SIZE)))
        self.bits = [False] * SIZE

    def _check(self, address: int, count: int) -> None:
        if address + count > SIZE:
            raise IllegalAddress

    def read_registers(self, table: Table, address: int, count: int) -> bytes:
        self._check(address, count)
        return bytes(self.registers[2 * address : 2 * (address + count)])

    def write_registers(self, address: int, data: bytes) -> None:
        self._check(address, len(data) // 2)
        self.registers[2 * address : 2 * address + len(data)] = data

    def read_bits(self, table: Table, address: int, count: int) -> Sequence[bool]:
        self._check(address, count)
        return self.bits[address : address + count]

    def write_bits(self, address: int, bits: Sequence[bool]) -> None:
        self._check(address, len(bits))
        self.bits[address : address + len(bits)] = bits


IDENTITY = {0: "Maker", 1: "Code", 2: "1.0"}


@pytest.fixture
def memory() -> Memory:
    return Memory()


@pytest.fixture
def slave(memory: Memory) -> Slave:
    return Slave({UNIT: memory}, IDENTITY)


def ask(slave: Slave, request: str) -> str:
    return slave.answer(UNIT, bytes.fromhex(request)).hex(" ")


@pytest.mark.parametrize(
    ("request_pdu", "answer"),
    [
        ("03 0005 0002", "03 04 00 05 00 06"),
        ("04 0008 0001", "04 02 00 08"),
        ("05 00ac ff00", "05 00 ac ff 00"),
        ("05 00ac 0000", "05 00 ac 00 00"),
        ("06 0001 0003", "06 00 01 00 03"),
        ("0f 0013 000a 02 cd01", "0f 00 13 00 0a"),
        ("10 0001 0002 04 000a 0102", "10 00 01 00 02"),
        ("16 0004 00f2 0025", "16 00 04 00 f2 00 25"),
        ("17 0003 0002 000e 0001 02 00ff", "17 04 00 03 00 04"),
        ("2b 0e 01 00", "2b 0e 01 81 00 00 03 00 05 4d 61 6b 65 72 01 04 43 6f 64 65 02 03 31 2e 30"),
        ("2b 0e 04 01", "2b 0e 04 81 00 00 01 01 04 43 6f 64 65"),
    ],
)
def test_requests_are_answered(slave: Slave, request_pdu: str, answer: str) -> None:
    assert ask(slave, request_pdu) == answer


def test_what_is_written_is_read(slave: Slave, memory: Memory) -> None:
    ask(slave, "0f 0013 000a 02 cd01")
    assert ask(slave, "01 0013 000a") == "01 02 cd 01"
    assert ask(slave, "02 0014 0003") == "02 01 06"
    ask(slave, "06 0004 0012")
    ask(slave, "16 0004 00f2 0025")
    assert ask(slave, "03 0004 0001") == "03 02 00 17"  # the specification's example of a mask write
    assert ask(slave, "17 0004 0001 0004 0001 02 beef") == "17 02 be ef"  # written before it is read
    ask(slave, "05 0000 ff00")
    assert memory.bits[0] is True


@pytest.mark.parametrize(
    ("request_pdu", "answer"),
    [
        ("07", "87 01"),
        ("55 0000", "d5 01"),
        ("00", "80 01"),
        ("83 0000", "83 01"),
        ("2b 0d 00", "ab 01"),
        ("2b", "ab 01"),
        ("2b 0e 05 00", "ab 03"),
        ("2b 0e 04 09", "ab 02"),
        ("01 0000 0000", "81 03"),
        ("01 0000 07d1", "81 03"),
        ("01 0000 00c9", "81 02"),
        ("03 0000 0000", "83 03"),
        ("03 0000 007e", "83 03"),
        ("03 00c8 0001", "83 02"),
        ("03 ffff 0002", "83 02"),
        ("03 ffff 007e", "83 03"),
        ("03 0000", "83 03"),
        ("03 0000 0001 00", "83 03"),
        ("05 0000 0001", "85 03"),
        ("05 00c8 ff00", "85 02"),
        ("06 00c8 0000", "86 02"),
        ("0f 0000 0000 00", "8f 03"),
        ("0f 0000 0009 01 ff", "8f 03"),
        ("0f 0000 0008 02 ff", "8f 03"),
        ("10 0000 0000 00", "90 03"),
        ("10 0000 0002 02 0001", "90 03"),
        ("10 00c7 0002 04 0001 0002", "90 02"),
        ("16 0000 00", "96 03"),
        ("17 0000 007e 0000 0001 02 0000", "97 03"),
        ("17 0000 0001 0000 0000 00", "97 03"),
        ("17 0000 0001 00c8 0001 02 0000", "97 02"),
    ],
)
def test_refusals_name_the_function_and_the_reason(slave: Slave, request_pdu: str, answer: str) -> None:
    assert ask(slave, request_pdu) == answer


def test_a_refused_read_write_has_written_nothing(slave: Slave, memory: Memory) -> None:
    before = bytes(memory.registers)
    assert ask(slave, "17 00c8 0001 0000 0001 02 beef") == "97 02"
    assert memory.registers == before


def test_other_units_are_not_here(slave: Slave) -> None:
    assert slave.answer(UNIT + 1, bytes.fromhex("03 0000 0001")).hex(" ") == "83 0b"


def test_any_error_of_the_model_is_answered_with_its_code() -> None:
    class Busy(Memory):
        def read_registers(self, table: Table, address: int, count: int) -> bytes:
            raise DeviceBusy

    assert ask(Slave({UNIT: Busy()}), "03 0000 0001") == "83 06"


@pytest.mark.parametrize("request_pdu", ["05 0000 ff00", "06 0000 0001", "0f 0000 0001 01 01", "10 0000 0001 02 0001"])
def test_who_may_not_write_is_told_that_the_function_is_not_his(slave: Slave, memory: Memory, request_pdu: str) -> None:
    before = bytes(memory.registers), list(memory.bits)
    request = bytes.fromhex(request_pdu)
    assert slave.answer(UNIT, request, may_write=False) == bytes((request[0] | 0x80, 1))
    slave.broadcast(request, may_write=False)
    assert (memory.registers, memory.bits) == before
    assert slave.answer(UNIT, bytes.fromhex("03 0000 0001"), may_write=False).hex() == "03020000"


@pytest.mark.parametrize(
    ("request_pdu", "answer"),
    [
        ("08 0000 a537", "08 00 00 a5 37"),
        ("08 0000 a537 1234", "08 00 00 a5 37 12 34"),
        ("08 0002 0000", "08 00 02 00 00"),
        ("08 000b 0000", "08 00 0b 00 06"),
        ("08 000c 0000", "08 00 0c 00 00"),
        ("08 000d 0000", "08 00 0d 00 02"),
        ("08 000e 0000", "08 00 0e 00 05"),
        ("08 000f 0000", "08 00 0f 00 01"),
        ("08 0010 0000", "08 00 10 00 00"),
        ("08 0011 0000", "08 00 11 00 01"),
        ("08 0012 0000", "08 00 12 00 00"),
        ("08", "88 03"),
        ("08 00", "88 03"),
        ("08 0000", "88 03"),
        ("08 0000 a5", "88 03"),
        ("08 0001 0000", "88 01"),
        ("08 0003 0a00", "88 01"),
        ("08 0004 0000", "88 01"),
        ("08 0013 0000", "88 01"),
        ("08 000b 0001", "88 03"),
        ("08 000b 0000 00", "88 03"),
    ],
)
def test_diagnostics(request_pdu: str, answer: str) -> None:
    class BusyAt9(Memory):
        def read_registers(self, table: Table, address: int, count: int) -> bytes:
            if address == 9:
                raise DeviceBusy
            return super().read_registers(table, address, count)

    slave = Slave({UNIT: BusyAt9()})
    ask(slave, "03 0000 0001")
    ask(slave, "03 0000 0000")
    ask(slave, "03 0009 0001")
    slave.broadcast(bytes.fromhex("06 0001 0001"))
    slave.counters.overheard += 1
    assert ask(slave, request_pdu) == answer


def test_counters_are_cleared_by_who_may_write(slave: Slave) -> None:
    for _ in range(3):
        ask(slave, "55")
    assert slave.answer(UNIT, bytes.fromhex("08 000a 0000"), may_write=False).hex() == "8801"
    assert ask(slave, "08 000d 0000") == "08 00 0d 00 04"
    assert ask(slave, "08 000a 0000") == "08 00 0a 00 00"
    assert ask(slave, "08 000d 0000") == "08 00 0d 00 00"
    assert ask(slave, "08 000e 0000") == "08 00 0e 00 02"


def test_counters_wrap_at_16_bits_on_the_wire(slave: Slave) -> None:
    slave.counters.requests = 0x1FFFF
    assert ask(slave, "08 000e 0000") == "08 00 0e 00 00"


def test_an_identity_that_no_answer_holds_is_refused() -> None:
    assert ask(Slave({UNIT: Memory()}, {0: "x" * 244}), "2b 0e 01 00").startswith("2b 0e 01 81 00 00 01 00 f4 78")
    with pytest.raises(ValueError, match="at most 244"):
        Slave({UNIT: Memory()}, {0: "x" * 245})


def test_a_level_above_its_own_is_answered_with_what_there_is(slave: Slave) -> None:
    assert ask(slave, "2b 0e 03 00")[:20] == "2b 0e 03 81 00 00 03"
    assert ask(slave, "2b 0e 02 07")[:20] == "2b 0e 02 81 00 00 03"
    regular = Slave({UNIT: Memory()}, IDENTITY | {4: "Name"})
    assert ask(regular, "2b 0e 02 04") == "2b 0e 02 82 00 00 01 04 04 4e 61 6d 65"
    assert ask(regular, "2b 0e 01 00")[:20] == "2b 0e 01 82 00 00 03"


def test_without_identity_the_function_is_unknown(memory: Memory) -> None:
    assert ask(Slave({UNIT: memory}), "2b 0e 01 00") == "ab 01"


def test_long_identities_come_in_parts() -> None:
    slave = Slave({UNIT: Memory()}, {i: f"{i}" * 60 for i in range(7)})
    seen, ask_for = [], 0
    while True:
        answer = slave.answer(UNIT, bytes((0x2B, 0x0E, 2, ask_for)))
        assert len(answer) <= MAX_PDU_BYTES
        position = 7
        for _ in range(answer[6]):
            seen.append(answer[position])
            position += 2 + answer[position + 1]
        assert position == len(answer)
        if not answer[4]:
            break
        ask_for = answer[5]
    assert seen == list(range(7))


@given(st.binary(min_size=1, max_size=300))
def test_whatever_is_asked_the_answer_is_whole_or_an_exception(request_pdu: bytes) -> None:
    answer = Slave({UNIT: Memory()}, IDENTITY).answer(UNIT, request_pdu)
    function = request_pdu[0]
    refused = len(answer) == 2 and answer[0] == function | 0x80 and answer[1] in (1, 2, 3)
    assert refused or (answer[0] == function and 2 < len(answer) <= MAX_PDU_BYTES)


@given(st.sampled_from((1, 2, 3, 4)), st.integers(0, 0xFFFF), st.integers(0, 0xFFFF))
def test_reads_are_never_short(function: int, address: int, count: int) -> None:
    slave = Slave({UNIT: Memory()})
    answer = slave.answer(UNIT, bytes((function,)) + address.to_bytes(2, "big") + count.to_bytes(2, "big"))
    if answer[0] == function:
        assert len(answer) == 2 + answer[1] == 2 + ((count + 7) // 8 if function < 3 else 2 * count)
    else:
        most = 2000 if function < 3 else 125
        assert answer[1] == (2 if 1 <= count <= most else 3)


@given(st.lists(st.booleans(), min_size=1, max_size=2000))
def test_bits_survive_packing(bits: list[bool]) -> None:
    assert unpack_bits(pack_bits(bits), len(bits)) == bits
