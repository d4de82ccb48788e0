"""The service itself on a panel of three overlapping frames: real pipeline, simulated module, a PLC over the wire."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import panel_frames


def test_a_panel_in_three_overlapping_frames_counts_each_seed_once(
    station: Any, module: Callable[[], Any], service: Callable[..., Any], tmp_path: Path
) -> None:
    for old in station.frames.iterdir():
        old.unlink()
    panel_frames.write(station.frames)
    module()
    station.settings |= {
        "panel": {
            "frames": {"kind": "count", "count": panel_frames.FRAMES},
            "travel": {"by": {"kind": "pitch", "mm_per_frame": panel_frames.STEP_MM}, "direction_deg": 90.0},
            "area": {"x_min_mm": 50.0, "x_max_mm": 110.0, "y_min_mm": -60.0, "y_max_mm": 70.0},
        },
        "recipe": {"limits": {"max_height_um": 5000.0}},
    }
    station.write()
    at_work = service("--panels", "2")
    shown = at_work.until(lambda r: r["sequence"] >= 1, "a panel")
    assert (shown["verdict"], shown["defect_count"]) == (1, len(panel_frames.SEEDS))
    assert shown["panel_frames"] == panel_frames.FRAMES
    highest = max(panel_frames.SEEDS, key=lambda seed: seed[2])
    assert abs(shown["defect_1_x_mm"] - highest[0]) < 0.5
    assert abs(shown["defect_1_y_mm"] - highest[1]) < 0.5
    assert abs(shown["largest_height_um"] - 2000 * highest[2]) < 40
    assert at_work.ended() == 0
    lines = at_work.results
    assert len(lines) == 2
    assert all(f"{len(panel_frames.SEEDS)} seeds" in line and "3 frames" in line for line in lines)
