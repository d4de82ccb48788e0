"""How long each stage takes, beside what else one could call: all measured in turn, in the same rounds.

A round times everything once, so that whatever the machine does meanwhile, it does to all. Each is called once more
just before it is timed: none pays for what its predecessor left in the caches. OpenCV works with one thread. Stages
are called as the pipeline calls them; ``fit`` alone is a difference, of two times of the same round.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import os
import platform
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from inspector.commands.benchmark_frames import CROWDS, SIZES, Case, draw
from inspector.detect import highlights, kernel, lit, pairs, spots
from inspector.detect.fit import Response
from inspector.estimate import heights
from inspector.judge.verdict import judge
from inspector.pipeline import inspect

READ_PASS, TWO_CALLS = "image.max()", "cv2.threshold + connectedComponentsWithStats"
SKIMAGE, SEP = "skimage.measure.label + regionprops", "sep.extract"
BACKGROUND, SPOTS, HIGHLIGHTS, FIT = "background", "spots", "spots and fit", "fit"
PAIRS, HEIGHTS, JUDGE, WHOLE = "pairs", "heights", "judge", "frame to verdict"
MEANINGS = {
    READ_PASS: "numpy's, one pass over the frame: the yardstick of memory",
    BACKGROUND: "the panel's grey value and noise",
    SPOTS: "background, lit pixels, components, peaks, centroids",
    FIT: "sub-pixel centres, brightness and their uncertainty: 'spots and fit' less 'spots'",
    HIGHLIGHTS: "all of detection up to measured highlights",
    PAIRS: "which two highlights are one seed",
    HEIGHTS: "heights and their uncertainty, what is left over",
    JUDGE: "verdict and reasons",
    WHOLE: "all of it: from the frame in memory to the verdict",
    TWO_CALLS: "8-connected components, boxes, areas and plain centroids of a mask; no sub-pixel fit",
    SKIMAGE: "the same with grey-weighted centroids",
    SEP: "from the frame as float32: components parted where they touch, grey-weighted centroids",
}
OTHERS = {"skimage": SKIMAGE, "sep": SEP}
"""Measured where they can be imported: the extra `bench` installs them."""
ROUNDS = {"640x480": 300, "5 MP": 40, "12 MP": 20}
QUICK_ROUNDS = 3
WARM_UP_ROUNDS = 1


@dataclass(frozen=True)
class Row:
    """One thing measured on one frame, microseconds, and its median over those of the two yardsticks."""

    size: str
    crowd: str
    what: str
    p50_us: float
    p99_us: float
    of_read_pass: float
    of_two_calls: float


@dataclass(frozen=True)
class Report:
    """What was measured, where, with what, and what could not be measured for want of a package."""

    machine: dict[str, str | int | float]
    versions: dict[str, str]
    missing: tuple[str, ...]
    rounds: dict[str, int]
    meanings: dict[str, str]
    rows: tuple[Row, ...]

    def as_json(self) -> dict[str, Any]:
        """The report as plain values."""
        return asdict(self)


def run(*, quick: bool = False, progress: Callable[[str], None] = lambda text: None) -> Report:
    """Measure all frames. Raises ValueError where one is not inspected right: its times would mean nothing."""
    rounds = dict.fromkeys(SIZES, QUICK_ROUNDS) if quick else ROUNDS
    others = {name: module for name in OTHERS if (module := _importable(name))}
    missing = tuple(f"{OTHERS[name]}: {name} is not installed" for name in OTHERS if name not in others)
    rows: list[Row] = []
    with _one_opencv_thread():
        for size in SIZES:
            for crowd in CROWDS:
                progress(f"{size}, {crowd}: {rounds[size]} rounds")
                rows += _measured(draw(size, crowd), rounds[size], others)
    return Report(_machine(), _versions(list(others)), missing, rounds, MEANINGS, tuple(rows))


def _importable(name: str) -> Any:
    """The module, or None."""
    try:
        return importlib.import_module(name)
    except ImportError:
        return None


@contextmanager
def _one_opencv_thread() -> Iterator[None]:
    import cv2

    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(threads)


def _measured(case: Case, rounds: int, others: dict[str, Any]) -> list[Row]:
    """All rows of one frame."""
    calls = {**_stages(case), **_yardsticks(case, others)}
    taken: dict[str, list[float]] = {what: [] for what in calls}
    for number in range(WARM_UP_ROUNDS + rounds):
        for what, call in calls.items():
            call()
            before_ns = time.perf_counter_ns()
            call()
            took_us = (time.perf_counter_ns() - before_ns) / 1000
            if number >= WARM_UP_ROUNDS:
                taken[what].append(took_us)
    taken[FIT] = [both - found for both, found in zip(taken[HIGHLIGHTS], taken[SPOTS], strict=True)]
    p50 = {what: float(np.median(times)) for what, times in taken.items()}
    return [
        Row(
            case.size,
            case.crowd,
            what,
            p50[what],
            float(np.percentile(taken[what], 99)),
            p50[what] / p50[READ_PASS],
            p50[what] / p50[TWO_CALLS],
        )
        for what in MEANINGS
        if what in taken
    ]


def _stages(case: Case) -> dict[str, Callable[[], object]]:
    """The pipeline's stages, each on what the one before it gave."""
    image, recipe, calibration = case.frame.image, case.station.recipe, case.station.calibration
    found = highlights.find(image, recipe.detection, calibration.sensor)
    paired = pairs.pair(found, calibration)
    defects, unpaired = heights.measure(found, paired, calibration, recipe.method)
    if len(defects) != case.seeds or unpaired:
        raise ValueError(
            f"{case.frame.name}: {len(defects)} of {case.seeds} seeds found, {len(unpaired)} spots left over"
        )
    area_m2 = case.station.area_m2
    return {
        BACKGROUND: lambda: lit.background(kernel.packed(image)),
        SPOTS: lambda: _find_spots(case, found.threshold_dn),
        HIGHLIGHTS: lambda: highlights.find(image, recipe.detection, calibration.sensor),
        PAIRS: lambda: pairs.pair(found, calibration),
        HEIGHTS: lambda: heights.measure(found, paired, calibration, recipe.method),
        JUDGE: lambda: judge(defects, unpaired, recipe.limits, area_m2),
        WHOLE: lambda: inspect(case.frame, case.station),
    }


