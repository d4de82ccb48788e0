"""A machine of its own with a real systemd as its first process: this one's files, or others, under a throw-away layer
in memory.

It has no network but its loopback, which :meth:`Booted.in_network` reaches. Whatever is left of it dies with the test.
"""

from __future__ import annotations

import ctypes
import os
import shutil
import signal
import socket
import subprocess
import sys
import sysconfig
import threading
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import inspector

Found = TypeVar("Found")

REPOSITORY = Path(inspector.__file__).parents[1]
PROGRAM = Path("/opt/inspector")
CONFIG = Path("/etc/inspector")
BOOT_S = 60.0

# The layer lives as long as the holder: until its input ends, which it does with the test at the latest.
_HOLD = """
set -e
mount -t tmpfs -o mode=755 tmpfs "$1"
mkdir "$1/upper" "$1/work" "$1/root"
mount -t overlay overlay -o "lowerdir=$2,upperdir=$1/upper,workdir=$1/work" "$1/root"
echo held
exec cat
"""
# A Python with a library of its own knows it by a path that may be in somebody's home, where the service may not go.
_COMMAND = f"""\
#!/bin/sh
LD_LIBRARY_PATH={PROGRAM}/python/lib exec {PROGRAM}/.venv/bin/python -m inspector "$@"
"""
_UNITS_OF_THIS_MACHINE = ("etc/systemd/system", *(f"etc/rc{level}.d" for level in "S0123456"))
_STATION_OF_THIS_MACHINE = ("etc/inspector", "var/lib/inspector", "var/lib/private/inspector")
# What DeviceAllow= and IPAddressDeny= of the units inside need of the kernel.
_ENVIRONMENT = {"SYSTEMD_NSPAWN_UNIFIED_HIERARCHY": "1"}
_PRIVILEGES = ("--capability=all", "--system-call-filter=bpf perf_event_open")


class CannotBoot(Exception):
    """This machine gives nobody a layer or namespaces; the message has what it said."""


