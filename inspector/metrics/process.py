"""What the kernel tells of this process (proc(5)), by the names that all exporters use."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path

TICKS_HZ, PAGE_BYTES = os.sysconf("SC_CLK_TCK"), os.sysconf("SC_PAGE_SIZE")


@dataclass(frozen=True, slots=True)
class Process:
    """The process at one moment."""

    resident_bytes: int
    open_fds: int
    threads: int
    cpu_s: float
    """Processor time of all threads since its start."""
    started_s: float
    """Unix time of its start."""


def now() -> Process:
    """This process now. Raises OSError."""
    # The second field is the program's name in brackets, which may hold anything; the third comes first here.
    fields = Path("/proc/self/stat").read_text().rpartition(")")[2].split()
    user, system, threads, started, pages = (int(fields[n - 3]) for n in (14, 15, 20, 22, 24))
    up_s = time.clock_gettime(time.CLOCK_BOOTTIME) - started / TICKS_HZ
    fds = len(os.listdir("/proc/self/fd")) - 1  # one is of the listing itself
    return Process(pages * PAGE_BYTES, fds, threads, (user + system) / TICKS_HZ, time.time() - up_s)
