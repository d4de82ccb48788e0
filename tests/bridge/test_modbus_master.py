"""The master at the wire: exact bytes, and every wrong, late or endless answer turned into its error in time."""

from __future__ import annotations

import contextlib
import os
import socket
import threading
import time
import tty
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_bridge import errors
from firmware_bridge.links.modbus_master import ModbusMaster
from firmware_bridge.links.ports import Port, open_serial, open_tcp
from firmware_bridge.simulators.module_server import WireFault
from firmware_bridge.wire.modbus import Table
from firmware_bridge.wire.modbus_frames import rtu_frame

HOLDING, INPUT, COILS, DISCRETE = (
    Table.HOLDING_REGISTERS, Table.INPUT_REGISTERS, Table.COILS, Table.DISCRETE_INPUTS,
)  # fmt: skip
UNIT = 3
OVERSHOOT_S = 5.0
"""What a loaded machine may add to a deadline; a request that hangs takes for ever."""


def frame(hexadecimal: str) -> bytes:
    return bytes.fromhex(hexadecimal)


# Requests and answers written out by hand; checksums as mbpoll sends them.
EXCHANGES = [
    ("read", (HOLDING, 0, 2), "03 03 0000 0002 C5E9", "03 03 04 0333 0001 A8 44", [0x333, 1]),
    ("read", (INPUT, 64, 1), "03 04 0040 0001 303C", "03 04 02 1388 CDA6", [5000]),
    ("read", (COILS, 269, 1), "03 01 010D 0001 AC17", "03 01 01 01 9030", [1]),
    ("read", (DISCRETE, 32, 3), "03 02 0020 0003 3823", "03 02 01 05 6033", [1, 0, 1]),
    ("write", (HOLDING, 32, 4000), "03 06 0020 0FA0 8D9A", "03 06 0020 0FA0 8D9A", None),
    ("write", (COILS, 269, 1), "03 05 010D FF00 1DE7", "03 05 010D FF00 1DE7", None),
]


@pytest.mark.parametrize(("verb", "arguments", "request_hex", "answer_hex", "result"), EXCHANGES)
def test_bytes_on_a_serial_line(
    scripted: Any, verb: str, arguments: Any, request_hex: str, answer_hex: str, result: Any
) -> None:
    request = frame(request_hex)[:-2]
    answer = frame(answer_hex)[:-2]
    master, peer = scripted([rtu_frame(answer[0], answer[1:])], deadline_s=5.0)
    assert getattr(master, verb)(*arguments) == result
    assert peer.requests == [rtu_frame(request[0], request[1:])]


def test_bytes_on_a_connection(scripted: Any) -> None:
    answers = ["0001 0000 0006 03 06 0400 0666", "0002 0000 0005 03 03 02 0666"]
    master, peer = scripted([frame(answer) for answer in answers], rtu=False, deadline_s=5.0)
    master.write(HOLDING, 0x400, 0x666)
    assert master.read(HOLDING, 0x400) == [0x666]
    assert peer.requests == [frame("0001 0000 0006 03 06 0400 0666"), frame("0002 0000 0006 03 03 0400 0001")]


WRONG = {
    "bad checksum": frame("03 03 02 0333 FFFF"),
    "another unit": rtu_frame(4, frame("03 02 0333")),
    "another function": rtu_frame(3, frame("04 02 0333")),
    "an exception to another function": rtu_frame(3, frame("86 02")),
    "too many registers": rtu_frame(3, frame("03 04 0333 0333")),
    "no registers": rtu_frame(3, frame("03 00")),
    "cut short": frame("03 03 02 03"),
    "noise": frame("FF 00 FF 55 AA 00"),
}


@pytest.mark.parametrize("answer", WRONG.values(), ids=WRONG)
def test_wrong_answers_to_a_read(scripted: Any, answer: bytes) -> None:
    master, _ = scripted([answer])
    with pytest.raises(errors.ReplyWrong, match="module: wrong answer"):
        master.read(HOLDING, 0)


