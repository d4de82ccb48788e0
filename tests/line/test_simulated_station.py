"""A station without hardware, set up and run by its commands alone: what it is asked to show is what it measures."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import yaml
from typer.testing import CliRunner

from inspector.cli.app import app
from inspector.settings import load

CONFIG = Path(__file__).parents[2] / "config"
HEIGHTS_UM = [1500.0, 2500.0, 3500.0]
PLACES_MM = [(0.0, 0.0), (40.0, 30.0), (-30.0, 20.0)]


@pytest.fixture
def drawn(station: Any) -> Any:
    """A station that is asked for three seeds."""
    seeds = [[*place, height] for place, height in zip(PLACES_MM, HEIGHTS_UM, strict=True)]
    station.settings |= {
        "camera": {"kind": "simulated", "seeds": seeds, "rate_hz": 200},
        "module": {"profile": "ato-4ch", "link": {"kind": "simulated"}, "deadline_s": 2.0},
        "recipe": {"exposure_us": 20_000, "lamp_percent": 80, "limits": {"max_height_um": 5000}},
    }
    station.write()
    return station


def test_exposure_is_found_written_and_the_seeds_measured_with_it(drawn: Any, service: Any) -> None:
    """Section 5.2 of the thesis: spots that bleed run together; at the exposure that is found none does."""
    found = CliRunner().invoke(app, ["expose", "--config", str(drawn.file), "--settle-s", "0", "--write"])
    assert found.exit_code == 0, found.output
    steps = [line.split() for line in found.output.splitlines() if re.match(r" +\d+ +\d", line)]
    assert int(steps[0][4]) > 0, "spots bleed at first"
    assert int(steps[-1][4]) == 0
    recipe = yaml.safe_load(drawn.file.read_text())["recipe"]
    assert recipe["exposure_us"] < 1000
    assert recipe["lamp_percent"] == 75
    running = service("--panels", "3")
    assert running.ended() == 0
    for line in running.results:
        heights = [float(text) for text in re.search(r"3 seeds: ([\d ]+) um", line)[1].split()]
        assert sorted(heights) == pytest.approx(HEIGHTS_UM, rel=0.02), line


def test_the_lamps_curve_is_measured_by_the_command(drawn: Any) -> None:
    drawn.settings["camera"] |= {"panel_share": 0.5}
    command = ["lamp", "calibrate", "--config", str(drawn.file), "--steps", "5", "--settle-s", "0", "--yes"]
    drawn.write()
    clipped = CliRunner().invoke(app, command)
    assert clipped.exit_code == 1
    assert "the reference is clipped at 255 DN: shorten recipe.exposure_us" in clipped.output
    drawn.settings["recipe"]["exposure_us"] = 1000
    drawn.write()
    done = CliRunner().invoke(app, command)
    assert done.exit_code == 0, done.output
    drawn.settings["lamp"] = {"curve": "lamp-curve.yaml"}
    drawn.write()
    for percent in (10.0, 50.0, 90.0):
        assert load(drawn.file).lamp.volts(percent) == pytest.approx(percent / 20, abs=0.05)


def test_seeds_out_of_view_are_not_drawn(drawn: Any) -> None:
    inside = len(load(drawn.file).camera.spots)
    drawn.settings["camera"]["seeds"].append([5000.0, 0.0, 1000.0])
    drawn.write()
    assert len(load(drawn.file).camera.spots) == inside == 6


def test_the_configuration_that_ships_is_right() -> None:
    assert load(CONFIG / "simulated.yaml").camera.kind == "simulated"
