"""Single seeds through other cameras and lamps, rendered by the laboratory: found and measured as well."""

from __future__ import annotations

import numpy as np
import pytest

from inspector import optics
from inspector.lab import sets
from inspector.lab.render import render
from inspector.model import Frame
from inspector.pipeline import Station, inspect

STATIONS = ("upright", "steep", "wide", "lamp_near")
"""Those that render in a second: view angles 47 to 60 degrees, both signs of distortion, a lamp 250 mm away."""


def station(scene: sets.Scene) -> Station:
    """What an inspection is told of a scene: camera, lamp and gamma."""
    lamp = scene.lamp
    light = optics.Light(lamp.direction) if lamp.position_mm is None else optics.Light(None, lamp.position_mm)
    sensor = optics.Sensor(gamma=scene.sensor.gamma)
    return Station(optics.Calibration(scene.camera, light, scene.camera.view_angle_deg, sensor))


@pytest.mark.parametrize("name", STATIONS)
def test_a_seed_is_found_and_measured(name: str) -> None:
    scene = next(sets.random_scenes("A", 1, 1, sets.stations()[name]))
    image, truth = render(scene)
    result = inspect(Frame(image, name), station(scene))
    (seed,), (defect,) = truth["defects"], result.defects
    for found, true in ((defect.direct_px, seed["direct_px"]), (defect.mirror_px, seed["mirror_px"])):
        assert np.abs(np.subtract(found, true)).max() < 0.15
    error_um = defect.height_um - 1000 * seed["height_a"]
    assert defect.height_sigma_um is not None
    assert abs(error_um) < 4 * defect.height_sigma_um
    assert abs(error_um) < 0.01 * defect.height_um
