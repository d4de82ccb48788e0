"""`inspector health` against services that are well, at fault, silent, stuck or gone."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import struct
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from inspector.commands import health
from inspector.commands.health import EXIT_HEALTHY, EXIT_NO_ANSWER, EXIT_NOT_WELL
from inspector.faults import Fault
from inspector.model import Snapshot, State
from inspector.publish import address
from inspector.publish.plc_server import PlcServer
from inspector.publish.registers import encode_image
from tests.support import forked

HOST = "127.0.0.1"


@pytest.fixture
def served() -> Iterator[Any]:
    """``served(snapshot, **settings)``: a server that shows it; its port."""
    with contextlib.ExitStack() as stack:

        def start(snapshot: Snapshot, **settings: Any) -> int:
            server = PlcServer(port=0, stall_after_s=60.0, on_control=lambda *_: None, **settings)
            server.start()
            stack.callback(server.stop)
            server.publish(snapshot)
            return server.port

        yield start


def test_a_station_that_is_ready_is_healthy(served: Any) -> None:
    assert health.look(HOST, served(Snapshot(state=State.READY)), 1) == (EXIT_HEALTHY, "READY")


@pytest.mark.parametrize("fault", [Fault.CAMERA_GONE, Fault.CYCLE_STALLED])
def test_a_fault_is_told_and_is_no_reason_to_start_it_again(served: Any, fault: Fault) -> None:
    port = served(Snapshot(state=State.ERROR, fault_code=fault))
    assert health.look(HOST, port, 1) == (EXIT_NOT_WELL, f"ERROR, fault {fault}: {fault.meaning}. {fault.remedy}")


def test_a_service_that_lets_nobody_in_is_alive(served: Any) -> None:
    port = served(Snapshot(state=State.READY), allow=("192.0.2.0/24",))
    status, said = health.look(HOST, port, 1)
    assert status == EXIT_NOT_WELL
    assert "plc.allow" in said


def test_a_port_where_nobody_listens_or_answers_is_no_answer() -> None:
    with socket.create_server((HOST, 0)) as silent:
        port = silent.getsockname()[1]
        assert health.look(HOST, port, 1, deadline_s=0.05)[0] == EXIT_NO_ANSWER
    assert health.look(HOST, port, 1)[0] == EXIT_NO_ANSWER


def test_a_heartbeat_that_stands_still_is_no_answer() -> None:
    block = encode_image(Snapshot(state=State.READY), 0.0, 7).areas[0][1][: 2 * health.WORDS]

    def answer_for_ever(listener: socket.socket) -> None:
        client, _ = listener.accept()
        with client, contextlib.suppress(OSError):
            while client.recv(12):
                client.sendall(struct.pack(">HHHBBB", 1, 0, 3 + len(block), 1, 4, len(block)) + block)

    with socket.create_server((HOST, 0)) as listener:
        stuck = threading.Thread(target=answer_for_ever, args=(listener,))
        stuck.start()
        said = health.look(HOST, listener.getsockname()[1], 1, deadline_s=0.5)
        stuck.join(10)
    assert said == (EXIT_NO_ANSWER, "the heartbeat stands still")


def test_the_command_finds_the_service_by_its_address_file(served: Any, tmp_path: Path) -> None:
    port = served(Snapshot(state=State.READY))
    before = os.umask(0o077)
    try:
        address.tell("0.0.0.0", port, 1, {"RUNTIME_DIRECTORY": str(tmp_path)})
    finally:
        os.umask(before)
    assert (tmp_path / address.NAME).stat().st_mode & 0o777 == 0o644
    assert json.loads((tmp_path / address.NAME).read_text()) == [HOST, port, 1]
    done = forked.run("health", "--address-file", tmp_path / address.NAME)
    assert (done.returncode, done.stdout) == (EXIT_HEALTHY, f"{HOST}:{port}: READY\n")


def test_a_service_that_has_no_address_answers_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "half").write_text('["127.0.0.1", ')
    for name in ("none", "half"):
        assert health.run(None, tmp_path / name) == EXIT_NO_ANSWER
        assert "not served" in capsys.readouterr().out


def test_settings_that_are_refused_tell_nothing_of_the_service(tmp_path: Path) -> None:
    (tmp_path / "bad.yaml").write_text("{")
    assert health.run(tmp_path / "bad.yaml", None) == health.EXIT_SETTINGS_REFUSED
