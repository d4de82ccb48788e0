"""Secrets that systemd hands to the service (LoadCredential=): files that only root and the running service can read.

A setting names one as ``credential:NAME``, in the place of a path.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, Field

PREFIX = "credential:"
FOLDER = "CREDENTIALS_DIRECTORY"
"""The environment's variable in which systemd says where they are (systemd.exec(5))."""
STORE = Path("/etc/credstore")
"""Where systemd takes them from."""


def _found(path: Path) -> Path:
    """The credential's file for ``credential:NAME``, any other path as it is. Raises ValueError.

    Outside of a service it is the file that systemd would hand over, so that root can check settings. Whether it is
    there is not looked at: other users' programs read the settings too.
    """
    if not str(path).startswith(PREFIX):
        return path
    name = str(path).removeprefix(PREFIX)
    if Path(name).name != name or not name:
        raise ValueError(f"allowed: {PREFIX}NAME, without a folder")
    return Path(os.environ.get(FOLDER) or STORE, name)


def remedy(file: Path) -> str:
    """What makes a secret's file one that the service may read."""
    if is_credential(file) or file.parent == STORE:
        return f"a unit with LoadCredential={file.name} and the file {STORE / file.name}"
    return "give a file that the service may read"


def is_credential(file: Path) -> bool:
    """Whether a file is one that systemd handed over, and keeps from everybody else."""
    folder = os.environ.get(FOLDER)
    return folder is not None and file.is_relative_to(folder)


SecretPath = Annotated[Path, Field(strict=False), AfterValidator(_found)]
"""A file with a secret: a path, or ``credential:NAME``."""
