"""The PLC's side against libmodbus' own server: rate and latency of 125-register reads, on the same client's loop.

    .venv/bin/python benchmarks/plc.py > benchmarks/plc.txt

Needs libmodbus-dev, gcc and pkg-config. The station is the real service (`inspector run`) on config/demo.yaml, once
idle (triggered by hand, that is never) and once with frames inspected at 50 a second; the client is
tests/peers/modbus_reader.c in a process of its own. Each round measures all three in turn, so that a busy moment falls
on all; ratios are taken within rounds.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import platform
import re
import socket
import statistics
import struct
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).parents[1]
FRAMES_HZ = 50
START_S = 60.0


def compiled(name: str, folder: Path) -> str:
    """The path of a program of tests/peers, compiled against libmodbus."""
    flags = subprocess.run(
        ["pkg-config", "--cflags", "--libs", "libmodbus"], check=True, capture_output=True, text=True
    )
    program = folder / name
    source = ROOT / "tests" / "peers" / f"{name}.c"
    subprocess.run(["gcc", "-O2", str(source), "-o", str(program), *flags.stdout.split()], check=True)
    return str(program)


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return int(listener.getsockname()[1])


def station(folder: Path, name: str, changes: dict[str, Any], stack: contextlib.ExitStack) -> tuple[int, int, float]:
    """Start the service; its port, its process id and the seconds until a register was answered."""
    settings = yaml.safe_load((ROOT / "config" / "demo.yaml").read_text())
    settings["calibration"] = str(ROOT / "config" / settings["calibration"])
    settings["camera"] |= {"paths": [str(ROOT / "config" / "frames")], "rate_hz": FRAMES_HZ}
    port = free_port()
    settings["plc"]["port"] = port
    file = folder / f"{name}.yaml"
    file.write_text(yaml.safe_dump(settings | changes))
    started_s = time.monotonic()
    process = subprocess.Popen(
        [str(Path(sys.executable).with_name("inspector")), "run", "--config", str(file)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    stack.callback(process.wait)
    stack.callback(process.terminate)
    while time.monotonic() < started_s + START_S:
        with contextlib.suppress(OSError):
            sequence(port)
            return port, process.pid, time.monotonic() - started_s
        time.sleep(0.005)
    raise SystemExit(f"{name}: no answer on port {port} in {START_S:g} s")


def sequence(port: int) -> int:
    """The 32-bit number of the last result."""
    with socket.create_connection(("127.0.0.1", port), timeout=5) as client:
        client.sendall(struct.pack(">HHHBBHH", 1, 0, 6, 1, 3, 42, 2))
        answer = b""
        while len(answer) < 13:
            piece = client.recv(100)
            if not piece:
                raise ConnectionResetError
            answer += piece
        return int.from_bytes(answer[9:13], "big")


def measured(reader: str, port: int, reads: int) -> tuple[float, float, float, float]:
    """Reads a second; median, 99th percentile and longest in us."""
    command = [reader, "127.0.0.1", str(port), "4", "0", "125", str(reads)]
    done = subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, check=True)
    seconds, *took = map(float, done.stderr.split())
    return (reads / seconds, *took)  # type: ignore[return-value]  # three that the reader prints


def megabytes(pid: int) -> float:
    found = re.search(r"VmRSS:\s+(\d+) kB", Path(f"/proc/{pid}/status").read_text())
    assert found
    return int(found[1]) / 1024


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--rounds", type=int, default=15)
    options.add_argument("--reads", type=int, default=10000)
    asked = options.parse_args()
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        reader, server = compiled("modbus_reader", folder), compiled("modbus_server", folder)
        port = free_port()
        libmodbus = subprocess.Popen([server, str(port)], stdout=subprocess.PIPE)
        stack.callback(libmodbus.wait)
        stack.callback(libmodbus.kill)
        assert libmodbus.stdout
        libmodbus.stdout.readline()
        by_hand = {"cycle": {"trigger": {"kind": "by_hand"}}}
        idle = station(folder, "idle", by_hand, stack)
        busy = station(folder, "inspecting", {}, stack)
        ports = {"libmodbus": port, "station idle": idle[0], "station inspecting": busy[0]}
        time.sleep(3)
        before, before_s = sequence(busy[0]), time.monotonic()
        rounds = [{name: measured(reader, at, asked.reads) for name, at in ports.items()} for _ in range(asked.rounds)]
        frames_hz = (sequence(busy[0]) - before) / (time.monotonic() - before_s)
        report(rounds, frames_hz, asked.reads)
        print(f"first register answered after {idle[2]:.2f} s; resident: idle {megabytes(idle[1]):.0f} MiB")


COLUMNS = ("reads/s", "median us", "p99 us", "longest us", "rate/libmodbus", "p99/libmodbus")


def report(rounds: list[dict[str, tuple[float, float, float, float]]], frames_hz: float, reads: int) -> None:
    machine = f"{platform.machine()}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}"
    print(f"{machine}, Python {platform.python_version()}")
    print(f"{len(rounds)} rounds of {reads} reads of 125 registers each; frames inspected at {frames_hz:.0f} a second")
    print(f"{'':20}" + "".join(f"{column:>15}" for column in COLUMNS))
    for name in rounds[0]:
        middle = [statistics.median(r[name][i] for r in rounds) for i in range(4)]
        rate = statistics.median(r[name][0] / r["libmodbus"][0] for r in rounds)
        p99 = statistics.median(r[name][2] / r["libmodbus"][2] for r in rounds)
        print(f"{name:20}{middle[0]:15.0f}" + "".join(f"{us:15.1f}" for us in middle[1:]) + f"{rate:15.2f}{p99:15.2f}")


if __name__ == "__main__":
    main()
