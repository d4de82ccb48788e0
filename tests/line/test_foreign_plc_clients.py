"""What clients nobody here wrote read from the PLC server: the published values, whole, at full speed."""

from __future__ import annotations

import itertools
import re
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from flat_out import FlatOut, derived

from inspector.handshake_table import Answer
from inspector.model import Defect, Flag, PlcSide, Reason, Snapshot, State, Verdict
from inspector.publish.plc_server import PlcServer
from inspector.publish.registers import RESULT_WORDS, decode, encode

RESULT = Snapshot(
    state=State.CONTINUOUS_EXECUTION,
    sequence=4711,
    acquisition_id=0xA5A51234,
    panel_id=70000,
    verdict=Verdict.FAIL,
    reasons=Reason.HEIGHT_LIMIT | Reason.FRAME_OVERLIT,
    defects=(
        Defect(12.34, -56.78, 1827.6, 9.0, (0.0, 0.0), (0.0, 0.0), Flag.MERGED),
        Defect(-3.0, 4.0, 642.2, None, (0.0, 0.0), (0.0, 0.0)),
    ),
    unpaired_count=2,
    lamp_set_v=3.75,
    lamp_read_v=3.748,
    exposure_us=2500,
    configuration_hash=0xCAFE0001,
)
WHOLE_READS = 10_000


@pytest.fixture
def server() -> Iterator[PlcServer]:
    plc = PlcServer(port=0, stall_after_s=120.0)
    plc.start()
    yield plc
    plc.stop()


Reader = Callable[..., npt.NDArray[np.uint16]]


@pytest.fixture
def read_in_c(compiled_peer: Callable[[str], str], server: PlcServer) -> Reader:
    """``read_in_c(address, count, reads=1, function=4)``: (reads, count) registers read by a program on libmodbus."""
    program = compiled_peer("modbus_reader")

    def read(address: int, count: int, reads: int = 1, function: int = 4) -> npt.NDArray[np.uint16]:
        numbers = (server.port, function, address, count, reads)
        command = [program, "127.0.0.1", *map(str, numbers)]
        done = subprocess.run(command, capture_output=True, timeout=100, check=False)
        assert done.returncode == 0, done.stderr.decode()
        return np.frombuffer(done.stdout, np.uint16).reshape(reads, count)

    return read


@pytest.fixture
def mbpoll(peer: Callable[[str, str], str], server: PlcServer) -> Callable[..., list[str]]:
    """``mbpoll(address, *options)``: the values that mbpoll prints."""
    program = peer("mbpoll", "mbpoll")

    def poll(address: int, *options: str) -> list[str]:
        command = [program, "-m", "tcp", "-p", str(server.port), "-0", "-r", str(address), "-1", *options, "127.0.0.1"]
        done = subprocess.run(command, capture_output=True, text=True, timeout=30, check=True)
        return re.findall(r"^\[\d+\]:\s+(\S+)", done.stdout, re.MULTILINE)

    return poll


def same_but_for_time(read: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in read.items() if name not in ("heartbeat", "result_age_ms")}


@pytest.mark.parametrize("function", [3, 4])
def test_libmodbus_reads_what_was_published(server: PlcServer, read_in_c: Reader, function: int) -> None:
    server.publish(RESULT)
    (block,) = read_in_c(0, RESULT_WORDS, function=function)
    expected = np.frombuffer(encode(RESULT, 0.0, 0), ">u2")
    assert same_but_for_time(decode(block.tolist())) == same_but_for_time(decode(expected.tolist()))


@pytest.mark.parametrize("table", ["3", "4"])
def test_mbpoll_reads_what_was_published(server: PlcServer, mbpoll: Callable[..., list[str]], table: str) -> None:
    server.publish(RESULT)
    block = [int(word) % 65536 for word in mbpoll(0, "-t", table, "-c", str(RESULT_WORDS))]
    read = decode(block)
    assert (read["sequence"], read["verdict"], read["defect_count"]) == (4711, Verdict.FAIL, 2)
    assert [read[f"defect_{i}_height_um"] for i in (1, 2)] == [1828, 642]
    assert mbpoll(12, "-t", f"{table}:float", "-B") == ["1827.6"]
    assert mbpoll(16, "-t", f"{table}:int", "-B") == ["70000"]


@pytest.mark.parametrize("table", ["0", "1"])
def test_mbpoll_reads_single_bits(server: PlcServer, mbpoll: Callable[..., list[str]], table: str) -> None:
    server.publish(replace(RESULT, plc=PlcSide(int(Answer.ONLINE | Answer.TRIGGER_ACK), 0, 0, 0)))
    assert mbpoll(304, "-t", table, "-c", "4") == ["1", "0", "1", "0"]


def test_pymodbus_reads_what_was_published(server: PlcServer) -> None:
    from pymodbus.client import ModbusTcpClient

    server.publish(RESULT)
    client = ModbusTcpClient("127.0.0.1", port=server.port)
    try:
        assert client.connect()
        block = client.read_input_registers(0, count=RESULT_WORDS).registers
        listed = client.read_holding_registers(1000, count=20).registers
        bits = [client.read_coils(16 * 6, count=3).bits[:3], client.read_discrete_inputs(16 * 6, count=3).bits[:3]]
        identity = [client.read_device_information(read_code=level).information for level in (1, 2, 3)]
        alone = client.read_device_information(read_code=4, object_id=2).information
        refused = client.read_holding_registers(RESULT_WORDS, count=1)
        written = client.write_register(0, 1)
    finally:
        client.close()
    assert decode(block)["panel_id"] == 70000
    assert decode(listed, 1000)["list_defect_2_height_um"] == 642
    assert (refused.exception_code, written.exception_code) == (2, 2)
    assert bits == [[False, True, False]] * 2, "verdict FAIL"
    assert [sorted(told) for told in identity] == [[0, 1, 2], [0, 1, 2, 4, 5], [0, 1, 2, 4, 5]]
    assert (identity[0][0], identity[1][5], alone) == (b"seed-inspector", b"register map 1", {2: identity[0][2]})


@pytest.mark.usefixtures("threads_alternate")
def test_not_one_read_is_torn_while_results_come_flat_out(server: PlcServer, read_in_c: Reader) -> None:
    snapshots = itertools.cycle([derived(n) for n in range(1, 2000)])
    with FlatOut(server.publish, snapshots) as publisher:
        blocks = read_in_c(0, RESULT_WORDS, WHOLE_READS)
    telling = np.flatnonzero(np.frombuffer(encode(derived(12345), 0.0, 0), ">u2") == 12345)
    torn = (blocks[:, telling] != blocks[:, :1]).any(axis=1)
    assert len(telling) > 50
    assert {0, RESULT_WORDS - 1} < set(telling.tolist())
    assert not torn.any(), blocks[torn][:2]
    assert len(np.unique(blocks[:, 0])) > 20
    assert publisher.published > 100
