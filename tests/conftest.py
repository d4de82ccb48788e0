"""What all tests share: waiting with a deadline, foreign peers, frames. Nothing here fixes a port or a path."""

from __future__ import annotations

import os
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from threading import Event
from typing import Any

import pytest

DATA = Path(__file__).parent / "data"
PEERS = Path(__file__).parent / "peers"
PEER_MISSING = "peer missing"


@pytest.fixture(scope="session")
def frames_folder() -> Path:
    """Rendered frames with exact truth, and the calibration they were rendered through."""
    return DATA / "frames"


@pytest.fixture(scope="session")
def wait_until() -> Callable[..., Any]:
    """``wait_until(condition, what, deadline_s=20)``: the condition's first true value, or a failure that says what."""

    def wait(condition: Callable[[], Any], what: str, deadline_s: float = 20.0) -> Any:
        end, tick = time.monotonic() + deadline_s, Event()
        while not (value := condition()):
            if time.monotonic() > end:
                pytest.fail(f"not within {deadline_s:g} s: {what}")
            tick.wait(0.01)
        return value

    return wait


@pytest.fixture(scope="session")
def peer() -> Callable[[str, str], str]:
    """``peer(program, package)``: the path of a foreign program; the test is skipped by name where it is missing."""

    def find(program: str, package: str) -> str:
        path = shutil.which(program)
        if path is None:
            pytest.skip(f"{PEER_MISSING}: {program} (apt install {package})")
        return path

    return find


@pytest.fixture(scope="session")
def compiled_peer(peer: Callable[[str, str], str], tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], str]:
    """``compiled_peer(name)``: the path of ``peers/name.c``, compiled against libmodbus; skipped by name without it."""
    folder = tmp_path_factory.mktemp("peers")

    def compile_once(name: str) -> str:
        compiler = peer("gcc", "gcc libc6-dev")
        headers = Path("/usr/include/modbus")
        if not headers.is_dir():
            pytest.skip(f"{PEER_MISSING}: libmodbus (apt install libmodbus-dev)")
        program, source = folder / name, PEERS / f"{name}.c"
        if not program.exists():
            command = [compiler, "-O2", "-Wall", "-Werror", f"-I{headers}", str(source), "-o", str(program), "-lmodbus"]
            subprocess.run(command, check=True, timeout=60)
        return str(program)

    return compile_once


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Iterator[None]:
    """Where REQUIRE_PEERS is set (CI), a test whose foreign peer is missing has failed."""
    report = yield
    if report.skipped and os.environ.get("REQUIRE_PEERS") and PEER_MISSING in str(report.longrepr):
        report.outcome = "failed"
        report.longrepr = f"{item.nodeid}: {report.longrepr[2]}"
    return report
