"""The PLC's side against libmodbus' own server: rate and latency of 125-register reads, on the same client's loop.

    .venv/bin/python benchmarks/plc.py > benchmarks/plc.txt

Needs libmodbus-dev, gcc and pkg-config. Idle is the real service (`inspector run`) on config/demo.yaml, triggered by
hand, that is never. Inspecting is its server and its inspection in one process, the recorded frames at 50 a second,
without the waits for a lamp's serial line. The client is tests/peers/modbus_reader.c in a process of its own: as fast
as it can, and, in rows that say so, with a pause of 1 ms after each read, since two processes that never rest leave
little of two cores to inspect on. Each round measures all in turn, so that a busy moment falls on all; ratios are
within rounds.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from station import ROOT, cpu_s, free_port, memory_mib, registers, settings_file

from inspector import imagefile, snapshots
from inspector.model import Frame, Snapshot
from inspector.publish.plc_server import PlcServer
from inspector.service.daemon import inspection_of
from inspector.settings import load

FRAMES_HZ = 50
START_S = 60.0
PAUSE_US = 1000


def compiled(name: str, folder: Path) -> str:
    """The path of a program of tests/peers, compiled against libmodbus."""
    flags = subprocess.run(
        ["pkg-config", "--cflags", "--libs", "libmodbus"], check=True, capture_output=True, text=True
    )
    program = folder / name
    source = ROOT / "tests" / "peers" / f"{name}.c"
    subprocess.run(["gcc", "-O2", str(source), "-o", str(program), *flags.stdout.split()], check=True)
    return str(program)


def started(command: list[str], port: int, stack: contextlib.ExitStack) -> str:
    """Start a station; how long it took until a register was answered, and the memory it then had."""
    started_s = time.monotonic()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    stack.callback(process.wait)
    stack.callback(process.terminate)
    while time.monotonic() < started_s + START_S:
        with contextlib.suppress(OSError):
            sequence(port)
            took_s = time.monotonic() - started_s
            return (
                f"first register answered after {took_s:.2f} s, of which {cpu_s(process.pid):.2f} s at work; "
                f"{memory_mib(process.pid):.0f} MiB"
            )
        time.sleep(0.005)
    raise SystemExit(f"{command}: no answer on port {port} in {START_S:g} s")


def inspect_for_ever(file: Path) -> None:
    """The inspecting station."""
    settings = load(file)
    server = PlcServer(stall_after_s=60.0, **settings.plc.served)
    server.start()
    inspect, shown = inspection_of(settings), Snapshot()
    images = [imagefile.read(path) for path in sorted((ROOT / "config" / "frames").glob("*.png"))]
    due_s = time.monotonic()
    for number, image in enumerate(itertools.cycle(images)):
        started_s = time.monotonic()
        frame = Frame(image, "frame", number)
        result = inspect(frame)
        now_s = time.monotonic()
        times = snapshots.Times(now_s, 1e6 * (now_s - started_s), 1e6 * (now_s - started_s))
        shown = snapshots.inspected(shown, frame, result, times)
        server.publish(shown)
        due_s = max(due_s + 1 / FRAMES_HZ, time.monotonic() - 1 / FRAMES_HZ)
        time.sleep(max(due_s - time.monotonic(), 0.0))


def sequence(port: int) -> int:
    """The 32-bit number of the last result."""
    high, low = registers(port, 42, 2)
    return high << 16 | low


def measured(reader: str, port: int, reads: int, pause_us: int) -> tuple[float, float, float, float]:
    """Reads a second; median, 99th percentile and longest in us."""
    command = [reader, "127.0.0.1", str(port), "4", "0", "125", str(reads), str(pause_us)]
    done = subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, check=True)
    seconds, *took = map(float, done.stderr.split())
    return (reads / seconds, *took)  # type: ignore[return-value]  # three that the reader prints


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--rounds", type=int, default=15)
    options.add_argument("--reads", type=int, default=10000)
    options.add_argument("--inspect", type=Path, help=argparse.SUPPRESS)
    asked = options.parse_args()
    if asked.inspect:
        inspect_for_ever(asked.inspect)
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        reader, server = compiled("modbus_reader", folder), compiled("modbus_server", folder)
        port = free_port()
        libmodbus = subprocess.Popen([server, str(port)], stdout=subprocess.PIPE)
        stack.callback(libmodbus.wait)
        stack.callback(libmodbus.kill)
        assert libmodbus.stdout
        libmodbus.stdout.readline()
        file, idle_port = settings_file(folder, cycle={"trigger": {"kind": "by_hand"}})
        inspector = str(Path(sys.executable).with_name("inspector"))
        idle = started([inspector, "run", "--config", str(file)], idle_port, stack)
        file, busy_port = settings_file(folder, cycle={"trigger": {"kind": "by_hand"}})
        started([sys.executable, __file__, "--inspect", str(file)], busy_port, stack)
        rows = {
            "libmodbus": (port, 0),
            "station idle": (idle_port, 0),
            "station inspecting": (busy_port, 0),
            "libmodbus, paused": (port, PAUSE_US),
            "idle, paused": (idle_port, PAUSE_US),
            "inspecting, paused": (busy_port, PAUSE_US),
        }
        time.sleep(3)
        rounds = []
        frames, seconds = 0, 0.0
        for _ in range(asked.rounds):
            took = {}
            for name, (at, pause_us) in rows.items():
                before, before_s = sequence(busy_port), time.monotonic()
                took[name] = measured(reader, at, asked.reads // 10 if pause_us else asked.reads, pause_us)
                if name == "inspecting, paused":
                    frames, seconds = frames + sequence(busy_port) - before, seconds + time.monotonic() - before_s
            rounds.append(took)
        report(rounds, frames / seconds, asked.reads)
        print(idle)


COLUMNS = ("reads/s", "median us", "p99 us", "longest us", "rate/libmodbus", "p99/libmodbus")


def report(rounds: list[dict[str, tuple[float, float, float, float]]], frames_hz: float, reads: int) -> None:
    machine = f"{platform.machine()}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}"
    print(f"{machine}, Python {platform.python_version()}")
    print(f"{len(rounds)} rounds of {reads} reads of 125 registers each; a tenth of them with pauses")
    print(f"frames inspected meanwhile, with pauses: {frames_hz:.0f} a second")
    print(f"{'':20}" + "".join(f"{column:>15}" for column in COLUMNS))
    for name in rounds[0]:
        middle = [statistics.median(r[name][i] for r in rounds) for i in range(4)]
        beside = "libmodbus, paused" if "paused" in name else "libmodbus"
        rate = statistics.median(r[name][0] / r[beside][0] for r in rounds)
        p99 = statistics.median(r[name][2] / r[beside][2] for r in rounds)
        print(f"{name:20}{middle[0]:15.0f}" + "".join(f"{us:15.1f}" for us in middle[1:]) + f"{rate:15.2f}{p99:15.2f}")


if __name__ == "__main__":
    main()