@pytest.mark.parametrize("answer", [frame("06 0020 0FA1"), frame("06 0021 0FA0"), frame("10 0020 0001")])
def test_an_echo_of_another_write_is_wrong(scripted: Any, answer: bytes) -> None:
    master, _ = scripted([rtu_frame(3, answer)])
    with pytest.raises(errors.ReplyWrong):
        master.write(HOLDING, 0x20, 4000)


def test_an_old_answer_with_another_transaction_is_not_taken(scripted: Any) -> None:
    master, _ = scripted([frame("0007 0000 0005 03 03 02 0666")], rtu=False)
    with pytest.raises(errors.ReplyWrong):
        master.read(HOLDING, 0)


def test_what_came_unasked_is_thrown_away(scripted: Any) -> None:
    master, peer = scripted([rtu_frame(3, frame("03 02 0007"))], deadline_s=5.0)
    peer.send(rtu_frame(3, frame("03 02 0001")))
    assert master.read(HOLDING, 0) == [7]


@pytest.mark.parametrize("noise", ["00", "FF", "00 FF 80", "03", "06 00"])
def test_noise_before_the_answer_is_skipped(scripted: Any, noise: str) -> None:
    master, _ = scripted([frame(noise) + rtu_frame(3, frame("03 02 0007"))], deadline_s=5.0)
    assert master.read(HOLDING, 0) == [7]


def test_an_answer_may_come_byte_by_byte_among_noise(scripted: Any) -> None:
    master, peer = scripted([], deadline_s=10.0)
    stream = frame("00 03 03 02") + rtu_frame(4, frame("03 02 0009")) + rtu_frame(3, frame("03 02 0007"))
    thread = threading.Thread(target=peer.drip, args=(stream,))
    thread.start()
    assert master.read(HOLDING, 0) == [7]
    thread.join()


def test_refusals_are_named(scripted: Any) -> None:
    master, _ = scripted([rtu_frame(3, frame("83 02")), rtu_frame(3, frame("83 63"))], deadline_s=5.0)
    with pytest.raises(errors.Refused, match="unit 3 refused: exception 2, illegal data address"):
        master.read(HOLDING, 9)
    with pytest.raises(errors.Refused, match="exception 99, not in the specification"):
        master.read(HOLDING, 9)


def test_the_other_side_hanging_up_is_told_from_silence(scripted: Any) -> None:
    master, peer = scripted([])
    with pytest.raises(errors.NoReply, match=r"no answer in 0.3 s, reading holding register 0 of unit 3"):
        master.read(HOLDING, 0)
    peer.hang_up()
    with pytest.raises(errors.DeviceGone, match="closed by the other side"):
        master.read(HOLDING, 0)


def test_a_serial_line_is_given_its_pause_between_frames() -> None:
    near, far = socket.socketpair()
    port = Port("module", "pair", near, quiet_s=0.1)
    far.sendall(b"unasked")
    port.settle()
    settled_s = time.monotonic()
    far.sendall(b"answer")
    assert port.read(5.0) == b"answer"
    port.settle()
    assert time.monotonic() - settled_s >= 0.1
    port.close()
    far.close()


@settings(deadline=None, max_examples=300)
@given(st.binary(max_size=300), st.booleans(), st.sampled_from(list(Table)))
def test_random_answers_end_in_an_answer_or_an_error(answer: bytes, rtu: bool, table: Table) -> None:
    near, far = socket.socketpair()
    port = Port("module", "pair", near)
    master = ModbusMaster("module", UNIT, lambda: port, rtu=rtu, deadline_s=0.002)
    master.open()
    thread = threading.Thread(target=lambda: far.recv(512) and far.sendall(answer))
    thread.start()
    try:
        values = master.read(table, 0, 4)
        assert len(values) == 4
    except errors.BridgeError:
        pass
    finally:
        thread.join()
        master.close()
        far.close()


