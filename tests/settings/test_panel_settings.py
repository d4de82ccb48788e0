"""How panels are made of frames: what does not fit the station is refused, with its place and what is allowed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from inspector.settings import SettingsError, load

CALIBRATION = Path(__file__).parents[2] / "config" / "calibration" / "demo.yaml"
PITCH = {"by": {"kind": "pitch", "mm_per_frame": 10.0}}


def written(folder: Path, **sections: Any) -> Path:
    right: dict[str, Any] = {
        "calibration": str(CALIBRATION),
        "camera": {"kind": "replay", "paths": ["frames"]},
        "module": {"profile": "adam-4024", "link": {"kind": "simulated"}},
    }
    file = folder / "station.yaml"
    file.write_text(yaml.safe_dump(right | sections))
    return file


def test_without_a_word_about_panels_each_frame_is_one(tmp_path: Path) -> None:
    assert not load(written(tmp_path)).panel.several


@pytest.mark.parametrize(
    "panel",
    [
        {"frames": {"kind": "count", "count": 3}, "travel": PITCH},
        {"frames": {"kind": "plc"}, "travel": {"by": {"kind": "line_speed", "mm_per_s": 200.0}}},
        {"frames": {"kind": "digital_input", "channel": 3}, "travel": PITCH},
        {"frames": {"kind": "length", "length_mm": 500.0}, "travel": PITCH},
    ],
)
def test_panels_of_several_frames_are_understood(panel: dict[str, Any], tmp_path: Path) -> None:
    assert load(written(tmp_path, panel=panel)).panel.several


@pytest.mark.parametrize(
    ("panel", "trigger", "expected"),
    [
        ({"frames": {"kind": "count", "count": 3}}, "free_running", "panel.travel: None: required where a panel has"),
        ({"frames": {"kind": "many"}}, "free_running", "panel.frames: {'kind': 'many'}: allowed: a mapping whose kind"),
        ({"frames": {"kind": "count", "count": 0}}, "free_running", "panel.frames.count: 0: allowed: a whole number"),
        (
            {"frames": {"kind": "digital_input", "channel": 4}, "travel": PITCH},
            "free_running",
            "panel.frames.channel: 4: the module has 4 digital inputs; allowed: 0 to 3",
        ),
        (
            {"frames": {"kind": "digital_input", "channel": 0}, "travel": PITCH},
            "digital_input",
            "panel.frames.channel: 0: is cycle.trigger's",
        ),
        (
            {
                "frames": {"kind": "plc"},
                "travel": {"by": {"kind": "encoder", "mm_per_pulse": 0.1, "pulses_per_frame": 9}},
            },
            "free_running",
            "panel.travel.by: 'encoder': an encoder triggers the camera itself; allowed with it: cycle.trigger hard",
        ),
        (
            {"frames": {"kind": "plc"}, "travel": {"by": {"kind": "pitch", "mm_per_frame": 5000.0}}},
            "free_running",
            "panel.travel.by: 5000.0: leaves gaps between frames; allowed: up to",
        ),
        (
            {
                "frames": {"kind": "plc"},
                "travel": PITCH,
                "area": {"x_min_mm": 5, "x_max_mm": 5, "y_min_mm": 0, "y_max_mm": 1},
            },
            "free_running",
            "panel.area: ",
        ),
    ],
)
def test_what_does_not_fit_is_refused(panel: dict[str, Any], trigger: str, expected: str, tmp_path: Path) -> None:
    file = written(tmp_path, panel=panel, cycle={"trigger": {"kind": trigger}})
    with pytest.raises(SettingsError) as raised:
        load(file)
    assert any(expected in str(problem) for problem in raised.value.problems), raised.value


def test_a_zone_must_meet_the_panels_area_where_that_is_given(tmp_path: Path) -> None:
    zone = {"name": "far", "x_min_mm": 900.0, "x_max_mm": 910.0, "y_min_mm": 0.0, "y_max_mm": 1.0}
    panel = {"frames": {"kind": "plc"}, "travel": PITCH}
    recipe = {"limits": {"zones": [zone]}}
    load(written(tmp_path, panel=panel, recipe=recipe))  # where the panel lies is not known
    area = {"x_min_mm": 0.0, "x_max_mm": 899.0, "y_min_mm": 0.0, "y_max_mm": 50.0}
    with pytest.raises(SettingsError, match=r"recipe\.limits\.zones\[0\]: 'far'.*is off the panel"):
        load(written(tmp_path, panel=panel | {"area": area}, recipe=recipe))
    load(written(tmp_path, panel=panel | {"area": area | {"x_max_mm": 901.0}}, recipe=recipe))
