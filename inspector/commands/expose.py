"""What `inspector expose` does: exposure and lamp level stepped until the brightest spots come near full scale."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import typer

from firmware_bridge import factory
from inspector import calibration_file, yaml_edit
from inspector.acquire import exposure
from inspector.acquire.exposure import Bounds, Brightness, Level
from inspector.acquire.tuning import Tuning
from inspector.commands import bench
from inspector.commands.bench import Bench, Build, NotPossible
from inspector.pipeline import Station, inspect
from inspector.recipe import AutomaticExposure

MOST_STEPS = 40
"""From 1 us to 1 s are twenty doublings, and the lamp takes five steps more."""
SAME_SHARE, UNMOVED_STEPS = 0.02, 3
"""Frames that stay within this share of each other over so many steps do not follow the exposure."""
HEADINGS = f"{'step':>4}  {'exposure_us':>11}  {'lamp_%':>6}  {'spots':>5}  {'bleeding':>8}  {'peak_%':>6}"


@dataclass(frozen=True, slots=True)
class Step:
    """A level and what its frames showed."""

    level: Level
    seen: Brightness

    def row(self, number: int) -> str:
        """A line of the table."""
        peak = 100 * self.seen.peak_share
        shown = "-" if math.isnan(peak) else ">100" if peak > 100 else f"{peak:.0f}"
        level, seen = self.level, self.seen
        counts = f"{seen.spots:>5}  {seen.bleeding:>8}  {shown:>6}"
        return f"{number:>4}  {level.exposure_us:>11.1f}  {level.lamp_percent:>6.1f}  {counts}"


def run(config: Path, *, frames: int, settle_s: float, write: bool, build: Build = factory.build) -> int:
    """Find the level for the panel in view, print every step and what the recipe should say; the exit status."""

    def work(station: Bench) -> int:
        typer.echo(HEADINGS)
        steps: list[Step] = []
        for step in _steps(station, frames):
            steps.append(step)
            typer.echo(step.row(len(steps)))
        if station.settings.camera.kind == "replay":
            raise NotPossible("a recording is shown, and follows no exposure: use the line's camera")
        level = _judged(steps)
        typer.echo(f"\nrecipe:\n  exposure_us: {level.exposure_us:g}\n  lamp_percent: {level.lamp_percent:g}")
        if write:
            typer.echo(f"\nwritten to {_write(config, station.settings.recipe.id, level)}")
        return bench.EXIT_DONE

    return bench.run(config, work, settle_s=settle_s, build=build)


def _steps(station: Bench, frames: int) -> Iterator[Step]:
    """Levels and what they showed, until there is nothing to change or nothing changes."""
    settings = station.settings
    inspection = Station(calibration_file.read(settings.calibration), settings.recipe)
    tuning = Tuning(settings.recipe, settings.light)
    station.warm_up(settings.lamp.volts(settings.recipe.lamp_percent))
    camera = station.camera.use(lambda c: c.capabilities())
    bounds = Bounds.of(settings.recipe.automatic_exposure or AutomaticExposure(), camera)
    level = exposure.within(Level(settings.recipe.exposure_us, settings.recipe.lamp_percent), bounds)
    done: list[Step] = []
    for _ in range(MOST_STEPS):
        volts = settings.lamp.volts(level.lamp_percent)
        taken = (tuning.to_inspect(station.frame(level.exposure_us, volts)) for _ in range(frames))
        seen = exposure.brightest([exposure.brightness(inspect(frame, inspection)) for frame in taken])
        done.append(Step(level, seen))
        yield done[-1]
        following = exposure.next_level(level, seen, bounds)
        if following == level or _unmoved(done):
            return
        level = following


def _unmoved(steps: Sequence[Step]) -> bool:
    """Whether the light was changed again and again, and the frames are the same: a recording is shown."""
    last = steps[-UNMOVED_STEPS - 1 :]
    if len(last) <= UNMOVED_STEPS:
        return False
    light = [step.level.exposure_us * step.level.lamp_percent for step in last]
    peaks = [step.seen.peak_share for step in last]
    moved = max(light) > 2 * min(light)
    return moved and all(math.isfinite(peak) for peak in peaks) and max(peaks) < (1 + SAME_SHARE) * min(peaks)


def _judged(steps: Sequence[Step]) -> Level:
    """The level that was found. Raises NotPossible, saying what is in the way."""
    last = steps[-1]
    if _unmoved(steps):
        raise NotPossible("the frames do not follow the exposure: is a recording shown?")
    if math.isnan(last.seen.peak_share):
        raise NotPossible("no spots at the longest exposure: put a panel with seeds in view, open the lens")
    if last.seen.bleeding or last.seen.peak_share > exposure.HIGH_SHARE:
        raise NotPossible("spots bleed at the shortest exposure and lowest lamp level: close the lens")
    if not exposure.is_right(last.seen):
        percent = 100 * last.seen.peak_share
        raise NotPossible(
            f"the brightest spot peaks at {percent:.0f} % of full scale at the longest exposure and highest lamp level:"
            " open the lens, or raise recipe.automatic_exposure.max_us as far as the panel's speed lets"
        )
    return last.level


def _write(config: Path, recipe_id: int, level: Level) -> Path:
    """Write the level into the recipe, in the settings file or its own. Raises NotPossible, OSError."""
    path, place = _where(config, recipe_id)
    try:
        yaml_edit.change(path, place, {"exposure_us": level.exposure_us, "lamp_percent": level.lamp_percent})
    except yaml_edit.CannotEdit as error:
        raise NotPossible(f"{path}: {error}") from error
    return path


def _where(config: Path, recipe_id: int) -> tuple[Path, tuple[str, ...]]:
    """The file that the recipe stands in, and its place there. Raises NotPossible, OSError."""
    from inspector import recipe_folder, yaml_document

    data = yaml_document.read(config).data
    said = data if isinstance(data, dict) else {}
    recipe, recipes = said.get("recipe"), said.get("recipes")
    if recipes is None:
        return (config.parent / recipe, ()) if isinstance(recipe, str) else (config, ("recipe",))
    for path in recipe_folder.files(config.parent / recipes) if isinstance(recipes, str) else ():
        found = yaml_document.read(path).data
        if isinstance(found, dict) and found.get("id") == recipe_id:
            return path, ()
    raise NotPossible(f"{config}: recipe {recipe_id} has no file of its own; write its level by hand")
