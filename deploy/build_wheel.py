"""`make dist`: source distribution and wheel. The wheel is built from the unpacked source distribution, so that neither
holds what only lies about in this tree; the Debian package is made of the same wheel.
"""

from __future__ import annotations

import argparse
import os
import platform
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

REPOSITORY = Path(__file__).parents[1]
DIST = REPOSITORY / "dist"
MACHINES = {"amd64": "x86_64", "arm64": "aarch64"}
"""What the kernel calls each of Debian's architectures that packages are built for."""


def this_architecture() -> str:
    """Debian's name of the machine at work. Raises SystemExit on one that no package is built for."""
    for architecture, machine in MACHINES.items():
        if machine == platform.machine():
            return architecture
    sys.exit(f"{platform.machine()} is none of {', '.join(MACHINES.values())}: say which with --arch")


def environment(architecture: str) -> dict[str, str]:
    """What a build for an architecture needs to be the same each time, wherever the tree lies."""
    machine = MACHINES[architecture]
    compiler = f"{machine}-linux-gnu-gcc"
    return os.environ | {
        "SOURCE_DATE_EPOCH": str(epoch()),
        "CC": compiler,
        "LDSHARED": f"{compiler} -shared",
        "CFLAGS": "-g0",
        "_PYTHON_HOST_PLATFORM": f"linux-{machine}",
    }


def epoch() -> int:
    """Time that everything built bears, seconds: SOURCE_DATE_EPOCH, or else that of the last commit."""
    said = os.environ.get("SOURCE_DATE_EPOCH")
    if said is None:
        log = ["git", "-C", str(REPOSITORY), "log", "-1", "--format=%ct"]
        said = subprocess.run(log, capture_output=True, text=True, check=True).stdout
    return int(said)


def build(architecture: str, output: Path) -> Path:
    """The wheel, beside the source distribution in ``output``."""
    source = backend("build_sdist", REPOSITORY, output, os.environ)
    with tempfile.TemporaryDirectory() as folder:
        with tarfile.open(source) as archive:
            archive.extractall(folder, filter="data")
        (tree,) = Path(folder).iterdir()
        return backend("build_wheel", tree, output, environment(architecture))


def backend(step: str, tree: Path, output: Path, variables: os._Environ[str] | dict[str, str]) -> Path:
    """What a step of the build backend (PEP 517) made of a tree."""
    output.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=output) as made:
        call = f"from setuptools import build_meta; build_meta.{step}({made!r})"
        done = subprocess.run([sys.executable, "-c", call], cwd=tree, env=variables, capture_output=True, text=True)
        if done.returncode:
            sys.exit(f"{done.stdout}{done.stderr}\n{step} failed, as said above")
        (file,) = Path(made).iterdir()
        return file.replace(output / file.name)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description="Build the source distribution and the wheel.")
    parser.add_argument("--arch", choices=MACHINES, default=None, help="Debian's name of the machine to build for")
    parser.add_argument("--output", type=Path, default=DIST, help="folder for both")
    options = parser.parse_args()
    print(build(options.arch or this_architecture(), options.output))


if __name__ == "__main__":
    main()
