"""How long `inspector run` takes to its first answered register and to READY, and what memory it takes.

    .venv/bin/python benchmarks/start.py > benchmarks/start.txt

Two stations of 640x480 frames: the demo (config/demo.yaml: recorded frames, simulated module), and one with the real
drivers of a CCD head and a module, each on a pseudo-terminal of a simulator in a process of its own. Times are from
the process' start to the answer of a client that asks every 5 ms. Processor time is what the service's own threads used
up to then, and says what a quiet machine would take: wall time on a busy one says how busy it is. Memory is resident
memory after so many inspected panels, and the peak. Bytecode is there and files are in the page cache, but for the
first row: a start that compiles everything, the libraries too.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path

from station import cpu_s, memory_mib, registers, settings_file

from inspector.publish.registers import Status

INSPECTOR = str(Path(sys.executable).with_name("inspector"))
START_S, POLL_S = 60.0, 0.005
SEQUENCE, STATUS = 0, 4

COLUMNS = ("answered s", "at work s", "READY s", "at work s", "RSS MiB", "peak MiB")


def waited(port: int, asked: Callable[[tuple[int, ...]], bool]) -> None:
    """Until the registers are as asked. Raises SystemExit after a minute."""
    ends_s = time.monotonic() + START_S
    while time.monotonic() < ends_s:
        with contextlib.suppress(OSError):
            if asked(registers(port, 0, 5)):
                return
        time.sleep(POLL_S)
    raise SystemExit(f"port {port}: not as asked in {START_S:g} s")


def measured(file: Path, port: int, panels: int, environment: Mapping[str, str]) -> tuple[float, ...]:
    """One start: a value for each column."""
    started_s = time.monotonic()
    process = subprocess.Popen(
        [INSPECTOR, "run", "--config", str(file)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=environment
    )
    try:
        waited(port, lambda _: True)
        answered = time.monotonic() - started_s, cpu_s(process.pid)
        waited(port, lambda now: bool(now[STATUS] & Status.READY))
        ready = time.monotonic() - started_s, cpu_s(process.pid)
        waited(port, lambda now: now[SEQUENCE] >= panels)
        return *answered, *ready, memory_mib(process.pid), memory_mib(process.pid, "VmHWM")
    finally:
        process.terminate()
        process.wait()


def simulated(stack: contextlib.ExitStack, *arguments: str) -> str:
    """A simulated device in a process of its own; its pseudo-terminal's path."""
    command = [INSPECTOR, "simulate-device", *arguments]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    stack.callback(process.wait)
    stack.callback(process.terminate)
    assert process.stdout
    return process.stdout.readline().strip()


def serial_station(stack: contextlib.ExitStack, folder: Path) -> tuple[Path, int]:
    """Settings of a station with real drivers on serial lines, and its port."""
    pipe = str(folder / "frames")
    head = simulated(stack, "ccd", "--dialect", "dalsa", "--frames", pipe, "--header", "--rate-hz", "10")
    module = simulated(stack, "module", "--profile", "tm-da1p1r1")
    frames = {"kind": "raw", "path": pipe, "width_px": 640, "height_px": 480, "header": True}
    return settings_file(
        folder,
        camera={"kind": "serial_ccd", "dialect": "dalsa", "port": head, "frames": frames},
        module={"profile": "tm-da1p1r1", "link": {"kind": "serial", "port": module}},
    )


def row(name: str, values: tuple[float, ...]) -> None:
    print(f"{name:22}" + "".join(f"{value:12.2f}" for value in values), flush=True)


def report(name: str, runs: list[tuple[float, ...]]) -> None:
    row(f"{name}, median", tuple(map(statistics.median, zip(*runs, strict=True))))
    row(f"{name}, best", tuple(map(min, zip(*runs, strict=True))))


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--runs", type=int, default=15)
    options.add_argument("--panels", type=int, default=20, help="inspected before memory is looked at")
    asked = options.parse_args()
    print(f"{platform.machine()}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}, ", end="")
    print(f"Python {platform.python_version()}; {asked.runs} starts, memory after {asked.panels} panels")
    print(f"{'':22}" + "".join(f"{column:>12}" for column in COLUMNS))
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        stations = {"demo": settings_file(folder), "serial devices": serial_station(stack, folder)}
        # Bytecode in a folder of its own, which the first start fills, whatever the shell says of writing any.
        environment = os.environ | {"PYTHONPYCACHEPREFIX": str(folder / "bytecode"), "PYTHONDONTWRITEBYTECODE": ""}
        row("demo, first of all", measured(*stations["demo"], 1, environment))
        for name, (file, port) in stations.items():
            report(name, [measured(file, port, asked.panels, environment) for _ in range(asked.runs)])


if __name__ == "__main__":
    main()
