"""The command `inspector calibrate --heights`: measured samples and their frames in, a calibration with a gain out."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from inspector import calibration_file, csv_table, imagefile, pipeline
from inspector.csv_table import InputRefused
from inspector.estimate import height_gain
from inspector.estimate.height_gain import HeightGain
from inspector.model import Defect, FloatArray, Frame, FrameResult, Reason, Verdict
from inspector.pipeline import Station

NUMBERS = ("x_mm", "y_mm", "height_mm")
COLUMNS = ("frame", *NUMBERS)
"""Columns that a file of samples must have, in any order and among others; frames are relative to the file."""


@dataclass(frozen=True)
class Sample:
    """A seed whose height was measured: its line in the file, its frame, where on the panel it is, how high."""

    line: int
    frame: str
    x_mm: float
    y_mm: float
    height_mm: float


def run(file: Path, calibration: Path, output: Path, tolerance_mm: float) -> str:
    """Fit the gain to the samples in ``file``, write ``calibration`` with it to ``output``, and return the report.

    Raises InputRefused, SamplesRefused, CalibrationError, OSError.
    """
    if not tolerance_mm > 0:
        raise InputRefused(f"--tolerance-mm {tolerance_mm:g}: allowed: above 0")
    entry = calibration_file.load(calibration)
    samples = read_samples(file)
    defects = find(file, samples, Station(replace(entry.to_calibration(), height_gain=1.0)), tolerance_mm)
    computed_mm = np.array([d.height_um / 1000 for d in defects])
    fitted = height_gain.fit(computed_mm, np.array([s.height_mm for s in samples]))
    calibration_file.save(output, entry.model_copy(update={"height_gain": fitted.gain}))
    return "\n".join([*_table(samples, defects, fitted), "", *_summary(fitted, entry.height_gain)])


def read_samples(path: Path) -> list[Sample]:
    """The samples in a CSV file with the columns :data:`COLUMNS`. Raises InputRefused with every problem at once."""
    rows = csv_table.read(path, COLUMNS)
    table = csv_table.numbers(path, NUMBERS, rows)
    return [Sample(row.line, row.cells[0] or "", *values) for row, values in zip(rows, table, strict=True)]


def find(file: Path, samples: Sequence[Sample], station: Station, tolerance_mm: float) -> list[Defect]:
    """The defect measured nearest to each sample. Raises InputRefused with every problem at once."""
    results = {name: _inspect(file.parent / name, station) for name in dict.fromkeys(s.frame for s in samples)}
    line_of: dict[tuple[str, int], int] = {}
    found, problems = [], []
    for sample in samples:
        result = results[sample.frame]
        try:
            nearest = _nearest(sample, result, tolerance_mm)
            if line_of.setdefault((sample.frame, nearest), sample.line) != sample.line:
                raise InputRefused(
                    f"nearest is the defect of line {line_of[sample.frame, nearest]}; correct one of them"
                )
            found.append(result.defects[nearest])
        except InputRefused as problem:
            problems.append(f"{file}:{sample.line}: {sample.frame}: {problem}")
    if problems:
        raise InputRefused("\n".join(problems))
    return found


def _inspect(path: Path, station: Station) -> FrameResult:
    try:
        return pipeline.inspect(Frame(imagefile.read(path), str(path)), station)
    except imagefile.FrameUnreadable as error:
        return FrameResult(str(path), Verdict.NOT_INSPECTED, Reason.FRAME_UNREADABLE, (error.sentence,))


def _nearest(sample: Sample, result: FrameResult, tolerance_mm: float) -> int:
    """Which of the result's defects is the sample. Raises InputRefused."""
    if result.verdict is Verdict.NOT_INSPECTED:
        raise InputRefused(f"not inspected: {' '.join(result.reasons_text)}")
    if not result.defects:
        raise InputRefused("no defect was measured in this frame; take it again, or leave the sample out")
    away_mm = [math.hypot(d.x_mm - sample.x_mm, d.y_mm - sample.y_mm) for d in result.defects]
    nearest = min(range(len(away_mm)), key=away_mm.__getitem__)
    if not away_mm[nearest] <= tolerance_mm:
        at = result.defects[nearest]
        raise InputRefused(
            f"no defect within {tolerance_mm:g} mm of ({sample.x_mm:g}, {sample.y_mm:g}) mm, the nearest is at"
            f" ({at.x_mm:.2f}, {at.y_mm:.2f}); correct the position, or give --tolerance-mm"
        )
    return nearest


def _table(samples: Sequence[Sample], defects: Sequence[Defect], fitted: HeightGain) -> Iterator[str]:
    """Measured and computed heights and their errors in percent, in the form of the thesis' Table 5.5."""
    width = max(len("of |error|"), *(len(s.frame) for s in samples))
    errors = np.column_stack([fitted.before_pct, fitted.after_pct, fitted.leave_one_out_pct])
    heads = "".join(f"{head:>14}" for head in ("measured_mm", "computed_mm", "error_%", "with_gain_%", "left_out_%"))
    yield f"{'sample':>6}  {'frame':<{width}}{heads}"
    for n, (sample, defect) in enumerate(zip(samples, defects, strict=True)):
        heights = f"{sample.height_mm:14.4f}{defect.height_um / 1000:14.4f}"
        remark = "" if fitted.used[n] else "  outlier, not used"
        yield f"{n + 1:>6}  {sample.frame:<{width}}{heights}{_percents(errors[n])}{remark}"
    size = np.abs(errors[fitted.used])
    yield f"{'mean':>6}  {'of |error|':<{width}}{'':28}{_percents(size.mean(axis=0))}"
    yield f"{'std':>6}  {'of |error|':<{width}}{'':28}{_percents(size.std(axis=0, ddof=1))}"


def _percents(values: FloatArray) -> str:
    return "".join(f"{value:14.3f}" for value in values)


def _summary(fitted: HeightGain, previous: float) -> Iterator[str]:
    used = int(fitted.used.sum())
    yield f"height_gain {fitted.gain:.4f}, standard uncertainty {fitted.gain_sigma:.4f}, was {previous:.4f}"
    yield f"{used} samples used, {len(fitted.used) - used} not, as outliers; left_out_% is with the others' gain alone"
