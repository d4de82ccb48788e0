"""What every camera driver promises, each against the other side of its wire; a driver missing here fails a test."""

from __future__ import annotations

import contextlib
import itertools
import os
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, get_args

import gige
import numpy as np
import pytest
from pydantic import TypeAdapter

from firmware_bridge import errors
from firmware_bridge.camera_settings import CameraSettings
from firmware_bridge.contracts import Camera, CameraFrame
from firmware_bridge.factory import build_camera
from firmware_bridge.simulators.ccd_server import CcdServer
from firmware_bridge.simulators.ccd_state import SimulatedCcdHead
from firmware_bridge.wire.ccd_dialects import DIALECTS
from firmware_bridge.wire.raw_frames import RawFormat

Rig = Callable[[pytest.FixtureRequest, contextlib.ExitStack, Path], dict[str, Any]]
"""Starts the other side of the wire; gives the settings that lead there."""

MOST_LOST = 5


def _replay(request: pytest.FixtureRequest, stack: contextlib.ExitStack, folder: Path) -> dict[str, Any]:
    shutil.copytree(request.getfixturevalue("frames_folder"), folder / "recording")
    return {"kind": "replay", "paths": [str(folder / "recording")], "rate_hz": 100}


def _serial_ccd(dialect: str) -> Rig:
    def start(request: pytest.FixtureRequest, stack: contextlib.ExitStack, folder: Path) -> dict[str, Any]:
        form = RawFormat(48, 36, 8, True)
        head = SimulatedCcdHead(DIALECTS[dialect])
        server = CcdServer(head, symlink=folder / "port", frames=folder / "frames", form=form, rate_hz=200.0).start()
        stack.callback(server.stop)
        frames = {"kind": "raw", "path": str(folder / "frames"), "width_px": 48, "height_px": 36, "header": True}
        return {"kind": "serial_ccd", "dialect": dialect, "port": str(folder / "port"), "frames": frames}

    return start


def _genicam(features: str) -> Rig:
    def start(request: pytest.FixtureRequest, stack: contextlib.ExitStack, folder: Path) -> dict[str, Any]:
        request.getfixturevalue("gige_camera")(features)
        return {"kind": "genicam", "camera": gige.ADDRESS}

    return start


RIGS: dict[str, tuple[str, Rig]] = {
    "replay": ("replay", _replay),
    "serial_ccd-dalsa": ("serial_ccd", _serial_ccd("dalsa")),
    "serial_ccd-jai": ("serial_ccd", _serial_ccd("jai")),
    "simulated": ("simulated", lambda *_: {"kind": "simulated", "rate_hz": 200}),
    "genicam": ("genicam", _genicam("gige_camera.xml")),
    "genicam-older": ("genicam", _genicam("-")),
}


@pytest.fixture(
    params=[
        pytest.param(name, marks=pytest.mark.xdist_group(gige.PORT)) if "genicam" in name else name for name in RIGS
    ]
)
def camera(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Camera]:
    """The driver, built from settings, not yet open."""
    with contextlib.ExitStack() as stack:
        settings = RIGS[request.param][1](request, stack, tmp_path)
        built = build_camera(TypeAdapter(CameraSettings).validate_python(settings))
        stack.callback(built.close)
        yield built


def _grabbed(camera: Camera) -> CameraFrame:
    """A frame; one that a loaded machine lost on the way is reported, and the camera opened anew, as after a pipe whose
    writer hangs up: it may only now see that its last reader went."""
    for _ in range(MOST_LOST):
        try:
            return camera.grab()
        except (errors.ReplyWrong, errors.NoReply, errors.DeviceGone):
            camera.open()
    pytest.fail(f"{MOST_LOST} frames on end were lost")


def test_every_kind_of_camera_is_here() -> None:
    models = get_args(get_args(CameraSettings)[0])
    kinds = {get_args(model.model_fields["kind"].annotation)[0] for model in models}
    assert {kind for kind, _ in RIGS.values()} == kinds


def test_frames_carry_what_they_were_taken_at(camera: Camera) -> None:
    camera.open()
    able = camera.capabilities()
    assert 0 < able.exposure_min_us < able.exposure_max_us
    assert able.exposure_step_us > 0
    read_us = camera.set_exposure_us(1000.0)
    assert read_us == pytest.approx(1000.0, abs=able.exposure_step_us)
    before_s = time.time()
    frames = [_grabbed(camera) for _ in range(4)]
    able = camera.capabilities()
    for frame in frames:
        assert frame.image.dtype in (np.uint8, np.uint16)
        assert frame.image.flags.c_contiguous
        assert frame.image.shape == (able.height_px, able.width_px)
        assert frame.exposure_us in (None, pytest.approx(read_us))
        assert before_s - 1 <= frame.taken_at_s <= time.time()
        assert frame.name
    assert all(later.frame_id > earlier.frame_id for earlier, later in itertools.pairwise(frames))


@pytest.mark.parametrize("set_by_s", [3600.0, -3600.0])
def test_a_clock_that_is_set_moves_no_frame_in_time(
    camera: Camera, set_by_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What tells how far a panel has moved is the monotonic clock; set between two frames, Unix time only says when."""
    camera.open()
    camera.set_exposure_us(1000.0)
    unix_time = time.time
    before_s = time.monotonic()
    first = _grabbed(camera)
    between_s = time.monotonic()
    monkeypatch.setattr(time, "time", lambda: unix_time() + set_by_s)
    second = _grabbed(camera)
    assert before_s - 0.001 <= first.taken_s <= between_s
    assert between_s <= second.taken_s <= time.monotonic()


@pytest.mark.parametrize("outside", [0.0, -5.0, 1e12, float("nan"), float("inf")])
def test_exposures_outside_the_range_are_refused(camera: Camera, outside: float) -> None:
    camera.open()
    read_us = camera.set_exposure_us(1000.0)
    with pytest.raises(errors.OutOfRange, match="outside"):
        camera.set_exposure_us(outside)
    assert _grabbed(camera).exposure_us in (None, read_us)


def test_it_closes_twice_and_opens_again(camera: Camera) -> None:
    camera.close()
    with pytest.raises(errors.DeviceGone):
        camera.grab()
    camera.open()
    _grabbed(camera)
    camera.close()
    camera.close()
    with pytest.raises(errors.DeviceGone):
        camera.grab()
    camera.open()
    camera.open()
    camera.set_exposure_us(1000.0)
    _grabbed(camera)


def test_reopening_leaves_nothing_behind(camera: Camera, wait_until: Any) -> None:
    def once() -> None:
        camera.open()
        _grabbed(camera)
        camera.close()

    once()
    before = gige.Traces.of(os.getpid())
    for _ in range(5):
        once()
    # The other side may share this process, and may not yet have closed the last connection's own end.
    wait_until(lambda: gige.Traces.of(os.getpid()).within(before, spare=1), "all is given back")


def test_it_says_whether_it_shows_the_line(camera: Camera, request: pytest.FixtureRequest) -> None:
    assert camera.simulated == (request.node.callspec.params["camera"] in ("replay", "simulated"))
