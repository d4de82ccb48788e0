"""What `inspector lamp calibrate` does: the level stepped, the light measured in the frame, the curve written."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import typer

from firmware_bridge import factory
from firmware_bridge.wire import lamp_curve
from inspector import calibration_file, lamp_curve_file, yaml_document
from inspector.acquire import light
from inspector.commands import bench
from inspector.commands.bench import Bench, Build, NotPossible
from inspector.model import Frame

CLIPPED_SHARE = 0.98
"""A reference this near full scale, in any pixel, is clipped, and says too little."""
DEFAULT_FILE = "lamp-curve.yaml"
SPOTS_SHARE = 0.001
"""Where no reference patch is named, the whole frame is the reference: so much of it may be spots, which clip."""


def run(
    config: Path,
    output: Path | None,
    *,
    steps: int,
    frames: int,
    settle_s: float,
    yes: bool,
    build: Build = factory.build,
) -> int:
    """Measure the lamp's curve and write it to ``output`` (default: the file that lamp.curve names, or one beside the
    settings). Asks before the lamp's output is moved. The exit status."""
    named = _named_file(config)
    path = output or config.parent / (named or DEFAULT_FILE)

    def work(station: Bench) -> int:
        levels = [lamp_curve.CLAMP_V * step / steps for step in range(steps, -1, -1)]
        if not yes and not _confirmed(station, levels):
            typer.echo("nothing was moved or written")
            return bench.EXIT_NOT_DONE
        samples = _measured(station, levels, frames)
        curve = _curve(samples)
        _show(samples, curve)
        lamp_curve_file.write(path, samples, datetime.now(UTC))
        typer.echo(f"\nwritten to {path}")
        if named is None or config.parent / named != path:
            typer.echo(f"to use it, set in {config}:\nlamp:\n  curve: {path.name}")
        return bench.EXIT_DONE

    return bench.run(config, work, settle_s=settle_s, build=build)


def _named_file(config: Path) -> str | None:
    """The file that the settings name as the lamp's curve."""
    data = yaml_document.read(config).data
    lamp = data.get("lamp") if isinstance(data, dict) else None
    curve = lamp.get("curve") if isinstance(lamp, dict) else None
    return curve if isinstance(curve, str) else None


def _confirmed(station: Bench, levels: list[float]) -> bool:
    module = station.settings.module
    question = (
        f"{module.profile_row.model}, unit {module.unit}: step output {station.settings.lamp.channel} (the lamp)"
        f" through {len(levels)} levels from {levels[0]:g} to {levels[-1]:g} V?"
    )
    try:
        return typer.confirm(question)
    except typer.Abort:  # no terminal to answer on
        return False


def _measured(station: Bench, levels: list[float], frames: int) -> list[tuple[float, float]]:
    """Level in volts and mean of the reference, DN, for each level. Raises BridgeError, NotPossible."""
    full_dn = calibration_file.read(station.settings.calibration).sensor.saturation_dn
    station.warm_up(levels[0])
    samples = []
    for level_v in levels:
        taken = [station.frame(station.settings.recipe.exposure_us, level_v) for _ in range(frames)]
        samples.append((level_v, float(np.mean([_reference_dn(frame, station, full_dn) for frame in taken]))))
        typer.echo(f"{level_v:6.3f} V  {samples[-1][1]:8.2f} DN", err=True)
    return samples


def _reference_dn(frame: Frame, station: Bench, full_dn: float) -> float:
    """Mean of the reference patch, of the whole frame where the settings name none. Raises NotPossible."""
    settings, (height, width) = station.settings.light, frame.image.shape
    patch = settings.patch if settings else light.Patch(x_px=0, y_px=0, width_px=width, height_px=height)
    part = light.inner(frame.image, patch)
    clipped = np.count_nonzero(part >= CLIPPED_SHARE * full_dn)
    if clipped > (0 if settings else SPOTS_SHARE * part.size):
        raise NotPossible(f"the reference is clipped at {int(part.max())} DN: shorten recipe.exposure_us for this")
    return light.patch_mean_dn(frame.image, patch)


def _curve(samples: list[tuple[float, float]]) -> tuple[tuple[float, float], ...]:
    try:
        return lamp_curve.from_samples(samples)
    except ValueError as error:
        raise NotPossible(f"no curve was written: {error}") from error


def _show(samples: list[tuple[float, float]], curve: tuple[tuple[float, float], ...]) -> None:
    typer.echo(f"{'volts':>7}  {'mean_DN':>8}  {'percent':>7}  {'linear_%':>8}")
    for level_v, mean_dn in sorted(samples):
        linear = 100 * level_v / lamp_curve.CLAMP_V
        typer.echo(f"{level_v:7.3f}  {mean_dn:8.2f}  {lamp_curve.percent(curve, level_v):7.2f}  {linear:8.2f}")
