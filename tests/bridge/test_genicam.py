"""GenICam cameras against Aravis' GigE Vision camera, which shows a frame scaled by the exposure."""

from __future__ import annotations

import contextlib
import itertools
import os
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gige
import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError

from firmware_bridge import errors
from firmware_bridge.camera_settings import CameraSettings
from firmware_bridge.contracts import CameraFrame
from firmware_bridge.drivers.genicam_camera import GenicamCamera
from firmware_bridge.drivers.genicam_features import Region, Wanted
from firmware_bridge.factory import build_camera
from firmware_bridge.links import aravis_library
from firmware_bridge.wire.pixel_formats import FORMATS

pytestmark = pytest.mark.xdist_group(gige.PORT)
SFNC, OLDER = "gige_camera.xml", "-"
DEADLINE_S, COMMAND_S = 5.0, 2.0
MOST_LOST = 5
SLACK_S = 3.0
"""A loaded machine wakes late; a call that takes so much longer than its deadline has none."""


@pytest.fixture
def camera_at() -> Iterator[Callable[..., GenicamCamera]]:
    """``camera_at(name, **wanted)``: the driver, open."""
    with contextlib.ExitStack() as stack:

        def make(name: str | None = gige.ADDRESS, *, deadline_s: float = DEADLINE_S, **wanted: Any) -> GenicamCamera:
            camera = GenicamCamera(name, Wanted(**wanted), deadline_s=deadline_s, command_deadline_s=COMMAND_S)
            stack.callback(camera.close)
            camera.open()
            return camera

        yield make


def _taken(camera: GenicamCamera, exposure_us: float) -> CameraFrame:
    """One frame with that exposure. What a loaded machine loses on the way is reported; then, as the service does,
    the camera is opened anew."""
    for _ in range(MOST_LOST):
        try:
            assert camera.set_exposure_us(exposure_us) == exposure_us
            return camera.grab()
        except (errors.ReplyWrong, errors.NoReply, errors.DeviceGone):
            camera.open()
    pytest.fail(f"{MOST_LOST} frames on end were lost")


def _assert_shows(camera: GenicamCamera, peer: gige.GigeCamera, exposure_us: float, **shown: Any) -> CameraFrame:
    """One frame with the exposure asked for, proved by every pixel."""
    frame = _taken(camera, exposure_us)
    assert frame.exposure_us == exposure_us
    assert np.array_equal(frame.image, peer.shown(exposure_us, **shown))
    return frame


@pytest.mark.parametrize("features", [SFNC, OLDER])
def test_frames_and_capabilities(features: str, gige_camera: Any, camera_at: Any) -> None:
    peer, camera = gige_camera(features), camera_at()
    able = camera.capabilities()
    assert (able.width_px, able.height_px, able.exposure_min_us, able.exposure_step_us) == (640, 480, 10.0, 1.0)
    assert set(able.triggers) == {"Software", "Line0"}
    before_s = time.time()
    frames = [_assert_shows(camera, peer, us) for us in (10.0, 1000.0, 700.0, 5000.0)]
    assert before_s <= frames[0].taken_at_s <= time.time()
    assert frames[0].name == f"{gige.SERIAL}#{frames[0].frame_id}"
    assert not camera.simulated
    for earlier, later in itertools.pairwise(frames):
        assert later.frame_id > earlier.frame_id
        assert later.camera_time_ns > earlier.camera_time_ns


@pytest.mark.parametrize("name", FORMATS)
def test_pixel_formats(name: str, gige_camera: Any, camera_at: Any) -> None:
    peer, camera = gige_camera(), camera_at(pixel_format=name)
    for exposure_us in (333.0, 4000.0):
        _assert_shows(camera, peer, exposure_us, bits=FORMATS[name].bits)


def test_region_and_gain(gige_camera: Any, camera_at: Any) -> None:
    peer, region = gige_camera(), Region(101, 52, 332, 110)
    camera = camera_at(region=region, gain_db=6.0, pixel_format="Mono10p")
    _assert_shows(camera, peer, 500.0, bits=10, gain_db=6, region=region)
    assert (camera.capabilities().width_px, camera.capabilities().height_px) == (332, 110)
    camera.close()
    whole = camera_at()
    _assert_shows(whole, peer, 1000.0)


@pytest.mark.parametrize("exposure_us", [9.0, 1e6 + 1, -1.0, float("nan"), float("inf")])
def test_exposures_outside_the_range_are_not_sent(exposure_us: float, gige_camera: Any, camera_at: Any) -> None:
    peer, camera = gige_camera(), camera_at()
    _assert_shows(camera, peer, 700.0)
    with pytest.raises(errors.OutOfRange, match="outside 10 to 1e\\+06 us"):
        camera.set_exposure_us(exposure_us)
    assert camera.grab().exposure_us == 700.0


