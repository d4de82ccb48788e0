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
    """The credential's file for ``credential:NAME``, any other path as it is. Raises ValueError if there is none.

    Outside of a service it is the file that systemd would hand over, so that root can check settings.
    """
    if not str(path).startswith(PREFIX):
        return path
    name = str(path).removeprefix(PREFIX)
    if Path(name).name != name:
        raise ValueError(f"allowed: {PREFIX}NAME, without a folder")
    file = Path(os.environ.get(FOLDER) or STORE, name)
    if not os.path.isfile(file):
        raise ValueError(f"there is no such credential; allowed: a path, or a unit with {_remedy(name)}")
    return file


def _remedy(name: str) -> str:
    return f"LoadCredential={name or 'NAME'} and the file {STORE / (name or 'NAME')}"


def is_credential(file: Path) -> bool:
    """Whether a file is one that systemd handed over, and keeps from everybody else."""
    folder = os.environ.get(FOLDER)
    return folder is not None and file.is_relative_to(folder)


SecretPath = Annotated[Path, Field(strict=False), AfterValidator(_found)]
"""A file with a secret: a path, or ``credential:NAME``."""
