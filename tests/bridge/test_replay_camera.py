"""A recording as a camera: every format, pace, ids, damage, and folders that come and go."""

from __future__ import annotations

import shutil
import threading
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from firmware_bridge import errors
from firmware_bridge.drivers.replay_camera import ReplayCamera

SHAPE = (6, 8)


def _image(level: int, dtype: type = np.uint8) -> np.ndarray:
    image = np.zeros(SHAPE, dtype)
    image[2, 3] = level
    return image


def _save(path: Path, image: np.ndarray) -> Path:
    if path.suffix == ".npy":
        np.save(path, image)
    else:
        assert cv2.imwrite(str(path), image)
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three frames, b before c in name but not in time, and a file that is none."""
    recording = tmp_path / "recording"
    recording.mkdir()
    for level, name in ((3, "c.png"), (1, "a.png"), (2, "b.png")):
        _save(recording / name, _image(level))
    (recording / "truth.json").write_text("{}")
    return recording


def _opened(*paths: Path, **options: Any) -> ReplayCamera:
    camera = ReplayCamera(paths, **options)
    camera.open()
    return camera


def _level(camera: ReplayCamera) -> int:
    return int(camera.grab().image.max())


FORMATS = [
    (suffix, dtype)
    for suffix in (".png", ".tif", ".tiff", ".bmp", ".pgm", ".npy", ".PNG")
    for dtype in (np.uint8, np.uint16)
    if (suffix, dtype) != (".bmp", np.uint16)
]


@pytest.mark.parametrize(("suffix", "dtype"), FORMATS)
def test_formats(tmp_path: Path, suffix: str, dtype: type) -> None:
    image = _image(200 if dtype is np.uint8 else 60000, dtype)
    _save(tmp_path / f"frame{suffix}", image)
    frame = _opened(tmp_path).grab()
    assert frame.image.dtype == dtype
    np.testing.assert_array_equal(frame.image, image)
    assert frame.name == str(tmp_path / f"frame{suffix}")


def test_a_folder_is_shown_by_name_and_again(folder: Path) -> None:
    camera = _opened(folder)
    frames = [camera.grab() for _ in range(4)]
    assert [Path(frame.name).name for frame in frames] == ["a.png", "b.png", "c.png", "a.png"]
    assert [frame.frame_id for frame in frames] == [1, 2, 3, 4]
    assert camera.simulated


def test_files_and_folders_are_shown_in_order(folder: Path, tmp_path: Path) -> None:
    single = _save(tmp_path / "single.npy", _image(9))
    camera = _opened(single, folder, loop=False)
    assert [_level(camera) for _ in range(4)] == [9, 1, 2, 3]


def test_the_end_of_a_recording_is_told_from_a_fault(folder: Path) -> None:
    camera = _opened(folder, loop=False)
    for _ in range(3):
        camera.grab()
    for _ in range(2):
        with pytest.raises(errors.EndOfRecording, match="all 3 frames were shown"):
            camera.grab()


def test_frames_carry_the_exposure_that_was_set(folder: Path) -> None:
    camera = _opened(folder)
    assert camera.grab().exposure_us is None
    assert camera.set_exposure_us(1234.5) == 1234.5
    frame = camera.grab()
    assert frame.exposure_us == 1234.5
    assert abs(frame.taken_at_s - time.time()) < 60
    for exposure_us in (0.5, 1e6 + 1, float("nan")):
        with pytest.raises(errors.OutOfRange):
            camera.set_exposure_us(exposure_us)
    assert camera.grab().exposure_us == 1234.5


def test_capabilities_know_the_shape_after_a_frame(folder: Path) -> None:
    camera = _opened(folder)
    assert camera.capabilities().width_px is None
    camera.grab()
    known = camera.capabilities()
    assert (known.height_px, known.width_px) == SHAPE
    assert known.exposure_min_us <= known.exposure_max_us


BROKEN = {
    "empty.png": b"",
    "text.png": b"not an image",
    "short.npy": b"\x93NUMPY\x01\x00",
    "cut.png": b"\x89PNG\r\n\x1a\n",
}


@pytest.mark.parametrize("name", BROKEN)
def test_an_unreadable_file_is_named_and_passed_over(folder: Path, name: str) -> None:
    (folder / f"aa-{name}").write_bytes(BROKEN[name])
    camera = _opened(folder)
    assert _level(camera) == 1
    with pytest.raises(errors.ReplyWrong, match=f"aa-{name} is "):
        camera.grab()
    frame = camera.grab()
    assert frame.image.max() == 2
    assert frame.frame_id == 3, "the broken one was a frame too"


def test_a_colour_image_is_no_frame(tmp_path: Path) -> None:
    _save(tmp_path / "colour.png", np.zeros((4, 4, 3), np.uint8) + 7)
    with pytest.raises(errors.ReplyWrong, match=r"colour\.png is a colour image"):
        _opened(tmp_path).grab()


@pytest.mark.parametrize("make", [lambda path: None, lambda path: path.mkdir()], ids=["missing", "empty"])
def test_nothing_to_show_is_a_camera_that_is_gone(tmp_path: Path, make: Any) -> None:
    path = tmp_path / "frames"
    make(path)
    with pytest.raises(errors.DeviceGone, match=str(path)):
        _opened(path)


def test_a_folder_that_goes_and_comes_back_is_a_camera_replugged(folder: Path) -> None:
    camera = _opened(folder)
    before = camera.grab()
    away = folder.rename(folder.with_name("away"))
    for _ in range(2):
        with pytest.raises(errors.DeviceGone, match="is missing"):
            camera.grab()
    camera.close()
    with pytest.raises(errors.DeviceGone):
        camera.open()
    away.rename(folder)
    camera.open()
    after = camera.grab()
    assert after.image.max() == 2, "it goes on where it was"
    assert after.frame_id > before.frame_id


def test_one_file_taken_away_is_one_frame_lost(folder: Path) -> None:
    camera = _opened(folder)
    (folder / "a.png").unlink()
    with pytest.raises(errors.ReplyWrong, match=r"a\.png: No such file"):
        camera.grab()
    assert _level(camera) == 2


def test_new_files_are_shown_on_the_next_round(folder: Path) -> None:
    camera = _opened(folder)
    assert [_level(camera) for _ in range(3)] == [1, 2, 3]
    _save(folder / "a0.png", _image(7))
    assert [_level(camera) for _ in range(2)] == [1, 7]


def test_a_folder_emptied_is_a_camera_that_is_gone(folder: Path) -> None:
    camera = _opened(folder)
    for _ in range(3):
        camera.grab()
    shutil.rmtree(folder)
    folder.mkdir()
    with pytest.raises(errors.DeviceGone, match="no frames"):
        camera.grab()


def test_pace(folder: Path) -> None:
    camera = _opened(folder, rate_hz=50.0)
    started_s = time.monotonic()
    for _ in range(6):
        camera.grab()
    assert time.monotonic() - started_s >= 5 / 50


def test_ticks_missed_are_not_made_up_for(folder: Path, wait_until: Any) -> None:
    camera = _opened(folder, rate_hz=20.0)
    camera.grab()
    missed_s = time.monotonic() + 0.3
    wait_until(lambda: time.monotonic() > missed_s, "six ticks pass")
    started_s = time.monotonic()
    for _ in range(3):
        camera.grab()
    assert time.monotonic() - started_s >= 1 / 20, "one frame at once, the others at their ticks"


def test_a_frame_that_is_not_due_in_time_is_a_time_out(folder: Path) -> None:
    camera = _opened(folder, rate_hz=0.01, deadline_s=0.05)
    camera.grab()
    with pytest.raises(errors.NoReply, match=r"no frame in 0.05 s"):
        camera.grab()


def test_closing_ends_a_grab_that_waits(folder: Path) -> None:
    camera = _opened(folder, rate_hz=0.01, deadline_s=100.0)
    camera.grab()
    seen: list[Exception] = []

    def grab() -> None:
        try:
            camera.grab()
        except errors.BridgeError as error:
            seen.append(error)

    thread = threading.Thread(target=grab)
    thread.start()
    camera.close()
    thread.join(30)
    assert not thread.is_alive()
    assert isinstance(seen[0], errors.DeviceGone)


def test_it_closes_twice_and_must_be_open_to_grab(folder: Path) -> None:
    camera = ReplayCamera([folder])
    camera.close()
    with pytest.raises(errors.DeviceGone, match="closed"):
        camera.grab()
    camera.open()
    assert _level(camera) == 1
    camera.close()
    camera.close()
    with pytest.raises(errors.DeviceGone):
        camera.grab()


def test_grabbing_leaves_no_descriptor(folder: Path, descriptors: Any) -> None:
    (folder / "broken.png").write_bytes(b"x")
    camera = _opened(folder)
    _level(camera)
    before = descriptors()
    for _ in range(50):
        try:
            camera.grab()
        except errors.ReplyWrong:
            continue
    assert descriptors() == before
