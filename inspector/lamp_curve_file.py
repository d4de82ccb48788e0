"""The file of a measured lamp curve, YAML: written by a calibration of the lamp, named by ``lamp.curve`` in settings.

version: 1
measured_at: 2026-11-03T10:15:00+00:00
samples:
  - [0.0, 0.4]      # level in volts, light: the mean of a reference in the frame, DN above black
  - [1.0, 3.1]
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from firmware_bridge import whole_file
from firmware_bridge.settings import LevelVolts
from firmware_bridge.strict import Strict
from firmware_bridge.wire import lamp_curve
from inspector import yaml_document
from inspector.yaml_document import Document

Sample = tuple[LevelVolts, float]


class LampCurveFile(Strict):
    """What the file says."""

    version: Literal[1]
    """Version of this form."""
    measured_at: Annotated[datetime, Field(strict=False)] | None = None
    """When it was measured."""
    samples: tuple[Sample, ...] = Field(min_length=2)
    """Pairs [level in volts, light in any unit proportional to it], one of them at 0 V."""


def document(path: Path) -> Document:
    """The file's curve as pairs [percent, volts], in place of what the file says; with every problem it has."""
    said = yaml_document.read(path)
    file, problems = yaml_document.validate(said, LampCurveFile)
    if file is None:
        return Document(said.source, None, said.marks, problems)
    try:
        curve = [list(pair) for pair in lamp_curve.from_samples(file.samples)]
    except ValueError as error:
        return Document(said.source, None, said.marks, (*problems, said.problem(("samples",), "samples", str(error))))
    return Document(said.source, curve, {(): said.source}, problems)


def write(path: Path, samples: Sequence[tuple[float, float]], measured_at: datetime) -> None:
    """Write the samples (level in volts, light), whole or not at all.

    Raises ValueError if they make no curve, OSError if the file cannot be written.
    """
    lamp_curve.from_samples(samples)
    lines = [f"version: 1\nmeasured_at: {measured_at.isoformat(timespec='seconds')}\nsamples:  # volts, light\n"]
    lines += [f"  - [{float(level_v)!r}, {float(light)!r}]\n" for level_v, light in sorted(samples)]
    whole_file.write(path, "".join(lines))
