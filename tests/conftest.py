"""What all tests share: waiting with a deadline, foreign peers, frames. Nothing here fixes a port or a path."""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from threading import Event
from typing import Any

import pytest
from hypothesis import settings

# Tests start hundreds of processes; without bytecode each compiles the sources anew, and each worker all tests.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# The same examples in every run, so more of them would show the same again and again: a measurement's tolerance is met
# or not. `--hypothesis-profile search` looks further, each time elsewhere (make soak).
settings.register_profile("repeatable", derandomize=True, deadline=None, max_examples=30)
settings.register_profile("search", deadline=None, max_examples=200)
settings.load_profile("repeatable")

DATA = Path(__file__).parent / "data"
PEERS = Path(__file__).parent / "peers"
PEER_MISSING = "peer missing"
DEV_PACKAGES = {"libmodbus": "libmodbus-dev", "aravis-0.8": "libaravis-dev libusb-1.0-0-dev"}
"""Where a library's headers are, by its pkg-config name."""


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
def compiled_peer(peer: Callable[[str, str], str], tmp_path_factory: pytest.TempPathFactory) -> Callable[..., str]:
    """``compiled_peer(name, library="libmodbus")``: the path of ``peers/name.c``, compiled against a library (by its
    pkg-config name); skipped by name without it."""
    folder = tmp_path_factory.mktemp("peers")

    def compile_once(name: str, library: str = "libmodbus") -> str:
        compiler, packages = peer("gcc", "gcc libc6-dev"), peer("pkg-config", "pkg-config")
        flags = subprocess.run([packages, "--cflags", "--libs", library], capture_output=True, text=True, timeout=60)
        if flags.returncode:
            pytest.skip(f"{PEER_MISSING}: {library} (apt install {DEV_PACKAGES[library]})")
        program, source = folder / name, PEERS / f"{name}.c"
        if not program.exists():
            command = [compiler, "-O2", "-Wall", "-Werror", str(source), "-o", str(program), *flags.stdout.split()]
            subprocess.run([*command, "-lm"], check=True, timeout=60)
        return str(program)

    return compile_once


@pytest.fixture(scope="session")
def npm_peers(peer: Callable[[str, str], str], tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """``npm_peers(source, names)``: a folder with what the package-lock.json in ``source`` names; skipped by name where
    it cannot be had."""

    def install(source: Path, names: str, deadline_s: float = 100) -> Path:
        npm, folder = peer("npm", "npm"), tmp_path_factory.mktemp("npm")
        for name in ("package.json", "package-lock.json"):
            shutil.copy(source / name, folder)
        command = [npm, "ci", "--omit=optional", "--ignore-scripts", "--no-audit", "--no-fund"]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=deadline_s, check=False)
        if done.returncode:
            pytest.skip(f"{PEER_MISSING}: {names} (npm ci: {done.stderr.strip()[-200:]})")
        return folder

    return install


@pytest.fixture
def threads_alternate() -> Iterator[None]:
    """Let threads take turns often: more chances to tear a read, and less waiting for the interpreter's turn."""
    usual = sys.getswitchinterval()
    sys.setswitchinterval(0.0002)
    yield
    sys.setswitchinterval(usual)


@pytest.fixture
def gige_camera(compiled_peer: Any, frames_folder: Path, wait_until: Any, tmp_path: Path) -> Iterator[Any]:
    """``gige_camera(features, lost)``: a GigE Vision camera on 127.0.0.1 that shows a frame; see support/gige.py."""
    import gige

    program = compiled_peer("gige_camera", "aravis-0.8")
    with contextlib.ExitStack() as stack:
        turn = stack.enter_context(gige.Turn())
        wait_until(turn.taken, "the one port of GigE Vision is free", 100)

        def start(features: str = "gige_camera.xml", lost: float = 0.0) -> gige.GigeCamera:
            camera = gige.GigeCamera(program, frames_folder / "four_seeds.png", tmp_path, features, lost)
            stack.callback(camera.kill)
            camera.start()
            return camera

        yield start


@pytest.fixture
def booted_files() -> Path:
    """What a booted machine's files are at first: this machine's, unless a test's module has others."""
    return Path("/")


@pytest.fixture
def booted(booted_files: Path, peer: Callable[[str, str], str], tmp_path: Path) -> Iterator[Any]:
    """A machine with a real systemd, still off; see support/booted.py. Skipped by name where none can be had."""
    import booted

    peer("systemd-nspawn", "systemd-container")
    if os.geteuid() != 0:
        pytest.skip(f"{PEER_MISSING}: root, who alone boots a container (sudo)")
    try:
        machine = booted.Booted(tmp_path, booted_files)
    except booted.CannotBoot as error:
        pytest.skip(f"no container here: {error}")
    with contextlib.closing(machine):
        yield machine


@pytest.fixture
def disk(peer: Callable[[str, str], str]) -> Iterator[Any]:
    """``disk(folder, size_mb, kind)``: a file system of its own; see support/disk.py. Skipped by name where none can be
    had."""
    from tests.support.disk import CannotMount, Disk

    if os.geteuid() != 0:
        pytest.skip(f"{PEER_MISSING}: root, who alone mounts a disk (sudo)")
    with contextlib.ExitStack() as stack:

        def make(folder: Path, size_mb: int = 64, kind: str = "ext4", *options: str) -> Disk:
            peer(f"mkfs.{kind}", {"ext4": "e2fsprogs", "xfs": "xfsprogs"}[kind])
            try:
                made = Disk(folder, size_mb, kind, *options)
            except CannotMount as error:
                pytest.skip(f"no disk here: {error}")
            stack.callback(made.close)
            return made

        yield make


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Iterator[None]:
    """Where REQUIRE_PEERS is set (CI), a test whose foreign peer is missing has failed."""
    report = yield
    if report.skipped and os.environ.get("REQUIRE_PEERS") and PEER_MISSING in str(report.longrepr):
        report.outcome = "failed"
        report.longrepr = f"{item.nodeid}: {report.longrepr[2]}"
    return report
