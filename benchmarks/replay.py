"""Replaying a session beside decoding its images alone, on as many processes.

    .venv/bin/python benchmarks/replay.py > benchmarks/replay.txt

Sessions are made of frames of the project, each a file of its own as a station records it: `line`, the demo's frames of
at most two seeds, as on a line at work; `demo`, the demo's as they come; `all`, every frame of config/frames and
tests/data/frames, test scenes for the most part, far more crowded or over-exposed than a panel is. A round decodes and
replays in turn, on all cores by the clock, and a tenth of the frames in one process by its processor time; ratios are
within rounds. Decoding is `cv2.imdecode` of the file's bytes and nothing else, in the same kind of processes' pool.
"""

from __future__ import annotations

import argparse
import os
import platform
import shutil
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from firmware_bridge.wire.session import INDEX, Recorded, line
from inspector import imagefile, settings, settings_version
from inspector.archive.session_frames import Inspected, Kept
from inspector.archive.session_writer import SessionWriter
from inspector.change_options import Asked
from inspector.reinspection import Reinspection
from inspector.replay import workers
from inspector.replay.command import Output, run

ROOT = Path(__file__).parents[1]
PART = 50
SCENES = ("line", "demo", "all")
FEW_SEEDS = 2


def scenes(name: str) -> list[tuple[Path, Reinspection]]:
    """The frames and what each is inspected with: its own calibration, the demo's recipe."""
    demo = settings_version.of(settings.load(ROOT / "config" / "demo.yaml"))
    found = [(p, Reinspection(demo)) for p in sorted((ROOT / "config" / "frames").glob("*.png"))]
    if name == "line":
        return [(p, again) for p, again in found if seeds_of(p, again) <= FEW_SEEDS]
    if name == "demo":
        return found
    own = (ROOT / "tests" / "data" / "frames" / "calibration.yaml").read_text()
    data = Reinspection(settings_version.SettingsVersion("0000data", demo.settings, own))
    return found + [(p, data) for p in sorted((ROOT / "tests" / "data" / "frames").glob("*.png"))]


def seeds_of(path: Path, again: Reinspection) -> int:
    return len(again.frame(imagefile.read(path), path.name).defects)


def session(folder: Path, name: str, frames: int) -> None:
    """A session of so many frames with their results."""
    writer = SessionWriter(folder, {"station": "benchmark"})
    made = []
    for path, again in scenes(name):
        writer.version(again.version.name, again.version.as_json())
        image = imagefile.read(path)
        said = Inspected(again.version.name, Kept.SAMPLE, again.frame(image, path.name))
        made.append((cv2.imencode(".png", image)[1].tobytes(), said.as_dict()))
    with (folder / INDEX).open("a") as index:
        for n in range(frames):
            png, said = made[n % len(made)]
            (folder / f"{n:06d}.png").write_bytes(png)
            index.write(line(Recorded(f"{n:06d}.png", n, 1.7e9 + n, 1e3, 1e3, 4.0, 4.0, said | {"sequence": n + 1})))


def decoded(files: list[Path], _careful: bool) -> int:
    """How many of these files OpenCV decodes."""
    return sum(cv2.imdecode(np.frombuffer(p.read_bytes(), np.uint8), cv2.IMREAD_UNCHANGED) is not None for p in files)


def decode(folder: Path, jobs: int) -> None:
    files = sorted(folder.glob("*.png"))
    parts = list(enumerate(files[n : n + PART] for n in range(0, len(files), PART)))
    if sum(count for _, count in workers.share(decoded, parts, jobs)) != len(files):
        raise SystemExit("not all images could be decoded")


def replay(folder: Path, jobs: int) -> None:
    if run([folder], Asked(), Output(file=folder.with_name("report")), jobs) != 0:
        raise SystemExit("the replay found differences")


def timed(clock: Callable[[], float], work: Callable[[Path, int], None], folder: Path, jobs: int) -> float:
    """Seconds of a clock."""
    started = clock()
    work(folder, jobs)
    return clock() - started


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--frames", type=int, default=10000)
    options.add_argument("--rounds", type=int, default=3)
    options.add_argument("--scenes", nargs="+", choices=SCENES, default=SCENES)
    asked = options.parse_args()
    versions = f"Python {platform.python_version()}, OpenCV {cv2.__version__}"
    print(f"{platform.machine()}, {workers.cores()} cores, load {os.getloadavg()[0]:.1f}, {versions}")
    print(f"{asked.rounds} rounds; seconds are medians")
    with tempfile.TemporaryDirectory() as tmp:
        for name in asked.scenes:
            for what, clock, jobs, frames in (
                ("by the clock", time.monotonic, workers.cores(), asked.frames),
                ("processor time", time.process_time, 1, asked.frames // 10),
            ):
                folder = Path(tmp) / f"{name}{jobs}"
                session(folder, name, frames)
                rounds = [
                    (timed(clock, decode, folder, jobs), timed(clock, replay, folder, jobs))
                    for _ in range(asked.rounds)
                ]
                report(f"{name}, {frames} frames, {jobs} processes, {what}", rounds)
                shutil.rmtree(folder)


def report(what: str, rounds: list[tuple[float, float]]) -> None:
    alone, whole = (statistics.median(column) for column in zip(*rounds, strict=True))
    ratios = [replayed / decoded for decoded, replayed in rounds]
    spread = f"{statistics.median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f})"
    print(f"{what}: decoding {alone:.2f} s, replay {whole:.2f} s, ratio {spread}", flush=True)


if __name__ == "__main__":
    main()
