"""A simulated I/O module as a process: python -m firmware_bridge.simulators.module --profile ato-4ch --unit 1

Its first line on standard output is the address it serves: the pseudo-terminal's path, or host:port.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

from firmware_bridge.simulators.module_server import ModuleServer, WireFault
from firmware_bridge.simulators.module_state import SimulatedModule
from firmware_bridge.simulators.server import run as server_run
from firmware_bridge.wire.profiles import PROFILES


def run(
    profile: str,
    unit: int,
    *,
    symlink: Path | None = None,
    tcp_port: int | None = None,
    fault: WireFault = WireFault.NONE,
    fault_after: int = 0,
    fault_count: int | None = None,
    ascii: bool = False,
    stuck: bool = False,
    tripped: bool = False,
    with_parent: bool = False,
) -> None:
    """Print the address and serve until SIGTERM or SIGINT, or (``with_parent``) until standard input is closed.

    With ``tcp_port``, or if its profile has no serial line, it is served over TCP. Raises FileExistsError if
    ``symlink`` is a file's name, OSError if the port is taken, ValueError for what does not go together.
    """
    row = PROFILES[profile]
    tcp = tcp_port is not None or not row.has_serial
    for option, asked in (("--symlink", symlink), ("--ascii", ascii)):
        if asked and tcp:
            raise ValueError(f"{option}: {profile} has no serial line here; it is served over TCP")
    if tripped and row.watchdog is None:
        raise ValueError(f"--tripped: {profile} has no watchdog")
    module = SimulatedModule(row, time.monotonic)
    module.ascii, module.stuck = ascii, stuck
    if tripped:
        module.trip()
    server = ModuleServer(module, unit, tcp=tcp, tcp_port=tcp_port or 0, symlink=symlink)
    server.fault, server.fault_after, server.fault_count = fault, fault_after, fault_count
    server_run(server, with_parent=with_parent)


def main(arguments: Sequence[str] | None = None, program: str | None = None) -> None:
    """Parse a command line (None: this process') and run; wrong options end the process with status 2."""
    parser = argparse.ArgumentParser(
        prog=program, description="A simulated I/O module: prints its pseudo-terminal or host:port, then serves it."
    )
    parser.add_argument("--profile", choices=list(PROFILES), required=True, help="which module it is")
    parser.add_argument("--unit", type=int, choices=range(1, 248), metavar="1-247", default=1, help="Modbus unit id")
    parser.add_argument("--symlink", type=Path, metavar="PATH", help="name to give the pseudo-terminal")
    parser.add_argument("--tcp-port", type=int, metavar="N", help="serve Modbus TCP here, not a terminal; 0: any free")
    faults = [fault.value for fault in WireFault]
    parser.add_argument("--fault", choices=faults, default=WireFault.NONE.value, help="what goes wrong with answers")
    parser.add_argument("--fault-after", type=int, metavar="N", default=0, help="only after so many right answers")
    parser.add_argument("--fault-count", type=int, metavar="N", help="only for so many answers; default: for ever")
    parser.add_argument("--ascii", action="store_true", help="it speaks its maker's own protocol, and no Modbus")
    parser.add_argument("--stuck", action="store_true", help="outputs take levels and stay where they are")
    parser.add_argument("--tripped", action="store_true", help="its watchdog has tripped")
    parser.add_argument("--with-parent", action="store_true", help="end when standard input is closed")
    options = vars(parser.parse_args(arguments))
    try:
        run(**options | {"fault": WireFault(options["fault"])})
    except (OSError, ValueError) as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
