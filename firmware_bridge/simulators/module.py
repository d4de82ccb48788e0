"""A simulated I/O module as a process: python -m firmware_bridge.simulators.module --profile ato-4ch --unit 1

Its first line on standard output is the address it serves: the pseudo-terminal's path, or host:port.
"""

from __future__ import annotations

import argparse
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from types import FrameType

from firmware_bridge.simulators.module_server import ModuleServer, WireFault
from firmware_bridge.simulators.module_state import SimulatedModule
from firmware_bridge.wire.profiles import PROFILES


def run(
    profile: str,
    unit: int,
    *,
    symlink: Path | None = None,
    fault: WireFault = WireFault.NONE,
    fault_after: int = 0,
    fault_count: int | None = None,
    with_parent: bool = False,
) -> None:
    """Print the address and serve until SIGTERM or SIGINT, or (``with_parent``) until standard input is closed.

    A profile that has no serial line is served over TCP. Raises FileExistsError if ``symlink`` is a file's name.
    """
    row = PROFILES[profile]
    module = SimulatedModule(row, time.monotonic)
    server = ModuleServer(module, unit, tcp=not row.has_serial, symlink=symlink)
    server.fault, server.fault_after, server.fault_count = fault, fault_after, fault_count
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, _end)
    try:
        print(server.address, flush=True)
        server.serve(sys.stdin.fileno() if with_parent else None)
    finally:
        server.stop()


def _end(number: int, frame: FrameType | None) -> None:
    raise SystemExit(0)


def main(arguments: Sequence[str] | None = None) -> None:
    """Parse a command line and run."""
    parser = argparse.ArgumentParser(description="A simulated I/O module behind a pseudo-terminal or a TCP port.")
    parser.add_argument("--profile", choices=list(PROFILES), required=True)
    parser.add_argument("--unit", type=int, default=1)
    parser.add_argument("--symlink", type=Path)
    parser.add_argument("--fault", type=WireFault, choices=list(WireFault), default=WireFault.NONE)
    parser.add_argument("--fault-after", type=int, default=0)
    parser.add_argument("--fault-count", type=int)
    parser.add_argument("--with-parent", action="store_true", help="end when standard input is closed")
    run(**vars(parser.parse_args(arguments)))


if __name__ == "__main__":
    main()
