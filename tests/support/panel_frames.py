"""Frames of a panel that travels past the demo's camera: spots drawn where, and as bright as, seeds would show them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from drawn import Drawing

from inspector import calibration_file, reflection, simulated_scene

CALIBRATION = Path(__file__).parents[2] / "config" / "calibration" / "demo.yaml"
STEP_MM = 45.0
"""The panel moves so far along +y from frame to frame."""
SEEDS = [(85.0, 60.0, 0.8), (60.0, 30.0, 0.7), (95.0, 10.0, 0.75), (70.0, -20.0, 0.8), (90.0, -45.0, 0.9)]
"""x, y on the panel (the first frame's world) and radius, mm."""
FRAMES = 3


def seeds_in_view(frame: int) -> list[tuple[float, float, float]]:
    """The seeds that a frame shows with both spots well inside, in its own coordinates."""
    calibration = calibration_file.read(CALIBRATION)
    camera = calibration.camera
    shown = []
    for x, y, radius in SEEDS:
        here = x, y + frame * STEP_MM, radius
        ends = np.concatenate(reflection.highlights(np.array([[*here, radius]]), calibration))
        if (ends > 15).all() and (ends < [camera.width_px - 15, camera.height_px - 15]).all():
            shown.append(here)
    return shown


def write(folder: Path) -> list[Path]:
    """The panel's frames as files, in the order of travel."""
    calibration = calibration_file.read(CALIBRATION)
    drawing = Drawing((calibration.camera.height_px, calibration.camera.width_px))
    files = []
    for frame in range(FRAMES):
        seeds = [(x, y, 2000 * radius) for x, y, radius in seeds_in_view(frame)]
        spots = np.array(simulated_scene.highlights(seeds, 1.0, calibration))
        image = drawing.draw(spots[:, :2], 240 * spots[:, 2], seed=frame)
        file = folder / f"frame{frame}.png"
        file.write_bytes(cv2.imencode(".png", image)[1].tobytes())
        files.append(file)
    return files