REFUSED = [
    ("format", {"pixel_format": "Mono14"}, errors.Refused, "Mono14"),
    ("gain", {"gain_db": 25.0}, errors.OutOfRange, "gain 25 dB is outside 0 to 24 dB"),
    ("trigger", {"trigger": "Line7"}, errors.Refused, "Line7"),
    ("region", {"region": Region(600, 0, 100, 480)}, errors.OutOfRange, "outside the sensor's 640 x 480"),
]


@pytest.mark.parametrize(("wanted", "error", "words"), [row[1:] for row in REFUSED], ids=[row[0] for row in REFUSED])
def test_what_the_camera_has_not_is_refused(
    wanted: Any, error: type[Exception], words: str, gige_camera: Any, camera_at: Any
) -> None:
    gige_camera()
    with pytest.raises(error, match=words):
        camera_at(**wanted)
    camera_at()


@pytest.mark.parametrize("name", [None, gige.ADDRESS, f"Aravis-{gige.SERIAL}", gige.SERIAL])
def test_a_camera_is_found_by(name: str | None, gige_camera: Any, camera_at: Any) -> None:
    gige_camera()
    camera = camera_at(name)
    # No frame: the broadcast that finds a camera by name may go out by another interface than this one listens on.
    assert camera.set_exposure_us(1234.0) == 1234.0


def test_a_camera_that_is_not_there(gige_camera: Any, camera_at: Any) -> None:
    gige_camera()
    started_s = time.monotonic()
    with pytest.raises(errors.DeviceGone, match="check its power"):
        camera_at("127.0.0.9", deadline_s=2.0)
    assert time.monotonic() - started_s < 2.0 + SLACK_S


def test_two_programs_do_not_share_a_camera(gige_camera: Any, camera_at: Any) -> None:
    peer = gige_camera()
    first = camera_at()
    with pytest.raises(errors.BridgeError):
        camera_at(deadline_s=1.0)
    _assert_shows(first, peer, 1000.0)


def test_a_running_camera_shows_no_frame_begun_under_another_exposure(gige_camera: Any, camera_at: Any) -> None:
    peer, camera = gige_camera(), camera_at(trigger="Off")
    ids = [_assert_shows(camera, peer, us).frame_id for us in (1000.0, 300.0, 300.0, 4000.0, 20.0)]
    assert ids == sorted(set(ids))


def test_a_signal_on_its_line_begins_each_frame(gige_camera: Any, camera_at: Any, wait_until: Any) -> None:
    peer, camera = gige_camera(), camera_at(trigger="Line0")
    for exposure_us in (1000.0, 1000.0, 250.0):
        with _pulsed(peer):
            _assert_shows(camera, peer, exposure_us)


def test_a_line_that_stands_still_is_no_fault(gige_camera: Any, camera_at: Any) -> None:
    gige_camera()
    with pytest.raises(errors.NoTrigger, match="no signal on Line0"):
        camera_at(trigger="Line0", deadline_s=0.5).grab()


def test_frames_taken_unasked_are_told_by_the_line_that_then_stands_still(
    gige_camera: Any, camera_at: Any, wait_until: Any
) -> None:
    peer, camera = gige_camera(), camera_at(trigger="Line0", deadline_s=3.0)

    def told() -> int:
        peer.pulse()
        threading.Event().wait(0.1)  # the frame comes while nobody asks for it: that is the subject
        try:
            camera.grab()
        except errors.NoTrigger as waits:
            return waits.passed_over
        return 0

    assert wait_until(told, "a frame that nobody asked for") == 1
    with pytest.raises(errors.NoTrigger) as caught:
        camera.grab()
    assert caught.value.passed_over == 0


@contextlib.contextmanager
def _pulsed(peer: gige.GigeCamera, every_s: float = 0.1) -> Iterator[None]:
    """Signals on Line0, until something came of them."""
    done = threading.Event()

    def run() -> None:
        while not done.wait(every_s):
            peer.pulse()

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


@pytest.mark.parametrize("frames", [300, pytest.param(1000, marks=pytest.mark.long)])
def test_every_frame_has_its_exposure_or_is_reported(frames: int, gige_camera: Any, camera_at: Any) -> None:
    region = Region(220, 160, 200, 160)
    peer, camera = gige_camera(), camera_at(region=region)
    ids = [_assert_shows(camera, peer, 500.0 + count, region=region).frame_id for count in range(frames)]
    assert ids == sorted(set(ids))
    assert ids[-1] <= frames + 10, "a gap is a frame that was lost"


