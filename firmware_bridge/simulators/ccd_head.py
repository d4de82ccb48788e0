"""A simulated CCD head as a process: python -m firmware_bridge.simulators.ccd_head --dialect dalsa --frames PATH

Its first line on standard output is its pseudo-terminal's path.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from firmware_bridge.simulators.ccd_frames import FrameFault
from firmware_bridge.simulators.ccd_server import CcdServer, LineFault
from firmware_bridge.simulators.ccd_state import SimulatedCcdHead
from firmware_bridge.simulators.server import run
from firmware_bridge.wire.ccd_dialects import DIALECTS
from firmware_bridge.wire.raw_frames import RawFormat


def serve(options: argparse.Namespace) -> None:
    """Serve until told to end. Raises OSError if a path cannot be used."""
    head = SimulatedCcdHead(DIALECTS[options.dialect], options.exposure_min_us, options.exposure_max_us)
    head.read_back_us = options.read_back_us
    form = RawFormat(options.width_px, options.height_px, options.bits, options.header)
    server = CcdServer(head, symlink=options.symlink, frames=options.frames, form=form, rate_hz=options.rate_hz)
    server.fault = LineFault(options.fault)
    if server.writer:
        server.writer.fault = FrameFault(options.frame_fault)
    run(server, with_parent=options.with_parent)


def _parser(program: str | None) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=program, description="A simulated CCD head: prints its pseudo-terminal's path, then serves it."
    )
    add = parser.add_argument
    add("--dialect", choices=list(DIALECTS), required=True, help="what it speaks")
    add("--symlink", type=Path, metavar="PATH", help="name to give the pseudo-terminal")
    add("--frames", type=Path, metavar="PATH", help="named pipe for its frames, made if missing; or an existing file")
    add("--header", action="store_true", help="each frame has 32 bytes of header: number, shape, exposure, time")
    add("--rate-hz", type=float, metavar="HZ", default=10.0, help="frames a second; default 10")
    add("--width-px", type=int, metavar="N", default=640, help="pixels in a row; default 640")
    add("--height-px", type=int, metavar="N", default=480, help="rows; default 480")
    add("--bits", type=int, choices=(8, 16), default=8, help="bits of a pixel; default 8")
    add("--exposure-min-us", type=float, metavar="US", help="shortest exposure; default 1")
    add("--exposure-max-us", type=float, metavar="US", help="longest exposure; default 1000000")
    add("--read-back-us", type=float, metavar="US", help="what it says its exposure is, whatever it is")
    add("--fault", choices=[f.value for f in LineFault], default=LineFault.NONE.value, help="what its answers suffer")
    frame_faults = [fault.value for fault in FrameFault]
    add("--frame-fault", choices=frame_faults, default=FrameFault.NONE.value, help="what its frames suffer")
    add("--with-parent", action="store_true", help="end when standard input is closed")
    return parser


def main(arguments: Sequence[str] | None = None, program: str | None = None) -> None:
    """Parse a command line (None: this process') and run; wrong options end the process with status 2."""
    parser = _parser(program)
    options = parser.parse_args(arguments)
    try:
        serve(options)
    except (OSError, ValueError) as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
