"""What the service says on the terminal: how to poll it, and one line for each panel."""

from __future__ import annotations

import os
import sys

from inspector.faults import Fault
from inspector.model import Snapshot, Verdict
from inspector.publish.address import EVERYWHERE
from inspector.publish.registers import RESULT_ADDRESS, RESULT_WORDS

GREEN, RED, YELLOW, PLAIN = "\x1b[32m", "\x1b[31m", "\x1b[33m", "\x1b[0m"
COLOURS = {Verdict.PASS: GREEN, Verdict.FAIL: RED, Verdict.NOT_INSPECTED: YELLOW}
HEIGHTS_SHOWN = 8
"""More heights than this are counted, not listed, so that a panel stays one line."""


def say(line: str) -> None:
    """Print a line at once. A reader that went away is no fault of the station's."""
    try:
        print(line, flush=True)
    except OSError:
        # What follows goes nowhere, and the interpreter's own flush at exit finds nothing to complain about.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def how_to_poll(host: str, port: int) -> str:
    """Where the registers are, and the command line that reads the result block once."""
    reachable = EVERYWHERE.get(host, host)
    return (
        f"Registers: Modbus TCP on {host}:{port}; `inspector registers` says what they mean. Read them with:\n"
        f"  mbpoll -m tcp -0 -1 -t 4 -r {RESULT_ADDRESS} -c {RESULT_WORDS} -p {port} {reachable}"
    )


def panel_line(snapshot: Snapshot, name: str, texts: tuple[str, ...], *, coloured: bool = True) -> str:
    """One panel: number, verdict, defects with their heights, time, frame, and why."""
    verdict = f"{snapshot.verdict.name:13}"
    if coloured:
        verdict = f"{COLOURS[snapshot.verdict]}{verdict}{PLAIN}"
    fault = next(fault for fault in Fault if fault == snapshot.fault_code)
    why = texts or ((f"{fault.name}: {fault.meaning}",) if fault else ())
    seen = f"{_defects(snapshot):44}  {snapshot.elapsed_us / 1000:7.2f} ms  {name}" if name else ""
    return f"#{snapshot.sequence:<6} {verdict}  {'  '.join(filter(None, (seen, '; '.join(why))))}".rstrip()


def frames_of(snapshot: Snapshot) -> str:
    """Which panel of several frames, and of how many."""
    count = snapshot.panel_frames
    return f"panel {snapshot.panel_id}, {count} frame{'' if count == 1 else 's'}"


def _defects(snapshot: Snapshot) -> str:
    heights = sorted((defect.height_um for defect in snapshot.defects), reverse=True)
    if not heights:
        return "no seeds"
    listed = " ".join(f"{height:.0f}" for height in heights[:HEIGHTS_SHOWN])
    more = " ..." if len(heights) > HEIGHTS_SHOWN else ""
    return f"{len(heights)} seed{'s' if len(heights) > 1 else ''}: {listed}{more} um"
