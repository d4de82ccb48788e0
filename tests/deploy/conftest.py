"""Debian packages of this tree, built once for the tests that take them apart or install them."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

PEER_MISSING = "peer missing"
BUILD = Path(__file__).parents[2] / "deploy/build_deb.py"


@pytest.fixture(scope="session")
def built(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """``built(*options)``: a package, not compressed."""

    def build(*options: str) -> Path:
        folder = tmp_path_factory.mktemp("package")
        command = [sys.executable, str(BUILD), "--compression", "none", "--output", str(folder), *options]
        done = subprocess.run(command, capture_output=True, text=True, timeout=900)
        assert done.returncode == 0, done.stdout + done.stderr
        return Path(done.stdout.strip())

    return build


@pytest.fixture(scope="session")
def package(built: Callable[..., Path]) -> Path:
    """The package for this machine."""
    return built()


@pytest.fixture(scope="session")
def unpacked(package: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """That package's files and control files, to be looked at, or packed again otherwise."""
    folder = tmp_path_factory.mktemp("unpacked") / "tree"
    subprocess.run(["dpkg-deb", "--raw-extract", str(package), str(folder)], check=True, timeout=300)
    return folder


@pytest.fixture(scope="session")
def debian_files(peer: Callable[[str, str], str]) -> Path:
    """The files of a clean Debian 12."""
    import clean_debian

    peer("debootstrap", "debootstrap")
    try:
        return clean_debian.files()
    except clean_debian.CannotBeMade as error:
        pytest.skip(f"{PEER_MISSING}: {error}")


@pytest.fixture
def machine(booted: Any) -> Any:
    """A machine that has come up; nothing is installed."""
    booted.boot()
    return booted