@pytest.fixture
def babbling_line() -> Iterator[str]:
    """A pseudo-terminal whose other end sends random bytes without a pause."""
    line, slave = os.openpty()
    tty.setraw(slave)
    ended = threading.Event()

    def babble() -> None:
        os.set_blocking(line, False)
        while not ended.is_set():
            try:
                os.write(line, os.urandom(200))
            except BlockingIOError:
                ended.wait(0.001)

    thread = threading.Thread(target=babble)
    thread.start()
    yield os.ttyname(slave)
    ended.set()
    thread.join()
    os.close(line)
    os.close(slave)


def test_a_babbling_line_does_not_hang_a_request(babbling_line: str, master_at: Any) -> None:
    master = master_at(babbling_line, deadline_s=0.3)
    for _ in range(5):
        started_s = time.monotonic()
        with pytest.raises((errors.ReplyWrong, errors.Refused)):
            master.read(HOLDING, 0)
        assert time.monotonic() - started_s < 0.3 + OVERSHOOT_S


def test_a_slow_drip_does_not_stretch_the_deadline(scripted: Any) -> None:
    master, peer = scripted([], deadline_s=0.3)
    ended = threading.Event()

    def drip() -> None:
        while not ended.wait(0.02):
            peer.send(b"\x03")

    thread = threading.Thread(target=drip)
    thread.start()
    try:
        started_s = time.monotonic()
        with pytest.raises(errors.ReplyWrong):
            master.read(HOLDING, 0)
        assert time.monotonic() - started_s < 0.3 + OVERSHOOT_S
    finally:
        ended.set()
        thread.join()


def test_a_line_that_takes_no_data_does_not_hang(scripted: Any) -> None:
    master, peer = scripted([])
    peer.near.setblocking(False)
    with contextlib.suppress(BlockingIOError):
        while True:
            peer.near.send(bytes(65536))
    with pytest.raises(errors.NoReply, match="takes no data"):
        master.read(HOLDING, 0)


FAULTS = {
    WireFault.SILENT: errors.NoReply,
    WireFault.LATE: errors.NoReply,
    WireFault.GARBAGE: errors.ReplyWrong,
    WireFault.BAD_CRC: errors.ReplyWrong,
    WireFault.WRONG_UNIT: errors.ReplyWrong,
    WireFault.TRUNCATED: errors.ReplyWrong,
}


@pytest.mark.parametrize("tcp", [False, True], ids=["rtu", "tcp"])
@pytest.mark.parametrize("fault", FAULTS, ids=str)
def test_every_fault_of_the_wire_is_its_error_and_passes(
    fault: WireFault, tcp: bool, serve: Any, master_at: Any
) -> None:
    if tcp and fault is WireFault.BAD_CRC:
        return  # a Modbus TCP frame has no checksum of its own to damage
    server = serve("ato-4ch", tcp=tcp)
    master = master_at(server.address, deadline_s=0.3)
    server.late_s = 0.5
    server.fault = fault
    with pytest.raises(FAULTS[fault]):
        master.read(HOLDING, 0)
    server.fault = WireFault.NONE
    assert _reads_within(master, deadline_s=10.0) == [0]


@pytest.mark.parametrize("tcp", [False, True], ids=["rtu", "tcp"])
def test_a_module_that_answers_twice_is_believed_once(tcp: bool, serve: Any, master_at: Any) -> None:
    server = serve("ato-4ch", tcp=tcp)
    master = master_at(server.address, deadline_s=5.0)
    server.fault = WireFault.TWICE
    for counts in range(0, 4000, 200):
        master.write(HOLDING, 0, counts)
        assert master.read(HOLDING, 0) == [counts], "what it said of the level before is not taken for this one's"


def _reads_within(master: ModbusMaster, deadline_s: float) -> list[int]:
    """The first answer once the fault is over: a late one may still be on its way."""
    end_s = time.monotonic() + deadline_s
    while True:
        try:
            return master.read(HOLDING, 0)
        except (errors.NoReply, errors.ReplyWrong):
            if time.monotonic() > end_s:
                raise


