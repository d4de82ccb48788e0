"""What the archive costs a cycle, on and off in turn in one run, and how long the disk takes for a result.

    .venv/bin/python benchmarks/archive.py

Prints a line a round: processor time and wall time of a result with nothing kept, with results, and with their frames;
then their ratios, and the commits alone.
"""

from __future__ import annotations

import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from station import cpu_s, registers, settings_file

from inspector.archive import entries
from inspector.archive.claim import Claim
from inspector.archive.store import Run
from inspector.archive.store_writer import StoreWriter
from inspector.model import Defect, Snapshot
from inspector.outage import Outage

ROUNDS, WARM, RESULTS, COMMITS = 3, 20, 100, 500
SEQUENCE_U32 = 42
NO_FRAMES = {"min_free_mb": 0, "failing": False, "passing_every": None, "last": 0}
KEPT = {"results": NO_FRAMES, "every frame": {"min_free_mb": 0}}
"""What is kept, beside nothing; by default the last frames are kept whatever they say, and so each is written."""


def main() -> None:
    with tempfile.TemporaryDirectory(dir=Path.home()) as name:  # not in memory, as /tmp may be
        folder = Path(name)
        rounds = [_round(number, folder) for number in range(1, ROUNDS + 1)]
        for kept in KEPT:
            cpu, wall = (statistics.median(found[kept][n] / found["nothing"][n] for found in rounds) for n in (0, 1))
            print(f"{kept} kept: {cpu:.2f} of the processor time and {wall:.2f} of the wall time with nothing kept")
        _commits(folder / "commits")


def _round(number: int, folder: Path) -> dict[str, tuple[float, float]]:
    found = {"nothing": _results(folder, None)}
    for kept, frames in KEPT.items():
        found[kept] = _results(folder, {"folder": str(folder / f"{number} {kept}"), "frames": frames})
    print("; ".join(f"{kept}: {cpu:.2f} ms cpu, {wall:.1f} ms" for kept, (cpu, wall) in found.items()), flush=True)
    return found


def _results(folder: Path, archive: object) -> tuple[float, float]:
    """Milliseconds of processor and wall a result."""
    camera = {"kind": "replay", "paths": [str(Path(__file__).parents[1] / "config" / "frames")], "rate_hz": 0}
    file, port = settings_file(folder, archive=archive, camera=camera)
    command = [sys.executable, "-m", "inspector", "run", "--config", str(file)]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as service:
        try:
            first = _wait_for(port, WARM)
            cpu, began_s = cpu_s(service.pid), time.monotonic()
            last = _wait_for(port, first + RESULTS)
            cpu, wall_s = cpu_s(service.pid) - cpu, time.monotonic() - began_s
        finally:
            service.terminate()
    return 1e3 * cpu / (last - first), 1e3 * wall_s / (last - first)


def _wait_for(port: int, sequence: int) -> int:
    while True:
        try:
            high, low = registers(port, SEQUENCE_U32, 2)
            if (high << 16 | low) >= sequence:
                return high << 16 | low
        except OSError:
            pass
        time.sleep(0.02)


def _commits(folder: Path) -> None:
    """How long a result of ten seeds waits for its fsync."""
    writer = StoreWriter(folder, Run(time.time(), "", ""), Claim(folder), Outage("store"), Outage("log"))
    seeds = (Defect(1.0, 2.0, 3.0, 3.5, (4.0, 5.0), (6.0, 7.0)),) * 10
    taken_s = []
    for number in range(COMMITS):
        began_s = time.perf_counter()
        entry = entries.of_result(Snapshot(sequence=number, defects=seeds), time.time(), (), [], [], ("", ""))
        writer.wait(writer.put(entry), 60)
        taken_s.append(time.perf_counter() - began_s)
    writer.close(10, time.time())
    found = sorted(taken_s[20:])
    print(f"commit: median {1e3 * found[len(found) // 2]:.1f} ms, 99 % {1e3 * found[len(found) * 99 // 100]:.1f} ms")


if __name__ == "__main__":
    main()
