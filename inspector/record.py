"""What `inspector record` does: frames taken with everything read back, kept as a session that the replay camera shows.

Each frame is a lossless PNG, whole on the disk before its line is in the index (:mod:`firmware_bridge.wire.session`).
"""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import typer

from firmware_bridge import factory, whole_file
from firmware_bridge.wire import session
from inspector import bench
from inspector.bench import Bench, Build, NotPossible
from inspector.model import Frame
from inspector.settings import configuration_hash


def run(config: Path, output: Path, *, frames: int, settle_s: float, build: Build = factory.build) -> int:
    """Take so many frames as the recipe asks for them and keep them in the new folder ``output``; the exit status."""

    def work(station: Bench) -> int:
        settings = station.settings
        lamp_v, exposure_us = settings.lamp.volts(settings.recipe.lamp_percent), settings.recipe.exposure_us
        index = _begin(output, station)
        station.warm_up(lamp_v)
        for number in range(1, frames + 1):
            frame = station.frame(exposure_us, lamp_v)
            _keep(index, f"{number:06d}.png", frame, exposure_us, lamp_v)
        typer.echo(f"{frames} frames in {output}; show them with camera: {{kind: replay, paths: [{output}]}}")
        return bench.EXIT_DONE

    return bench.run(config, work, settle_s=settle_s, build=build)


def _begin(output: Path, station: Bench) -> Path:
    """A new folder with the index's first line. Raises NotPossible, OSError."""
    try:
        output.mkdir(parents=True)
    except FileExistsError:
        raise NotPossible(f"{output} is there already: name a new folder, so that no frame is lost") from None
    settings = station.settings
    about = {
        "station": settings.station,
        "recipe": settings.recipe.name,
        "configuration_hash": f"{configuration_hash(settings):08x}",
    }
    index = output / session.INDEX
    whole_file.write(index, session.first_line(about))
    return index


def _keep(index: Path, name: str, frame: Frame, exposure_set_us: float, lamp_set_v: float) -> None:
    """The image whole on the disk, then its line. Raises OSError."""
    whole_file.write(index.with_name(name), cv2.imencode(".png", frame.image)[1].tobytes())
    recorded = session.Recorded(
        name, frame.frame_id, frame.taken_at_s, frame.exposure_us, exposure_set_us, frame.lamp_v, lamp_set_v
    )
    with index.open("a", encoding="utf-8") as file:
        file.write(session.line(recorded))
        file.flush()
        os.fsync(file.fileno())
