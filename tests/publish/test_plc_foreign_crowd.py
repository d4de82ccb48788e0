"""Four foreign clients ask for this and that at once while images are published flat out: nothing torn, wrong or lost.

CROWD_REQUESTS sets how many requests they make together.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import re
import subprocess
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flat_out import FlatOut, derived

from inspector.model import PlcSide, Snapshot
from inspector.publish.plc_server import PlcServer
from inspector.publish.registers import CONTROL_ADDRESS, CONTROL_WORDS, encode_image

REQUESTS = int(os.environ.get("CROWD_REQUESTS", "2000"))
SHARES = {"libmodbus": 0.5, "modbus-serial": 0.25, "jsmodbus": 0.25}
"""How much of it each makes; mbpoll, which waits 10 ms between two polls, polls all the while."""
OWN = {"libmodbus": 500, "modbus-serial": 504, "jsmodbus": 508, "mbpoll": 512}
"""First of the four registers of the control block that each writes."""
TIMELY = ("heartbeat", "result_age_ms")
PEERS = Path(__file__).parents[1] / "peers"
LIMIT_S = 60 + REQUESTS / 500

pytestmark = pytest.mark.timeout(LIMIT_S + 60)


class Station:
    """Publishes flat out, and keeps what is written into its control block."""

    def __init__(self) -> None:
        self.server = PlcServer(port=0, stall_after_s=600.0, on_control=self._take)
        self._words = (0,) * CONTROL_WORDS
        self._lock, self._free = threading.Lock(), threading.Event()
        self._free.set()
        self._publisher = FlatOut(self._publish, itertools.cycle([derived(number) for number in range(1, 3000)]))

    @property
    def published(self) -> int:
        return self._publisher.published

    def __enter__(self) -> Station:
        self.server.start()
        self._show(derived(1))
        self._publisher.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self._publisher.__exit__()
        self.server.stop()

    def _publish(self, snapshot: Snapshot) -> None:
        self._free.wait()  # a lock taken again at once would keep writers out for ever
        with self._lock:
            self._show(snapshot)

    def _take(self, address: int, words: Sequence[int]) -> None:
        at = address - CONTROL_ADDRESS
        self._free.clear()
        with self._lock:
            self._words = (*self._words[:at], *words, *self._words[at + len(words) :])
            self._show(derived(1 + self.published % 2999))
        self._free.set()

    def _show(self, snapshot: Snapshot) -> None:
        object.__setattr__(snapshot, "plc", PlcSide(control=self._words))
        self.server.publish(snapshot)


@pytest.fixture
def template(tmp_path: Path) -> Path:
    """What each register of block and list holds: the image's number (n), a constant (c) or anything (x)."""
    file = tmp_path / "template"
    images = [encode_image(derived(n), 0.0, 7).areas for n in (1000, 1001, 2345)]
    lines = []
    for area in range(2):
        first = images[0][area][0]
        words = np.array([np.frombuffer(image[area][1], ">u2") for image in images])
        for i, (a, b, c) in enumerate(words.T.tolist()):
            kind = "n" if (a, b, c) == (1000, 1001, 2345) else "c" if a == b == c else "x"
            kind = "x" if first == 0 and i in (2, 20, 21) else kind  # heartbeat and age go on by themselves
            lines.append(f"{first + i} {kind} {a}\n")
    assert sum(" n " in line for line in lines) > 300
    file.write_text("".join(lines))
    return file


@pytest.fixture(scope="session")
def node_modules(npm_peers: Callable[..., Path]) -> Path:
    """A folder with the npm clients of peers/package-lock.json."""
    return npm_peers(PEERS, "modbus-serial and jsmodbus")


Run = Callable[[str, PlcServer, Path], "subprocess.Popen[str]"]


