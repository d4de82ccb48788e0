"""The PLC server over real sockets: exact bytes, bad company, and the truth when the cycle stalls."""

from __future__ import annotations

import itertools
import os
import socket
import struct
import threading
from collections.abc import Callable
from typing import Any

import pytest
from flat_out import FlatOut
from plc_wire import ask, connect, is_closed, receive

from inspector.faults import Fault
from inspector.model import Defect, Reason, Snapshot, State, Verdict
from inspector.publish import plc_connection
from inspector.publish.plc_server import PlcServer, PlcServerError
from inspector.publish.registers import Status, decode

Wait = Callable[..., Any]
Start = Callable[..., PlcServer]
READ_BLOCK = bytes.fromhex("0001 0000 0006 01 04 0000 007d")
GOOD = Snapshot(
    state=State.CONTINUOUS_EXECUTION,
    sequence=3,
    verdict=Verdict.PASS,
    defects=(Defect(1.0, 2.0, 30.0, None, (0.0, 0.0), (0.0, 0.0)),),
    result_at_s=0.0,
)


def read_block(client: socket.socket) -> dict[str, Any]:
    client.sendall(READ_BLOCK)
    answer = receive(client, 259)
    return decode(struct.unpack(">125H", answer[9:]))


def test_serves_from_the_first_moment_and_is_no_pass(start: Start) -> None:
    with connect(start()) as client:
        read = read_block(client)
    assert read["state"] == State.PREOPERATIONAL
    assert read["verdict"] == Verdict.NOT_INSPECTED


def test_what_is_published_is_read_at_once(start: Start) -> None:
    server = start()
    with connect(server) as client:
        for sequence in range(1, 200):
            server.publish(Snapshot(sequence=sequence, panel_id=sequence))
            assert read_block(client)["panel_id"] == sequence


@pytest.mark.parametrize(
    ("request_body", "answer_body"),
    [
        ("01 04 0000 0001", "01 04 02 00 03"),
        ("01 03 0000 0001", "01 03 02 00 03"),
        ("00 03 007c 0001", "00 03 02 00 03"),
        ("ff 03 03e8 0002", "ff 03 04 00 03 00 01"),
        ("01 04 0000 007e", "01 84 03"),
        ("01 04 0000 0000", "01 84 03"),
        ("01 04 007c 0002", "01 84 02"),
        ("01 04 007d 0001", "01 84 02"),
        ("01 03 03e7 0002", "01 83 02"),
        ("01 03 0532 0002", "01 83 02"),
        ("01 03 ffff 0001", "01 83 02"),
        ("01 06 0000 0001", "01 86 02"),
        ("01 10 0000 0001 02 0001", "01 90 02"),
        ("01 16 0000 0000 0001", "01 96 02"),
        ("01 17 0000 0001 0000 0001 02 0001", "01 97 02"),
        ("01 01 0000 0001", "01 01 01 01"),
        ("01 02 0000 0013", "01 02 03 03 00 01"),
        ("ff 01 03e8 07d0", "ff 81 02"),
        ("01 02 07c0 0010", "01 02 02 03 00"),
        ("01 02 07c0 0011", "01 82 02"),
        ("01 01 07d0 0001", "01 81 02"),
        ("01 02 ffff 0001", "01 82 02"),
        ("01 02 fff0 0011", "01 82 02"),
        ("01 02 0000 07d1", "01 82 03"),
        ("01 01 0000 0000", "01 81 03"),
        ("01 05 0000 ff00", "01 85 02"),
        ("01 0f 0000 0001 01 01", "01 8f 02"),
        ("01 05 0000 0001", "01 85 03"),
        ("01 55", "01 d5 01"),
        ("02 03 0000 0001", "02 83 0b"),
    ],
)
def test_answers_and_refusals_are_right_to_the_byte(start: Start, request_body: str, answer_body: str) -> None:
    server = start()
    server.publish(GOOD)
    with connect(server) as client:
        assert ask(client, request_body) == answer_body


def test_tells_what_it_is(start: Start) -> None:
    with connect(start()) as client:
        assert b"seed-inspector".hex(" ") in ask(client, "01 2b 0e 01 00")


def test_unit_ids_and_word_order_are_as_configured(start: Start) -> None:
    server = start(unit_ids=(7,), word_order="low_first")
    server.publish(Snapshot(panel_id=0x12345678))
    with connect(server) as client:
        assert ask(client, "07 03 0010 0002") == "07 03 04 56 78 12 34"
        assert ask(client, "01 03 0010 0002") == "01 83 0b"


def test_pipelined_requests_are_answered_in_order(start: Start) -> None:
    requests = b"".join(i.to_bytes(2, "big") + READ_BLOCK[2:] for i in range(500))
    with connect(start()) as client:
        sender = threading.Thread(target=client.sendall, args=(requests,))
        sender.start()
        transactions = [int.from_bytes(receive(client, 259)[:2], "big") for _ in range(500)]
        sender.join()
    assert transactions == list(range(500))


def test_a_request_in_single_bytes_is_answered(start: Start) -> None:
    with connect(start()) as client:
        for byte in READ_BLOCK:
            client.send(bytes((byte,)))
        assert receive(client, 259)[7:9] == b"\x04\xfa"


def test_a_half_closed_client_gets_its_answers(start: Start) -> None:
    with connect(start()) as client:
        client.sendall(READ_BLOCK)
        client.shutdown(socket.SHUT_WR)
        assert receive(client, 259)[7:9] == b"\x04\xfa"
        assert is_closed(client)


