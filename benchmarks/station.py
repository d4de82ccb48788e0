"""A station to be measured: settings in a folder of its own, on a free port, and what its registers say."""

from __future__ import annotations

import os
import socket
import struct
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).parents[1]


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return int(listener.getsockname()[1])


def settings_file(folder: Path, **changed: Any) -> tuple[Path, int]:
    """Settings of the demo's station, with some parts changed, and its port."""
    settings = yaml.safe_load((ROOT / "config" / "demo.yaml").read_text())
    settings["calibration"] = str(ROOT / "config" / settings["calibration"])
    settings["camera"]["paths"] = [str(ROOT / "config" / "frames")]
    settings["archive"]["folder"] = str(folder / "archive")
    port = free_port()
    settings["plc"]["port"] = port
    file = folder / f"{port}.yaml"
    file.write_text(yaml.safe_dump(settings | changed))
    return file, port


def registers(port: int, first: int, count: int) -> tuple[int, ...]:
    """Holding registers of the station on this port. Raises OSError while nobody answers."""
    with socket.create_connection(("127.0.0.1", port), timeout=5) as client, client.makefile("rb") as stream:
        client.sendall(struct.pack(">HHHBBHH", 1, 0, 6, 1, 3, first, count))
        answer = stream.read(9 + 2 * count)
    if len(answer) < 9 + 2 * count:
        raise ConnectionResetError
    return struct.unpack(f">{count}H", answer[9:])


def cpu_s(pid: int) -> float:
    """Processor time that a process has used so far, user and system, seconds: to the microsecond, by its threads."""
    tasks = Path(f"/proc/{pid}/task")
    return sum(int((tasks / task / "schedstat").read_text().split()[0]) for task in os.listdir(tasks)) / 1e9


def memory_mib(pid: int, key: str = "VmRSS") -> float:
    """Memory of a process, MiB, by its key in /proc/PID/status: VmRSS is resident now, VmHWM at its peak."""
    line = next(line for line in Path(f"/proc/{pid}/status").read_text().splitlines() if line.startswith(key))
    return int(line.split()[1]) / 1024
