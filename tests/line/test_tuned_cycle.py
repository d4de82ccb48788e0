"""Levels that move from panel to panel: exposure by the spots, lamp by a reference patch, over a drawn panel."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drawn import Drawing

from firmware_bridge.contracts import CameraCapabilities, CameraFrame
from firmware_bridge.factory import Devices
from inspector.detect.highlights import find
from inspector.faults import Fault
from inspector.model import Flag, Frame, FrameResult, Image, Snapshot, State, Verdict
from inspector.recipe import Detection
from inspector.service.cycle import Cycle
from inspector.settings import Settings

SHAPE = (60, 80)
SPOTS = np.array([[20.2, 30.4], [29.7, 30.1]])
PATCH = {"x_px": 56, "y_px": 8, "width_px": 16, "height_px": 12}
PATCH_DN, PEAK_DN = 120.0, 2000.0
"""The patch, and the brighter spot if it did not clip, at 1000 us and 4 V with a new bulb."""


LIGHT = {"patch": PATCH, "target_dn": PATCH_DN + 3, "black_dn": 3.0, "trim_percent_per_minute": 2.0}


class Scene:
    """Lamp and camera before a panel with two spots and a white patch; ``bulb``: the light it still gives."""

    simulated = False

    def __init__(self) -> None:
        self.bulb, self.volts, self.exposure_us, self.taken = 1.0, 0.0, 0.0, 0
        self.now_s = 0.0
        self.drawing = Drawing(SHAPE, blur_px=1.0, panel_dn=2.0)

    def open(self) -> None: ...
    def close(self) -> None: ...
    def keep_alive(self) -> None: ...

    def burnt_hours(self) -> float:
        return 0.0

    def set_volts(self, volts: float) -> float:
        self.volts = volts
        return volts

    def read_volts(self) -> float:
        return self.volts

    def capabilities(self) -> CameraCapabilities:
        return CameraCapabilities(1.0, 1e6, 1.0, *SHAPE[::-1])

    def set_exposure_us(self, exposure_us: float) -> float:
        self.exposure_us = exposure_us
        return exposure_us

    def grab(self) -> CameraFrame:
        self.taken += 1
        return CameraFrame(self._image(), self.taken, f"{self.taken}", self.exposure_us, 0.0, 0.0)

    def _image(self) -> Image:
        light = self.bulb * self.volts / 4 * self.exposure_us / 1000
        image = replace(self.drawing, panel_dn=2.0 * light).draw(SPOTS, np.array([1.0, 0.6]) * PEAK_DN * light)
        rows, columns = slice(8, 20), slice(56, 72)
        image[rows, columns] = min(self.drawing.black_dn + PATCH_DN * light, 255)
        return image


def station(**sections: Any) -> Settings:
    base = {
        "calibration": Path("calibration.yaml"),
        "camera": {"kind": "replay", "paths": [Path("frames")]},
        "module": {"profile": "ato-4ch", "link": {"kind": "simulated"}},
    }
    return Settings.model_validate(base | sections)


def inspect(frame: Frame) -> FrameResult:
    return FrameResult(frame.name, Verdict.PASS, highlights=find(frame.image, Detection(), Drawing().sensor))


def at_work(settings: Settings) -> tuple[Scene, Cycle, Snapshot]:
    scene = Scene()
    return scene, Cycle(settings, Devices(scene, scene), inspect, clock=lambda: scene.now_s), Snapshot()


def test_exposure_follows_the_spots_from_panel_to_panel_and_every_frame_is_as_set() -> None:
    automatic = {"min_us": 10.0, "max_us": 5000.0}
    scene, cycle, shown = at_work(station(recipe={"lamp_percent": 80.0, "automatic_exposure": automatic}, light=LIGHT))
    for _ in range(20):
        wanted = cycle.wanted
        shown = cycle.turn(shown).snapshot
        assert shown.verdict is Verdict.PASS
        assert shown.exposure_us == wanted.exposure_us == scene.exposure_us
        assert shown.lamp_set_v == shown.lamp_read_v == wanted.lamp_v
    assert cycle.wanted.lamp_v == 3.75
    found = inspect(Frame(scene.grab().image[:, :50], "x")).highlights
    assert found is not None
    assert not (found.flags & Flag.SATURATED).any()
    assert 0.7 < found.peak_dn.max() / 252 < 0.97


def test_a_fixed_recipe_stays_whatever_the_spots_do() -> None:
    _, cycle, shown = at_work(station())
    before = cycle.wanted
    for _ in range(12):
        shown = cycle.turn(shown).snapshot
    assert cycle.wanted == before


def test_a_bulb_that_ages_is_trimmed_told_while_inspection_goes_on_and_in_the_end_refused(
    caplog: pytest.LogCaptureFixture,
) -> None:
    scene, cycle, shown = at_work(station(light=LIGHT, recipe={"lamp_percent": 80.0}))
    told_at, refused_at = None, None
    for minute in range(300):
        scene.now_s, scene.bulb = 60.0 * minute, 1 - 0.001 * minute
        shown = cycle.turn(shown).snapshot
        if shown.lamp_weak and told_at is None:
            told_at = minute
            assert shown.verdict is Verdict.PASS
            assert shown.fault_code == 0
        if shown.verdict is not Verdict.PASS:
            refused_at = minute
            break
    assert told_at is not None
    assert refused_at is not None
    assert refused_at - told_at > 120
    assert (shown.fault_code, shown.verdict, shown.state) == (Fault.LAMP_WEAK, Verdict.NOT_INSPECTED, State.ERROR)
    assert sum("fault 203" in record.getMessage() for record in caplog.records) == 1
    scene.bulb = 1.0
    for _ in range(2):
        scene.now_s += 60
        shown = cycle.turn(shown).snapshot
    assert (shown.verdict, shown.fault_code) == (Verdict.PASS, 0)


def test_a_dead_bulb_behind_a_right_read_back_is_no_pass(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    scene, cycle, shown = at_work(station(light=LIGHT))
    shown = cycle.turn(shown).snapshot
    assert shown.verdict is Verdict.PASS
    scene.bulb = 0.0
    for _ in range(3):
        shown = cycle.turn(shown).snapshot
        assert (shown.verdict, shown.fault_code, shown.lamp_ok) == (Verdict.NOT_INSPECTED, Fault.LAMP_WEAK, True)
    scene.bulb = 1.0
    shown = cycle.turn(shown).snapshot
    assert (shown.verdict, shown.fault_code) == (Verdict.PASS, 0)
    said = [record.getMessage() for record in caplog.records]
    assert sum(text.startswith("light fails: ") for text in said) == 1
    assert sum(text.startswith("light works again") for text in said) == 1


def test_light_from_elsewhere_is_no_pass() -> None:
    scene, cycle, shown = at_work(station(light=LIGHT))
    scene.bulb = 1.5
    shown = cycle.turn(shown).snapshot
    assert (shown.verdict, shown.fault_code) == (Verdict.NOT_INSPECTED, Fault.FRAME_OVERLIT)


def test_the_patch_is_expected_as_bright_as_the_moved_level_makes_it() -> None:
    automatic = {"min_us": 10.0, "max_us": 5000.0}
    _, cycle, shown = at_work(station(light=LIGHT, recipe={"automatic_exposure": automatic}))
    for _ in range(10):
        shown = cycle.turn(shown).snapshot
        assert shown.verdict is Verdict.PASS
    assert cycle.wanted.exposure_us < 300
