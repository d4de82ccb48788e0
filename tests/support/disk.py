"""A disk of its own for an archive: power cut, read-only, taken away and back."""

from __future__ import annotations

import fcntl
import os
import struct
import subprocess
from pathlib import Path

_SHUTDOWN = 0x8004587D
"""EXT4_IOC_SHUTDOWN, XFS_IOC_GOINGDOWN: nothing that is not on the disk yet gets there any more."""
_WITHOUT_LOG = 2
_LATE = {"ext4": "commit=600,errors=remount-ro", "xfs": "logbsize=256k,nouuid"}
"""The file system writes of itself as late as it can: what is not asked for by fsync is lost."""


class CannotMount(Exception):
    """Nobody is given a disk here; the message has what was said."""


class Disk:
    """A file system in a file, mounted at ``folder``."""

    def __init__(self, folder: Path, size_mb: int = 64, kind: str = "ext4", *options: str) -> None:
        self._folder, self._kind = folder, kind
        self._image = folder.with_suffix(".disk")
        folder.mkdir(exist_ok=True)
        with self._image.open("wb") as file:
            file.truncate(size_mb * 2**20)
        _run(f"mkfs.{kind}", "-q", *options, str(self._image))
        self.mount()

    def mount(self) -> None:
        """Switch on: what was written is there, what the log has is brought into it."""
        _run("mount", "-o", f"loop,{_LATE[self._kind]}", str(self._image), str(self._folder))

    def cut_power(self) -> None:
        """From now on nothing reaches the disk; what was not on it is lost. Whoever writes is refused."""
        opened = os.open(self._folder, os.O_RDONLY)
        try:
            fcntl.ioctl(opened, _SHUTDOWN, struct.pack("I", _WITHOUT_LOG))
        finally:
            os.close(opened)

    def power_on(self) -> None:
        """After a cut: what was on the disk is there again. Of a copy, since whoever made a mount namespace meanwhile
        still has the old one."""
        self.pull()
        old, self._image = self._image, self._image.with_name(f"{self._image.name}.next")
        _run("cp", "--sparse=always", str(old), str(self._image))
        old.unlink()
        self._image = self._image.rename(old)
        if self._kind == "ext4":
            subprocess.run(["e2fsck", "-p", str(self._image)], capture_output=True, timeout=60)
        self.mount()

    def pull(self) -> None:
        """Take it away under whoever has files open there."""
        _run("umount", "--lazy", str(self._folder))

    def fail(self) -> None:
        """The kernel finds the file system wrong, and lets nobody write until :meth:`power_on`."""
        found = subprocess.run(
            ["findmnt", "-no", "SOURCE", str(self._folder)], capture_output=True, text=True, timeout=60
        )
        Path("/sys/fs/ext4", Path(found.stdout.strip()).name, "trigger_fs_error").write_text("1")

    def close(self) -> None:
        """Take it away, whatever state it is in."""
        subprocess.run(["umount", "--lazy", str(self._folder)], capture_output=True, timeout=60)
        self._image.unlink()


def _run(*command: str) -> None:
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    if done.returncode:
        raise CannotMount(f"{' '.join(command)}: {done.stderr.strip()}")
