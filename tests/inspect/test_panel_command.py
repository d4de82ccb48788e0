"""`inspector panel`: frames from files as one panel, its result and its map."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import panel_frames
import pytest
import yaml
from typer.testing import CliRunner

from inspector.cli.app import app

SVG = "{http://www.w3.org/2000/svg}"


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return panel_frames.write(tmp_path_factory.mktemp("panel"))


@pytest.fixture
def config(tmp_path: Path) -> Path:
    file = tmp_path / "station.yaml"
    settings: dict[str, Any] = {
        "calibration": str(panel_frames.CALIBRATION),
        "camera": {"kind": "replay", "paths": ["frames"]},
        "module": {"profile": "ato-4ch", "link": {"kind": "simulated"}},
        "panel": {
            "frames": {"kind": "count", "count": panel_frames.FRAMES},
            "travel": {
                "by": {"kind": "pitch", "mm_per_frame": panel_frames.STEP_MM},
                "direction_deg": 90.0,
            },
            "area": {"x_min_mm": 50.0, "x_max_mm": 110.0, "y_min_mm": -60.0, "y_max_mm": 70.0},
        },
        "recipe": {
            "limits": {
                "max_height_um": 1700.0,
                "zones": [
                    {"name": "door & rim", "x_min_mm": 50, "x_max_mm": 75, "y_min_mm": -60, "y_max_mm": 0},
                ],
            }
        },
    }
    file.write_text(yaml.safe_dump(settings))
    return file


def run(config: Path, frames: list[Path], *options: str) -> Any:
    return CliRunner().invoke(app, ["panel", *map(str, frames), "--config", str(config), *options])


def test_frames_are_one_panel_with_each_seed_once(config: Path, frames: list[Path], tmp_path: Path) -> None:
    assert sum(len(panel_frames.seeds_in_view(n)) for n in range(panel_frames.FRAMES)) > len(panel_frames.SEEDS)
    chart = tmp_path / "map.svg"
    done = run(config, frames, "--format", "jsonl", "--map", str(chart))
    assert done.exit_code == 0, done.output
    panel = json.loads(done.stdout)
    assert (panel["verdict"], len(panel["defects"])) == ("FAIL", len(panel_frames.SEEDS))
    for x_mm, y_mm, radius_mm in panel_frames.SEEDS:
        near = [d for d in panel["defects"] if abs(d["x_mm"] - x_mm) < 0.5 and abs(d["y_mm"] - y_mm) < 0.5]
        assert [d["height_um"] for d in near] == [pytest.approx(2000 * radius_mm, rel=0.02)]
    drawn = ElementTree.fromstring(chart.read_text())
    seeds = [g for g in drawn.iter(f"{SVG}g") if g.get("class") == "seed"]
    heights = sorted(int(str(g.findtext(f"{SVG}text"))) for g in seeds)
    assert heights == sorted(round(d["height_um"]) for d in panel["defects"])
    assert len([g for g in seeds if g.find(f"{SVG}path") is not None]) == 1  # a triangle: above its limit
    texts = [str(text.text) for text in drawn.iter(f"{SVG}text")]
    assert "door & rim" in texts
    assert any(text.startswith("FAIL") for text in texts)
    assert len(list(drawn.iter(f"{SVG}polygon"))) == panel_frames.FRAMES


def test_fewer_frames_or_one_that_cannot_be_read_are_no_inspected_panel(
    config: Path, frames: list[Path], tmp_path: Path
) -> None:
    limits = yaml.safe_load(config.read_text())
    limits["recipe"] = {"limits": {"max_height_um": 5000.0}}
    config.write_text(yaml.safe_dump(limits))
    done = run(config, frames[:2])
    assert done.exit_code == 1
    assert "2 frames instead of 3" in done.stdout
    gone = run(config, [frames[0], tmp_path / "gone.png", frames[2]])
    assert gone.exit_code == 1
    assert "gone.png" in gone.stderr
    assert run(config, frames).exit_code == 0


def test_a_line_speed_needs_the_step_and_settings_without_travel_are_told(config: Path, frames: list[Path]) -> None:
    settings = yaml.safe_load(config.read_text())
    settings["panel"]["travel"]["by"] = {"kind": "line_speed", "mm_per_s": 100.0}
    config.write_text(yaml.safe_dump(settings))
    done = run(config, frames)
    assert done.exit_code == 2
    assert "--step-mm" in done.stderr
    assert run(config, frames, "--step-mm", str(panel_frames.STEP_MM)).exit_code == 0
    del settings["panel"]
    config.write_text(yaml.safe_dump(settings))
    assert run(config, frames).exit_code == 2
    config.write_text("panel: 3\n")
    assert run(config, frames).exit_code == 78
