"""A clean Debian 12, without Python: what a station's computer is before anything is installed.

Made once by debootstrap, with the packages that tests install in it downloaded, and kept in the user's cache.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from pathlib import Path

RELEASE = "bookworm"
BASE = "systemd-sysv,udev,dbus"
LATER = ("python3", "procps", "libaravis-0.8-0", "mbpoll")
"""Downloaded, not installed: with them apt finds all that the package depends on and recommends, without a network."""


class CannotBeMade(Exception):
    """Debian's packages are out of reach; the message has what was said."""


def files() -> Path:
    """The folder that holds its files."""
    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "seed-inspector"
    found = cache / f"{RELEASE}-{'-'.join(LATER)}"
    if not found.exists():
        cache.mkdir(parents=True, exist_ok=True)
        making = Path(tempfile.mkdtemp(dir=cache))
        try:
            make(making)
        except CannotBeMade:
            shutil.rmtree(making)
            raise
        making.replace(found)
    return found


def make(root: Path) -> None:
    """Fill an empty folder."""
    run("debootstrap", "--variant=minbase", f"--include={BASE}", RELEASE, root)
    root.chmod(0o755)
    run("chroot", root, "apt-get", "update")
    run("chroot", root, "apt-get", "install", "--yes", "--download-only", *LATER)


def unpack(architecture: str, packages: str, root: Path) -> None:
    """Fill an empty folder with the files of an architecture's packages: nothing in them has run."""
    run(
        "debootstrap",
        f"--arch={architecture}",
        "--foreign",
        "--variant=minbase",
        f"--include={packages}",
        RELEASE,
        root,
    )
    for package in sorted(root.glob("var/cache/apt/archives/*.deb")):
        run("dpkg-deb", "--extract", package, root)


def run(*command: str | Path) -> None:
    """A command that has to succeed. Raises CannotBeMade."""
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True, timeout=900)
    if done.returncode:
        raise CannotBeMade(f"{command}: {done.returncode}\n{done.stdout[-2000:]}{done.stderr}")
