"""What `make dist` makes, in a fresh environment: the wheel, and the source distribution compiled anew."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytestmark = [pytest.mark.long, pytest.mark.timeout(900)]

REPOSITORY = Path(__file__).parents[2]
HASHED = ["--quiet", "--disable-pip-version-check", "--require-hashes", "-r", str(REPOSITORY / "requirements.txt")]


def run(*command: Any) -> str:
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def dist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("dist")
    run(sys.executable, REPOSITORY / "deploy/build_wheel.py", "--output", folder)
    return folder


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A fresh virtual environment that has the locked dependencies, and not this program."""
    folder = tmp_path_factory.mktemp("fresh")
    run(sys.executable, "-m", "venv", folder)
    run(folder / "bin/pip", "install", *HASHED)
    return folder


@pytest.mark.parametrize("kind", ["*.whl", "*.tar.gz"])
def test_what_is_distributed_inspects_a_frame_in_a_fresh_environment(
    dist: Path, environment: Path, kind: str, frames_folder: Path
) -> None:
    (file,) = dist.glob(kind)
    run(environment / "bin/pip", "install", "--quiet", "--no-deps", "--no-build-isolation", "--force-reinstall", file)
    frame = [frames_folder / "four_seeds.png", "--calibration", frames_folder / "calibration.yaml", "--format", "jsonl"]
    found = json.loads(run(environment / "bin/inspector", "inspect", *frame))
    assert len(found["defects"]) == 4


def test_a_wheel_serves_every_python_of_its_machine(dist: Path) -> None:
    (wheel,) = dist.glob("*.whl")
    assert wheel.stem.split("-")[2:4] == ["cp311", "abi3"]


def test_the_same_tree_gives_the_same_wheel_again(dist: Path, tmp_path: Path) -> None:
    run(sys.executable, REPOSITORY / "deploy/build_wheel.py", "--output", tmp_path)
    (first,), (again,) = dist.glob("*.whl"), tmp_path.glob("*.whl")
    assert first.read_bytes() == again.read_bytes()
