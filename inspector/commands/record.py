"""What `inspector record` does: frames taken with everything read back, inspected, and kept as a session.

The replay camera shows such a session, and `inspector replay` inspects it again: it holds the settings too.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import typer

from firmware_bridge import factory
from firmware_bridge.wire.session import Recorded
from inspector import settings_version
from inspector.archive.session_frames import Inspected, Kept
from inspector.archive.session_writer import SessionWriter
from inspector.calibration_file import CalibrationError
from inspector.commands import bench
from inspector.commands.bench import Bench, Build, NotPossible
from inspector.stages import inspection_of


def run(config: Path, output: Path, *, frames: int, settle_s: float, build: Build = factory.build) -> int:
    """Take so many frames as the recipe asks for them and keep them in the new folder ``output``; the exit status."""

    def work(station: Bench) -> int:
        settings = station.settings
        lamp_v, exposure_us = settings.lamp.volts(settings.recipe.lamp_percent), settings.recipe.exposure_us
        writer, version = _begin(output, station)
        try:
            inspect = inspection_of(settings)
        except CalibrationError as error:
            raise NotPossible(str(error)) from error
        station.warm_up(lamp_v)
        for number in range(1, frames + 1):
            frame = station.frame(exposure_us, lamp_v)
            result = inspect(replace(frame, image=version.without_patch(frame.image)))
            recorded = Recorded(
                f"{number:06d}.png",
                frame.frame_id,
                frame.taken_at_s,
                frame.exposure_us,
                exposure_us,
                frame.lamp_v,
                lamp_v,
                Inspected(version.name, Kept.CAMPAIGN, result).as_dict(),
            )
            writer.keep([(frame.image, recorded)])
        shown = f"show them with camera: {{kind: replay, paths: [{output}]}}"
        typer.echo(f"{frames} frames in {output}; {shown}, inspect them again with: inspector replay {output}")
        return bench.EXIT_DONE

    return bench.run(config, work, settle_s=settle_s, build=build)


def _begin(output: Path, station: Bench) -> tuple[SessionWriter, settings_version.SettingsVersion]:
    """A new folder with the index's first line, and the settings. Raises NotPossible, OSError."""
    version = settings_version.of(station.settings)
    about = {
        "station": station.settings.station,
        "recipe": station.settings.recipe.name,
        "configuration_hash": version.name,
    }
    try:
        writer = SessionWriter(output, about)
    except FileExistsError:
        raise NotPossible(f"{output} is there already: name a new folder, so that no frame is lost") from None
    writer.version(version.name, version.as_json())
    return writer, version