def _find_spots(case: Case, threshold_dn: float) -> spots.Spots:
    """What `highlights.find` does before it fits."""
    pixels, detection = kernel.packed(case.frame.image), case.station.recipe.detection
    lit.background(pixels)
    most = int(detection.max_lit_fraction * pixels.image.size) + 1
    clipped_dn = Response(case.station.calibration.sensor, 0.0, 0.0, 0.0).clipped_dn
    found = kernel.detect(pixels, np.array([[threshold_dn]]), most, clipped_dn, highlights.HOT_SHARE)
    assert found is not None
    return spots.find_spots(pixels.image, found, clipped_dn)


def _yardsticks(case: Case, others: dict[str, Any]) -> dict[str, Callable[[], object]]:
    """What else one could call on the same frame, with the same threshold."""
    import cv2

    image, detection = case.frame.image, case.station.recipe.detection
    threshold_dn = highlights.find(image, detection, case.station.calibration.sensor).threshold_dn

    calls: dict[str, Callable[[], object]] = {
        READ_PASS: image.max,
        TWO_CALLS: lambda: cv2.connectedComponentsWithStats(
            cv2.threshold(image, threshold_dn, 255, cv2.THRESH_BINARY)[1], connectivity=8
        ),
    }
    if "skimage" in others:
        measure = importlib.import_module("skimage.measure")
        calls[SKIMAGE] = lambda: [
            region.centroid_weighted
            for region in measure.regionprops(measure.label(image > threshold_dn, connectivity=2), image)
        ]
    if "sep" in others:
        calls[SEP] = lambda: others["sep"].extract(image.astype(np.float32), threshold_dn)
    return calls


def _machine() -> dict[str, str | int | float]:
    """What it ran on, and how busy that was."""
    model = platform.processor() or platform.machine()
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as lines:
            model = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), model)
    except OSError:
        pass
    return {
        "cpu": model,
        "cores": os.cpu_count() or 1,
        "load_1_min": round(os.getloadavg()[0], 2),
        "system": f"{platform.system()} {platform.release()}",
        "date": time.strftime("%Y-%m-%d"),
    }


def _versions(others: list[str]) -> dict[str, str]:
    """Python's and the packages' versions."""
    packages = {"numpy": "numpy", "opencv": "cv2", **{name: name for name in others}}
    found = {name: str(importlib.import_module(module).__version__) for name, module in packages.items()}
    return {"python": platform.python_version(), **found}


def table(report: Report) -> str:
    """The report as text: a block for each frame."""
    lines = [f"{key}: {value}" for key, value in {**report.machine, **report.versions}.items()]
    lines += ["opencv threads: 1", *(f"not measured: {text}" for text in report.missing)]
    width = max(map(len, report.meanings))
    for size in SIZES:
        for crowd, seeds in CROWDS.items():
            lines += ["", f"{size}, {crowd} ({seeds} seeds), {report.rounds[size]} rounds"]
            lines.append(f"  {'':{width}} {'p50 us':>10} {'p99 us':>10} {'x max()':>9} {'x 2 calls':>10}")
            lines += [_line(row, width) for row in report.rows if (row.size, row.crowd) == (size, crowd)]
    return "\n".join([*lines, "", *(f"{what}: {text}" for what, text in report.meanings.items())])


def _line(row: Row, width: int) -> str:
    times = f"{row.p50_us:10.1f} {row.p99_us:10.1f}"
    return f"  {row.what:{width}} {times} {row.of_read_pass:9.2f} {row.of_two_calls:10.4f}"