class Booted:
    """A machine that is off at first. Its files are under ``root``, off or on, and stay over a power cut; at first they
    are those under ``files``."""

    def __init__(self, folder: Path, files: Path = Path("/")) -> None:
        self._binds: list[str] = []
        self._machine: subprocess.Popen[bytes] | None = None
        self._leader = 0
        self._log = folder / "console.log"
        self._held = folder / "machine"
        self._held.mkdir()
        hold = ["unshare", "--mount", "--propagation", "private", "sh", "-c", _HOLD, "sh", str(self._held), str(files)]
        self._holder = subprocess.Popen(hold, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        assert self._holder.stdout is not None
        assert self._holder.stderr is not None
        if self._holder.stdout.readline() != b"held\n":
            raise CannotBoot(self._holder.stderr.read().decode())
        self.root = Path(f"/proc/{self._holder.pid}/root{self._held}/root")
        self._forget_this_machine()

    def _forget_this_machine(self) -> None:
        """Nothing that is enabled here starts there, and no station's files are there."""
        for name in _STATION_OF_THIS_MACHINE:
            shutil.rmtree(self.root / name, ignore_errors=True)
        for name in _UNITS_OF_THIS_MACHINE:
            shutil.rmtree(self.root / name, ignore_errors=True)
            (self.root / name).mkdir()
        (self.root / "etc/machine-id").write_text(uuid.uuid4().hex + "\n")
        (self.root / "etc/hostname").write_text("station\n")

    def install_project(self) -> None:
        """Put the program where its unit expects it, as a virtual environment over this checkout, and its unit."""
        base, python = Path(sys.base_prefix), f"python{sys.version_info.major}.{sys.version_info.minor}"
        parts = {"python": base, "code": REPOSITORY, "site": Path(sysconfig.get_path("purelib"))}
        folder = self.root / PROGRAM.relative_to("/")
        for name, source in parts.items():
            (folder / name).mkdir(parents=True)
            self._binds.append(f"--bind-ro={source}:{PROGRAM / name}")
        packages = folder / f".venv/lib/{python}/site-packages"
        packages.mkdir(parents=True)
        (packages / "parts.pth").write_text(f"{PROGRAM / 'code'}\n{PROGRAM / 'site'}\n")
        (folder / ".venv/bin").mkdir()
        (folder / ".venv/pyvenv.cfg").write_text(f"home = {PROGRAM / 'python/bin'}\n")
        (folder / ".venv/bin/python").symlink_to(PROGRAM / "python/bin" / python)
        command = folder / ".venv/bin/inspector"
        command.write_text(_COMMAND)
        command.chmod(0o755)
        (self.root / "usr/bin/inspector").symlink_to(f"{PROGRAM}/.venv/bin/inspector")

    def boot(self) -> None:
        """Switch on, and wait until all that is enabled has started."""
        address = self._held.with_suffix(".ready")
        address.unlink(missing_ok=True)
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as told, self._log.open("ab") as log:
            told.bind(str(address))
            told.settimeout(BOOT_S)
            environment = os.environ | _ENVIRONMENT | {"NOTIFY_SOCKET": str(address)}
            self._machine = subprocess.Popen(
                self._command(), stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=environment
            )
            said: dict[str, str] = {}
            while "READY" not in said:
                try:
                    lines = told.recv(4096).decode().splitlines()
                except TimeoutError:
                    raise AssertionError(f"not up in {BOOT_S:g} s:\n{self._log.read_text()}") from None
                said |= dict(line.split("=", 1) for line in lines if "=" in line)
        self._leader = int(said["X_NSPAWN_LEADER_PID"])

    def _command(self) -> list[str]:
        held = ["setpriv", "--pdeathsig", "KILL", "nsenter", "--mount", "--target", str(self._holder.pid)]
        own = ["--register=no", "--keep-unit", "--private-network", "--link-journal=no", "--notify-ready=yes"]
        machine = ["systemd-nspawn", "--quiet", "--directory", f"{self._held}/root", "--machine", self._name, *own]
        return [*held, *machine, *_PRIVILEGES, *self._binds, "--console=pipe", "--boot"]

    @property
    def _name(self) -> str:
        return f"station-{self._holder.pid}"

    def run(self, *command: str, check: bool = True, **options: Any) -> subprocess.CompletedProcess[str]:
        """A command inside, as root; ``options`` as :func:`subprocess.run`. A failure shows what it said."""
        enter = ["nsenter", "--target", str(self._leader), "--all", "--root", "--wd", "--"]
        options = {"capture_output": True, "text": True, "timeout": 60} | options
        done = subprocess.run([*enter, *command], **options)
        assert not check or done.returncode == 0, f"{command}: {done.returncode}\n{done.stdout}{done.stderr}"
        return done

    def in_network(self, call: Callable[[], Found]) -> Found:
        """What ``call`` returns inside this machine's network: sockets that it opens stay there."""
        found: list[Found] = []
        failed: list[BaseException] = []

        def enter() -> None:
            try:
                with Path(f"/proc/{self._leader}/ns/net").open("rb") as network:
                    if ctypes.CDLL(None, use_errno=True).setns(network.fileno(), 0):
                        raise OSError(ctypes.get_errno(), "setns")
                found.append(call())
            except BaseException as error:
                failed.append(error)

        thread = threading.Thread(target=enter)
        thread.start()
        thread.join()
        if failed:
            raise failed[0]
        return found[0]

    def journal(self, unit: str) -> list[str]:
        """What a unit has said since the machine was first booted, oldest first."""
        self.run("journalctl", "--sync")
        return self.run("journalctl", "--unit", unit, "--output=cat").stdout.splitlines()

    def cut_power(self) -> None:
        """Every process inside ends at once. What was written stays, also what no disk would have yet."""
        if self._machine is not None:
            if self._leader:
                os.kill(self._leader, signal.SIGKILL)
            else:
                self._machine.kill()
            self._machine.wait(30)
        self._machine, self._leader = None, 0

    def close(self) -> None:
        """Take it away, with all that it wrote."""
        self.cut_power()
        self._holder.communicate(timeout=30)