def test_lost_packets_are_reported(gige_camera: Any, camera_at: Any) -> None:
    peer, camera = gige_camera(lost=0.005), camera_at(deadline_s=1.0, packet_size_bytes=1500)
    good, reported = 0, 0
    for exposure_us in range(1000, 1040):
        camera.set_exposure_us(exposure_us)
        try:
            frame = camera.grab()
        except (errors.ReplyWrong, errors.NoReply):
            reported += 1
        else:
            good += np.array_equal(frame.image, peer.shown(exposure_us))
    assert reported > 0
    assert good + reported == 40


def test_closing_twice_and_opening_again(gige_camera: Any, camera_at: Any) -> None:
    peer, camera = gige_camera(), camera_at()
    last = _assert_shows(camera, peer, 1000.0).frame_id
    camera.close()
    camera.close()
    for use in (camera.grab, lambda: camera.set_exposure_us(1000.0)):
        with pytest.raises(errors.DeviceGone, match="not open"):
            use()
    camera.open()
    camera.open()
    assert _assert_shows(camera, peer, 2000.0).frame_id > last


def test_closing_ends_a_grab_that_waits(gige_camera: Any, camera_at: Any) -> None:
    gige_camera()
    camera = camera_at(trigger="Line0", deadline_s=100.0)
    seen: list[errors.BridgeError] = []

    def grab() -> None:
        try:
            camera.grab()
        except errors.DeviceGone as error:
            seen.append(error)

    thread = threading.Thread(target=grab)
    thread.start()
    camera.close()
    thread.join(30)
    assert not thread.is_alive()
    assert seen


@pytest.mark.parametrize("times", [5, pytest.param(200, marks=pytest.mark.long)])
def test_reopening_leaves_nothing_behind(times: int, gige_camera: Any, camera_at: Any, wait_until: Any) -> None:
    gige_camera()
    camera = camera_at()
    for _ in range(3):
        camera.open()
        _taken(camera, 1000.0)
    camera.close()
    before = gige.Traces.of(os.getpid())
    for _ in range(times):
        camera.open()
        _taken(camera, 1000.0)
        camera.close()
    wait_until(lambda: gige.Traces.of(os.getpid()).within(before), "all is given back")


def outage(camera: GenicamCamera, peer: gige.GigeCamera, wait_until: Any) -> None:
    """The camera dies unseen; the next use says so in time; it is plugged in again and found again."""
    peer.kill()
    started_s = time.monotonic()
    with pytest.raises(errors.DeviceGone):
        camera.grab()
    assert time.monotonic() - started_s < COMMAND_S + SLACK_S
    camera.close()
    peer.start()

    def opened() -> bool:
        try:
            camera.open()
        except errors.DeviceGone:
            return False
        return True

    wait_until(opened, "the camera is found again", 40)


def test_a_killed_camera_is_gone_in_time_and_found_again(gige_camera: Any, camera_at: Any, wait_until: Any) -> None:
    peer, camera = gige_camera(), camera_at()
    _assert_shows(camera, peer, 1000.0)
    outage(camera, peer, wait_until)
    _assert_shows(camera, peer, 2000.0)


def test_a_camera_killed_while_its_line_is_waited_for(gige_camera: Any, camera_at: Any) -> None:
    peer = gige_camera()
    camera = camera_at(trigger="Line0", deadline_s=100.0)
    threading.Timer(0.3, peer.kill).start()
    started_s = time.monotonic()
    with pytest.raises(errors.DeviceGone):
        camera.grab()
    assert time.monotonic() - started_s < 0.3 + COMMAND_S + SLACK_S


def test_without_the_library_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(aravis_library, "LIBRARY", "libaravis-none.so")
    aravis_library._functions.cache_clear()
    with pytest.raises(errors.DeviceGone, match=r"libaravis-none\.so.*apt install libaravis-0\.8-0"):
        GenicamCamera(None, Wanted()).open()


SETTINGS: dict[str, Any] = {"kind": "genicam", "camera": "10.0.0.7", "roi": {"width_px": 640, "height_px": 400}}


def test_settings_make_the_driver() -> None:
    settings = TypeAdapter(CameraSettings).validate_python(SETTINGS)
    assert isinstance(build_camera(settings), GenicamCamera)
    assert settings.under(Path("/etc/station")) == settings


@pytest.mark.parametrize(("field", "value"), [
    ("camera", ""), ("pixel_format", "RGB8"), ("trigger", "on"), ("deadline_s", 1.0), ("command_deadline_s", 0.0),
    ("packet_size_bytes", 100), ("roi", {"width_px": 0, "height_px": 4}), ("exposure", 1),
])  # fmt: skip
def test_settings_refuse(field: str, value: Any) -> None:
    with pytest.raises(ValidationError, match=field):
        TypeAdapter(CameraSettings).validate_python(SETTINGS | {field: value})
