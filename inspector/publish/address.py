"""Where the registers are served, told to programs of this machine in a file of the service's runtime folder.

The settings file does not say: it may have been edited since.
"""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Mapping
from pathlib import Path

from firmware_bridge import whole_file

log = logging.getLogger(__name__)

NAME = "address"
EVERYWHERE = {"0.0.0.0": "127.0.0.1", "::": "::1"}
"""Addresses to listen on that are none to connect to, and what is instead."""


def tell(host: str, port: int, unit: int, environment: Mapping[str, str] = os.environ) -> None:
    """Say where the registers are from now on, if systemd gave a folder for it (RuntimeDirectory=)."""
    folder = environment.get("RUNTIME_DIRECTORY", "").split(":")[0]
    if not folder:
        return
    file = Path(folder, NAME)
    try:
        whole_file.write(file, json.dumps([EVERYWHERE.get(host, host), port, unit]) + "\n")
        file.chmod(0o644)
    except OSError as error:
        log.error("%s: cannot be written (%s): nobody can watch over the service", file, error)


def told(file: Path) -> tuple[str, int, int]:
    """Host, port and unit of the registers, by a file that :func:`tell` wrote. Raises OSError or ValueError."""
    host, port, unit = json.loads(file.read_text(encoding="utf-8"))
    return str(host), int(port), int(unit)