def test_another_unit_is_silent(serve: Any, settings_for: Any) -> None:
    from firmware_bridge.factory import build_master

    server = serve("ato-4ch")
    master = build_master(settings_for("ato-4ch", server.address, unit=9, deadline_s=0.2))
    master.open()
    with pytest.raises(errors.NoReply, match="unit 9"):
        master.read(HOLDING, 0)
    master.close()


def test_a_pulled_adapter_comes_back_under_another_name(serve: Any, master_at: Any, tmp_path: Path) -> None:
    link = tmp_path / "by-id"
    before = serve("ato-4ch", symlink=link)
    master = master_at(str(link))
    master.write(HOLDING, 0, 1234)
    before.stop()
    with pytest.raises(errors.DeviceGone):
        master.read(HOLDING, 0)
    with pytest.raises(errors.DeviceGone, match=r"cannot open .*No such file.*/dev/serial/by-id"):
        master.open()
    after = serve("ato-4ch", symlink=link)
    master.open()
    assert master.read(HOLDING, 0) == [0]
    master.write(HOLDING, 0, 77)
    assert after.module.output_v(0) == pytest.approx(77 * 5 / 4095)


@pytest.mark.parametrize("heard", [b"", bytes.fromhex("03 03 02")], ids=["unanswered", "half answered"])
def test_an_adapter_pulled_in_mid_request_is_gone_at_once(heard: bytes, settings_for: Any, descriptors: Any) -> None:
    from firmware_bridge.factory import build_master

    before = descriptors()
    module, adapter = os.openpty()
    master = build_master(settings_for("ato-4ch", os.ttyname(adapter), deadline_s=10.0))
    master.open()
    os.close(adapter)

    def answers_and_goes() -> None:
        os.read(module, 512)
        os.write(module, heard)
        os.close(module)

    puller = threading.Thread(target=answers_and_goes)
    puller.start()
    with pytest.raises(errors.DeviceGone, match="check its cable"):
        master.read(HOLDING, 0)
    puller.join()
    master.close()
    assert descriptors() == before


def test_a_connection_that_is_cut_comes_back(serve: Any, settings_for: Any) -> None:
    from firmware_bridge.factory import build_master

    server = serve("ato-4ch", tcp=True)
    master = build_master(settings_for("ato-4ch", server.address, deadline_s=2.0))
    master.open()
    assert master.read(HOLDING, 0) == [0]
    server.stop()
    with pytest.raises(errors.DeviceGone):
        master.read(HOLDING, 0)
    with pytest.raises(errors.DeviceGone, match=r"cannot connect to 127.0.0.1:\d+: Connection refused"):
        master.open()


def test_a_serial_line_is_opened_exclusively(serve: Any) -> None:
    server = serve("ato-4ch")
    port = open_serial("module", server.address)
    with pytest.raises(errors.DeviceGone, match="another program has it open"):
        open_serial("module", server.address)
    port.close()
    open_serial("module", server.address).close()


def test_what_is_no_port_is_said_so(tmp_path: Path) -> None:
    plain = tmp_path / "file"
    plain.write_text("")
    for path in (plain, tmp_path / "missing", tmp_path):
        with pytest.raises(errors.DeviceGone, match=f"cannot open {path}"):
            open_serial("module", str(path))
    with pytest.raises(errors.DeviceGone, match=r"cannot connect to nowhere\.invalid:1"):
        open_tcp("module", "nowhere.invalid", 1, 1.0)


def test_failures_leave_no_thread_or_descriptor(serve: Any, settings_for: Any, descriptors: Any) -> None:
    from firmware_bridge.factory import build_master

    server = serve("ato-4ch")
    server.fault = WireFault.TRUNCATED
    master = build_master(settings_for("ato-4ch", server.address, deadline_s=0.02))
    missing = build_master(settings_for("ato-4ch", "/dev/no-such-port"))
    threads, before = threading.active_count(), descriptors()
    for _ in range(20):
        master.open()
        with pytest.raises(errors.BridgeError):
            master.read(HOLDING, 0)
        master.close()
        with pytest.raises(errors.DeviceGone):
            missing.open()
    assert descriptors() == before
    assert threading.active_count() == threads
