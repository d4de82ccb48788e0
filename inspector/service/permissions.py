"""Who else may read the station's secrets or change its settings: looked at by the service's start and the doctor."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from inspector.credential import is_credential
from inspector.settings import Settings

_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH
_OTHERS_READ = stat.S_IRGRP | stat.S_IROTH


@dataclass(frozen=True, slots=True)
class Misfit:
    """Something that others may do with a file, and what to do about it."""

    path: Path
    found: str
    remedy: str

    def __str__(self) -> str:
        return f"{self.path}: {self.found}; {self.remedy}"


def misfits(file: Path, settings: Settings, state_folder: Path | None) -> Iterator[Misfit]:
    """What is wrong with the settings' file, with what they name, and with the folder for the service's state (None: it
    has none). Files that are not there are for others to find."""
    for path in (file, file.absolute().parent, settings.calibration):
        if _mode(path) & stat.S_IWOTH:
            yield Misfit(path, "everybody may write it, and so tell the station what is good", f"chmod o-w {path}")
    key = settings.plc.tls.key if settings.plc.tls else None
    if key is not None and not is_credential(key) and _mode(key) & _OTHERS_READ:
        remedy = f"chmod 600 {key}, and LoadCredential= for a service with a user of its own"
        yield Misfit(key, "others than its owner may read the private key", remedy)
    if state_folder is not None:
        yield from _state(state_folder)


def _state(folder: Path) -> Iterator[Misfit]:
    try:
        owner = folder.stat().st_uid
    except OSError as error:
        yield Misfit(folder, f"the folder for state cannot be used: {error.strerror}", "StateDirectory= makes it")
        return
    if owner != os.geteuid() or not os.access(folder, os.W_OK):
        found = f"the folder for state is owned by user {owner}, the service runs as {os.geteuid()}"
        yield Misfit(folder, f"{found}: nothing is kept over a restart", f"chown -R {os.geteuid()} {folder}")
    elif _mode(folder) & _OTHERS_WRITE:
        yield Misfit(folder, "others may write what the service keeps over restarts", f"chmod go-w {folder}")


def _mode(path: Path) -> int:
    try:
        return path.stat().st_mode
    except OSError:
        return 0
