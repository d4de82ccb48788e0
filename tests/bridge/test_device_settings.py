"""Device settings: what is refused, at which path, before anything is touched; and what the factory makes of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from pydantic import TypeAdapter, ValidationError

from firmware_bridge.camera_settings import CameraSettings
from firmware_bridge.drivers.lamp import FostecLamp
from firmware_bridge.drivers.replay_camera import ReplayCamera
from firmware_bridge.factory import build
from firmware_bridge.settings import LampSettings, ModuleSettings, Strict, conflicts
from firmware_bridge.wire.profiles import PROFILES

SERIAL = {"kind": "serial", "port": "/dev/serial/by-id/adapter"}
SIMULATED = {"kind": "simulated"}


class Station(Strict):
    """As the service composes them."""

    camera: CameraSettings
    module: ModuleSettings
    lamp: LampSettings = LampSettings()


GOOD: dict[str, Any] = {
    "camera": {"kind": "replay", "paths": ["frames"], "rate_hz": 2},
    "module": {"profile": "tm-da1p1r1", "unit": 3, "link": SERIAL, "safe_v": 1.0, "watchdog_s": 3.0},
    "lamp": {"curve": [[0, 0], [50, 2.0], [100, 5.0]]},
}


def test_a_station_is_read_and_built_without_touching_anything() -> None:
    station = Station.model_validate(GOOD)
    devices = build(station.camera, station.module, station.lamp)
    assert isinstance(devices.camera, ReplayCamera)
    assert isinstance(devices.lamp, FostecLamp)
    assert devices.camera.simulated
    assert not devices.lamp.simulated
    assert conflicts(station.module, station.lamp) == []


REFUSED = [
    ("camera.kind", {"kind": "film"}, "camera", "replay"),
    ("camera.paths", {"kind": "replay", "paths": []}, "camera.replay.paths", "at least 1"),
    ("camera.rate_hz", {"kind": "replay", "paths": ["a"], "rate_hz": -1}, "camera.replay.rate_hz", "greater"),
    ("camera.loop", {"kind": "replay", "paths": ["a"], "loop": "yes"}, "camera.replay.loop", "boolean"),
    ("camera.deadline", {"kind": "replay", "paths": ["a"], "rate_hz": 0.1}, "camera.replay.deadline_s", "10 s between"),
    ("module.profile", {"profile": "adam", "link": SIMULATED}, "module.profile", "adam-4024, adam-4021"),
    ("module.unit", {"profile": "ato-4ch", "unit": 248, "link": SIMULATED}, "module.unit", "247"),
    ("module.unit text", {"profile": "ato-4ch", "unit": "3", "link": SIMULATED}, "module.unit", "integer"),
    ("module.link", {"profile": "ato-4ch"}, "module.link", "required"),
    ("module.link.kind", {"profile": "ato-4ch", "link": {"kind": "usb"}}, "module.link", "serial"),
    ("module.link.baud", {"profile": "ato-4ch", "link": SERIAL | {"baud": 9601}}, "module.link.serial.baud", "9600"),
    ("module.link.typo", {"profile": "ato-4ch", "link": SERIAL | {"baut": 1}}, "module.link.serial.baut", "not perm"),
    ("network only", {"profile": "iologik-e1241", "link": SERIAL}, "module.link", "use kind tcp"),
    ("no safe value", {"profile": "ato-4ch", "link": SERIAL, "safe_v": 1.0}, "module.safe_v", "use null"),
    ("no watchdog", {"profile": "ato-4ch", "link": SERIAL, "watchdog_s": 1.0}, "module.watchdog_s", "use null"),
    ("long", {"profile": "tm-da1p1r1", "link": SERIAL, "watchdog_s": 26.0}, "module.watchdog_s", "0.1 to 25.5 s"),
    ("lamp.channel", {"channel": -1}, "lamp.channel", "0"),
    ("lamp.curve high", {"curve": [[0, 0], [100, 5.1]]}, "lamp.curve.1.1", "5"),
    ("lamp.curve falls", {"curve": [[0, 0], [50, 3.0], [100, 2.0]]}, "lamp.curve", "rise"),
    ("lamp.curve short", {"curve": [[0, 0]]}, "lamp.curve", "at least two"),
    ("lamp.tolerance", {"tolerance_v": 0.0}, "lamp.tolerance_v", "greater"),
]


@pytest.mark.parametrize(("case", "value", "path", "allowed"), REFUSED, ids=[row[0] for row in REFUSED])
def test_refusals_name_the_path_and_what_is_allowed(case: str, value: Any, path: str, allowed: str) -> None:
    with pytest.raises(ValidationError) as refused:
        Station.model_validate(GOOD | {path.partition(".")[0]: value})
    (problem,) = refused.value.errors()
    assert ".".join(map(str, problem["loc"])) == path
    assert allowed in problem["msg"]


def test_what_does_not_fit_together_is_said_for_the_station() -> None:
    module = ModuleSettings.model_validate({"profile": "adam-4024", "link": SIMULATED})
    found = conflicts(module, LampSettings(channel=4, tolerance_v=0.001))
    assert found == [
        ("lamp.channel", 4, "0 to 3 on adam-4024"),
        ("lamp.tolerance_v", 0.001, "at least one count, 0.0049 V"),
    ]


def test_relative_paths_count_from_the_settings_file() -> None:
    camera = TypeAdapter(CameraSettings).validate_python({"kind": "replay", "paths": ["a", "/b"]})
    assert camera.under(Path("/etc/station")).paths == (Path("/etc/station/a"), Path("/b"))


def test_the_schema_lists_the_profiles() -> None:
    assert ModuleSettings.model_json_schema()["properties"]["profile"]["enum"] == list(PROFILES)
