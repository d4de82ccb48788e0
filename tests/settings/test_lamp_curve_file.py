"""The file of a measured lamp curve: written, read into settings, and refused with its place when it makes no curve."""

from __future__ import annotations

import itertools
import math
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from firmware_bridge.wire import lamp_curve
from inspector import lamp_curve_file
from inspector.settings import SettingsError, configuration_hash, load, load_devices

CONFIG = Path(__file__).parents[2] / "config"
NOW = datetime(2026, 11, 3, 10, 15, tzinfo=UTC)
MEASURED = [(5.0, 200.4), (0.0, 0.4), (0.5, 0.5), (1.0, 4.4), (2.5, 60.4), (4.0, 140.4)]
"""A halogen lamp: nothing below 1 V, then steeper than the level."""


@pytest.fixture
def station(tmp_path: Path) -> Any:
    """``station(lamp)``: the demo's settings with another lamp section, written beside the curve's file."""

    def write(lamp: dict[str, Any]) -> Path:
        settings = yaml.safe_load((CONFIG / "demo.yaml").read_text())
        settings["calibration"] = str(CONFIG / "calibration" / "demo.yaml")
        settings["camera"]["paths"] = [str(CONFIG / "frames")]
        file = tmp_path / "station.yaml"
        file.write_text(yaml.safe_dump(settings | {"lamp": lamp}))
        return file

    return write


def test_a_measured_curve_is_used_by_the_station(station: Any, tmp_path: Path) -> None:
    lamp_curve_file.write(tmp_path / "curve.yaml", MEASURED, NOW)
    lamp = load(station({"curve": "curve.yaml"})).lamp
    assert lamp.curve[0] == (0.0, 0.0)
    assert lamp.curve[-1] == (100.0, 5.0)
    assert lamp.volts(70.0) == pytest.approx(4.0)
    assert lamp.volts(30.0) == pytest.approx(2.5)
    assert lamp.percent(1.0) == pytest.approx(2.0)
    assert lamp.percent(0.5) == pytest.approx(0.05), "no light yet"
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".")] == []


def test_another_measurement_is_another_configuration(station: Any, tmp_path: Path) -> None:
    hashes = set()
    for light in (140.4, 150.0):
        lamp_curve_file.write(tmp_path / "curve.yaml", [*MEASURED[:-1], (4.0, light)], NOW)
        hashes.add(configuration_hash(load(station({"curve": "curve.yaml"}))))
    hashes.add(configuration_hash(load(station({"curve": "curve.yaml", "hours_file": "hours.json"}))))
    assert len(hashes) == 2, "where hours are kept changes nothing"


def test_the_hours_file_is_found_from_the_settings_file(station: Any, tmp_path: Path) -> None:
    assert load(station({"hours_file": "hours.json"})).lamp.hours_file == tmp_path / "hours.json"


REFUSED = {
    "no file": (None, "lamp.curve: .*cannot be read"),
    "not YAML": ("[", "not YAML"),
    "another version": ("version: 2\nsamples: [[0, 0], [5, 1]]\n", r"lamp\.curve\.version"),
    "above the clamp": ("version: 1\nsamples: [[0, 0], [5.5, 1]]\n", r"curve.yaml:2: lamp\.curve\.samples"),
    "no zero": ("version: 1\nsamples: [[1, 0], [5, 1]]\n", "one at 0 V"),
    "twice": ("version: 1\nsamples: [[0, 0], [5, 1], [5, 2]]\n", "only once"),
    "dark": ("version: 1\nsamples: [[0, 3], [5, 3]]\n", "no more light than 0 V"),
    "clipped": ("version: 1\nsamples: [[0, 0], [3, 255], [4, 255], [5, 200]]\n", "clipped around 3 V"),
    "unsteady": ("version: 1\nsamples: [[0, 0], [2, 90], [3, 60], [5, 200]]\n", "not steady"),
}


@pytest.mark.parametrize(("text", "said"), REFUSED.values(), ids=REFUSED)
def test_what_makes_no_curve_is_refused_at_its_place(text: str | None, said: str, station: Any, tmp_path: Path) -> None:
    if text is not None:
        (tmp_path / "curve.yaml").write_text(text)
    file = station({"curve": "curve.yaml"})
    for read in (load, load_devices):
        with pytest.raises(SettingsError, match=said):
            read(file)


def test_samples_that_make_no_curve_are_not_written(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no more light"):
        lamp_curve_file.write(tmp_path / "curve.yaml", [(0.0, 1.0), (5.0, 1.0)], NOW)
    assert not list(tmp_path.iterdir())


@given(
    st.lists(st.floats(0.01, 4.99).map(lambda v: round(v, 2)), unique=True, max_size=20),
    st.floats(0.5, 4),
    st.floats(-5, 5),
)
def test_any_rising_light_makes_a_curve(levels: list[float], power: float, dark: float) -> None:
    samples = [(level_v, dark + 200 * (level_v / 5) ** power) for level_v in [0.0, *levels, 5.0]]
    curve = lamp_curve.from_samples(samples)
    assert curve[0] == (0.0, 0.0)
    assert curve[-1] == (100.0, 5.0)
    assert all(a[0] < b[0] and a[1] < b[1] for a, b in itertools.pairwise(curve))
    for level_v, light in samples:
        percent = 100 * (light - dark) / 200
        assert lamp_curve.percent(curve, level_v) == pytest.approx(percent, abs=0.25)
        assert not math.isnan(lamp_curve.volts(curve, percent))