@pytest.fixture
def run(peer: Any, compiled_peer: Any, node_modules: Path) -> Iterator[Run]:
    """``run(client, server, template)``: a client at work; killed at the end."""
    node, program = peer("node", "nodejs"), compiled_peer("modbus_mixed")
    with contextlib.ExitStack() as stack:

        def start(client: str, server: PlcServer, template: Path) -> subprocess.Popen[str]:
            share = str(int(REQUESTS * SHARES[client]))
            if client == "libmodbus":
                command = [program, "127.0.0.1", str(server.port), share, str(template), str(OWN[client])]
            else:
                command = [node, str(PEERS / "modbus_mixed.mjs"), client, str(server.port), share, str(template)]
                command += [str(OWN[client]), str(node_modules)]
            process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
            stack.callback(process.communicate)
            stack.callback(process.kill)
            return process

        yield start


class Mbpoll:
    """mbpoll, polling the block on one connection all the while, and writing now and then on others."""

    def __init__(self, program: str, port: int) -> None:
        self._at, self.wrote = [program, "-m", "tcp", "-p", str(port), "-0", "-t", "4", "-o", "10"], 0
        command = [*self._at, "-r", "0", "-c", "125", "-l", "11", "127.0.0.1"]
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        self.blocks: list[list[int]] = []
        self.complaints: list[str] = []
        self._thread = threading.Thread(target=self._read)
        self._thread.start()

    def _read(self) -> None:
        assert self._process.stdout
        block: list[int] = []
        for line in self._process.stdout:
            if found := re.match(r"\[(\d+)\]:\s+(-?\d+)", line):
                block = [*([] if found[1] == "0" else block), int(found[2]) % 65536]
                if len(block) == 125:
                    self.blocks.append(block)
            elif "fail" in line.lower() or "error" in line.lower():
                self.complaints.append(line)

    def write(self) -> None:
        """Write two registers and read them back, each on a connection of its own."""
        self.wrote += 1
        words = [str(self.wrote % 30000), "77"]
        subprocess.run([*self._at, "-r", "512", "127.0.0.1", *words], check=True, capture_output=True, timeout=30)
        once = [*self._at, "-1", "-r", "512", "-c", "2", "127.0.0.1"]
        done = subprocess.run(once, check=True, capture_output=True, text=True, timeout=30)
        assert re.findall(r"^\[\d+\]:\s+(\d+)", done.stdout, re.MULTILINE) == words

    def stop(self) -> None:
        self._process.terminate()
        self._thread.join()
        self._process.wait(30)


@pytest.mark.usefixtures("threads_alternate")
def test_a_crowd_of_foreign_clients_reads_and_writes(run: Run, peer: Any, template: Path) -> None:
    with Station() as station, contextlib.ExitStack() as stack:
        poll = Mbpoll(peer("mbpoll", "mbpoll"), station.server.port)
        stack.callback(poll.stop)
        clients = {name: run(name, station.server, template) for name in SHARES}
        while any(process.poll() is None for process in clients.values()):
            poll.write()
        for name, process in clients.items():
            out, err = process.communicate(timeout=LIMIT_S)
            assert process.returncode == 0, f"{name}: {err}"
            assert int(out) >= int(REQUESTS * SHARES[name])
        poll.stop()
        assert not poll.complaints
        assert_whole(poll.blocks, template)
        counted = station.server.diagnostics
    assert poll.wrote > 0
    assert counted.requests >= REQUESTS + len(poll.blocks)
    assert set(counted.exceptions) == {2}
    assert (counted.out_of_step, counted.closed_slow, counted.closed_idle, counted.gave_way) == (0, 0, 0, 0)
    if REQUESTS > 100_000:
        print(f"{counted.requests} requests, {station.published} images, {len(poll.blocks)} + {poll.wrote} by mbpoll")


def assert_whole(blocks: list[list[int]], template: Path) -> None:
    rows = [line.split() for line in template.read_text().splitlines()[:125]]
    read = np.array(blocks)
    numbers = [i for i, row in enumerate(rows) if row[1] == "n"]
    constants = [i for i, row in enumerate(rows) if row[1] == "c"]
    assert len(read) > 3
    assert (read[:, numbers] == read[:, :1]).all()
    assert (read[:, constants] == [int(rows[i][2]) for i in constants]).all()