@pytest.mark.parametrize(
    "garbage", ["00010001000601040000007d", "000100000000", "00010000ffff01", "474554202f20485454"]
)
def test_garbage_costs_only_the_one_who_sent_it(start: Start, garbage: str) -> None:
    server = start(idle_timeout_s=0.5)
    with connect(server) as good, connect(server) as bad:
        bad.sendall(bytes.fromhex(garbage))
        assert is_closed(bad)
        assert ask(good, "01 03 0000 0001") == "01 03 02 00 00"


def test_noise_on_the_port_harms_nobody(start: Start) -> None:
    server = start()
    with connect(server) as good:
        for _ in range(50):
            with connect(server) as bad:
                bad.sendall(os.urandom(400))
        assert ask(good, "01 03 0000 0001") == "01 03 02 00 00"


def test_silent_and_dribbling_clients_are_closed_in_time(start: Start) -> None:
    server = start(idle_timeout_s=0.3)
    with connect(server) as silent, connect(server) as dribbler:
        dribbler.sendall(READ_BLOCK[:5])
        assert is_closed(silent)
        assert is_closed(dribbler)


def test_a_client_that_never_reads_is_closed(start: Start, wait_until: Wait, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plc_connection, "SLOW_READER_S", 0.2)
    server = start()
    with connect(server) as deaf, connect(server) as good:
        deaf.setblocking(False)

        def shout() -> bool:
            """Keep sending until the server has had enough."""
            try:
                deaf.send(READ_BLOCK * 1000)
            except BlockingIOError:
                return False
            except (ConnectionResetError, BrokenPipeError):
                return True
            return False

        wait_until(shout, "the client that never reads is closed")
        assert ask(good, "01 03 0000 0001") == "01 03 02 00 00"


def test_strangers_are_closed_and_named_once(start: Start, caplog: pytest.LogCaptureFixture) -> None:
    server = start(allow=("192.0.2.0/24",))
    for _ in range(3):
        with connect(server) as stranger:
            assert is_closed(stranger)
    assert caplog.text.count("127.0.0.1 refused") == 1
    assert server.diagnostics.refused_strangers == 3


def test_a_stalled_cycle_is_told_until_it_beats_again(start: Start, wait_until: Wait) -> None:
    server = start(stall_after_s=0.3)
    server.publish(GOOD)
    with connect(server) as client:
        told = wait_until(lambda: (r := read_block(client))["fault_code"] and r, "the stall is told")
        assert told["fault_code"] == Fault.CYCLE_STALLED
        assert (told["state"], told["verdict"]) == (State.ERROR, Verdict.NOT_INSPECTED)
        assert told["reasons"] == Reason.DEVICE_FAULT
        assert told["status"] == Status.FAULT
        assert told["defect_count"] == 0

        def recovered() -> bool:
            server.beat()
            return read_block(client)["verdict"] == Verdict.PASS

        wait_until(recovered, "the result is back")


@pytest.mark.usefixtures("threads_alternate")
def test_no_client_reads_an_older_result_than_another_has_read(start: Start) -> None:
    """A read that C answers, and one that Python answers, as those over TLS and a serial line: here since what comes
    together with it is no read."""
    server, last = start(), 0
    later = (Snapshot(sequence=n) for n in itertools.count(1))
    with connect(server) as in_c, connect(server) as in_python, FlatOut(server.publish, later) as publisher:
        for _ in range(500):
            in_python.sendall(bytes.fromhex("0001 0000 0006 01 04 0000 0001 0002 0000 0002 01 55"))
            for read in (receive(in_python, 20)[9:11].hex(), ask(in_c, "01 04 0000 0001")[9:].replace(" ", "")):
                assert (int(read, 16) - last) % 0x10000 < 0x8000
                last = int(read, 16)
    assert publisher.published > 100


def test_heartbeat_and_age_go_on_without_publishing(start: Start, wait_until: Wait) -> None:
    server = start()
    server.publish(Snapshot(result_at_s=0.0))
    with connect(server) as client:
        before = read_block(client)

        def moved() -> bool:
            now = read_block(client)
            return bool(now["heartbeat"] > before["heartbeat"] and now["result_age_ms"] > before["result_age_ms"])

        wait_until(moved, "heartbeat and age rise")


def test_a_taken_port_is_named_with_its_remedy(start: Start) -> None:
    taken = start().port
    with pytest.raises(PlcServerError, match=rf"127\.0\.0\.1:{taken}: Address already in use; .* or set another port"):
        PlcServer(port=taken).start()


def test_an_address_of_another_machine_is_named_with_its_remedy() -> None:
    with pytest.raises(PlcServerError, match="set host to an address of this machine"):
        PlcServer("192.0.2.1", 0).start()


def test_a_privileged_port_is_named_with_its_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*args: Any, **kwargs: Any) -> socket.socket:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(socket, "create_server", refuse)
    with pytest.raises(PlcServerError, match=r":502: Permission denied; .*1024 or above.*CAP_NET_BIND_SERVICE"):
        PlcServer().start()


def test_stop_frees_the_port_and_may_be_repeated(start: Start) -> None:
    server = start()
    with connect(server) as client:
        ask(client, "01 03 0000 0001")
        server.stop()
        server.stop()
        assert is_closed(client)
    with pytest.raises(ConnectionRefusedError):
        connect(server)
    PlcServer().stop()
