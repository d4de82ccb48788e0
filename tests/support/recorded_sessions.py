"""Sessions as a station records them, made of the demo's frames, and spoilt in every way that a disk knows."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from firmware_bridge.wire.session import Recorded
from inspector import imagefile, settings, settings_version
from inspector.archive.session_frames import Inspected, Kept
from inspector.archive.session_writer import SessionWriter
from inspector.judge.panel import PanelStation, judge_panel
from inspector.model import FrameResult, Image, PanelFrame, PanelFrames
from inspector.reinspection import Reinspection
from inspector.settings_version import SettingsVersion

CONFIG = Path(__file__).parents[2] / "config"
FRAMES = ("A000.png", "A029.png", "C006.png", "F002.png")
"""Frames of the demo's that are inspected within a millisecond or two."""


def version(folder: Path, name: str = "station", **parts: Any) -> SettingsVersion:
    """The version of the demo's station with these parts of its settings."""
    said: dict[str, Any] = {
        "calibration": str(CONFIG / "calibration" / "demo.yaml"),
        "camera": {"kind": "replay", "paths": [str(CONFIG / "frames")]},
        "module": {"profile": "tm-da1p1r1", "unit": 1, "link": {"kind": "serial", "port": str(folder / "module")}},
        "plc": {"port": 0},
        "recipe": {"limits": {"max_height_um": 2000}},
        **parts,
    }
    file = folder / f"{name}.yaml"
    file.write_text(yaml.safe_dump(said))
    return settings_version.of(settings.load(file))


def images(names: Sequence[str] = FRAMES) -> list[Image]:
    """Frames of the demo's."""
    return [imagefile.read(CONFIG / "frames" / name) for name in names]


class Recording:
    """A session under way."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.frames = 0
        self.panels = 0
        self._writer = SessionWriter(folder, {"station": "test"})

    def panel(self, used: SettingsVersion, shown: Sequence[Image], travels_mm: Sequence[float] = (0.0,)) -> None:
        """A panel inspected with these settings and kept."""
        self._writer.version(used.name, used.as_json())
        again = Reinspection(used)
        self.panels += 1
        results = [again.frame(image, "") for image in shown]
        parts = tuple(PanelFrame(r, mm) for r, mm in zip(results, travels_mm, strict=True))
        judged = None
        if len(shown) > 1:
            at = PanelStation(used.calibration, used.recipe.limits, used.panel)
            judged = judge_panel(PanelFrames(self.panels + 70, parts), at)
        for n, (image, part) in enumerate(zip(shown, parts, strict=True)):
            panel = judged if n == len(shown) - 1 else None
            self._keep(image, part.result, used, n, len(shown), part.travel_mm, panel)

    def _keep(
        self, image: Image, result: FrameResult, used: SettingsVersion, n: int, of: int, mm: float, panel: Any
    ) -> None:
        self.frames += 1
        said = Inspected(used.name, Kept.SAMPLE, result, self.panels, self.panels + 70, n, mm, panel, (), of)
        taken = Recorded(f"{self.frames:06d}.png", self.frames, 1.7e9 + self.frames, 1e3, 1e3, 4.0, 4.0, said.as_dict())
        self._writer.keep([(image, taken)])


def dies_once(marker: Path, careful: bool) -> int:
    """The first process that is at this is killed; 2 where another is told of that, 1 where not."""
    try:
        marker.touch(exist_ok=False)
    except FileExistsError:
        return 1 + careful
    os.kill(os.getpid(), signal.SIGKILL)
    return 0


def dies(_: Path, _careful: bool) -> int:
    os.kill(os.getpid(), signal.SIGKILL)
    return 0


def stays(folder: Path, _careful: bool) -> None:
    """Says in the folder which process is at this, and never ends."""
    (folder / f"{os.getpid()}.pid").touch()
    threading.Event().wait()
