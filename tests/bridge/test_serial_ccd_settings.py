"""Settings of a serial CCD head that are refused, each with what is wrong."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from pydantic import TypeAdapter, ValidationError

from firmware_bridge.camera_settings import CameraSettings

REFUSED_SETTINGS = [
    ({"dialect": "sony"}, "dialect"),
    ({"baud": 1234}, "baud"),
    ({"trigger": "Line9"}, "trigger"),
    ({"frames": {"kind": "raw", "path": "x", "bits": 12}}, "bits"),
    ({"frames": {"kind": "usb", "path": "x"}}, "frames"),
    ({"exposure_min_us": 5e6}, "exposure_max_us must be more"),
    ({"us_per_count": 0.0}, "us_per_count"),
]


@pytest.mark.parametrize(("wrong", "says"), REFUSED_SETTINGS, ids=[row[1] for row in REFUSED_SETTINGS])
def test_settings_that_cannot_be_are_refused(wrong: dict[str, Any], says: str) -> None:
    good = {"kind": "serial_ccd", "dialect": "jai", "port": "p", "frames": {"kind": "raw", "path": "x"}}
    assert TypeAdapter(CameraSettings).validate_python(good).under(Path("/etc")).port == "p"
    with pytest.raises(ValidationError, match=says):
        TypeAdapter(CameraSettings).validate_python(good | wrong)
