"""Frames that must not be judged, shown to the service between good ones: each is told, none has a verdict."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from typing import Any

import numpy as np

from firmware_bridge.simulators.module_server import ModuleServer
from inspector.faults import Fault

SHAPE = (480, 640)


def bad_frames(good: bytes) -> dict[str, tuple[bytes | np.ndarray[Any, Any], str]]:
    """What is wrong with a frame -> the frame, and what is said of it."""
    noise = np.random.default_rng(1).integers(0, 3, SHAPE, np.uint8)
    return {
        "short": (good[: len(good) // 2], "CAMERA_FRAME_WRONG"),
        "empty": (b"", "CAMERA_FRAME_WRONG"),
        "garbled": (good[:40] + bytes(200) + good[240:], "CAMERA_FRAME_WRONG"),
        "black": (np.zeros(SHAPE, np.uint8), "the frame is black"),
        "saturated": (np.full(SHAPE, 255, np.uint8), "the frame is lit all over"),
        "small": (noise[:100], "the frame is 640 x 100 pixels"),
    }


def test_each_bad_frame_is_told_and_the_next_good_one_its_verdict(
    station: Any, module: Callable[[], ModuleServer], service: Callable[..., Any]
) -> None:
    module()
    source = next(path for path in sorted(station.frames.iterdir()) if path.suffix == ".png")
    bad = bad_frames(source.read_bytes())
    for number, (name, (frame, _)) in enumerate(bad.items()):
        shutil.copy(source, station.frames / f"{number}0_good.png")
        if isinstance(frame, bytes):
            (station.frames / f"{number}1_{name}.png").write_bytes(frame)
        else:
            np.save(station.frames / f"{number}1_{name}.npy", frame)
    for path in station.frames.iterdir():
        if not path.name[0].isdigit():
            path.unlink()
    station.settings["camera"] |= {"loop": False, "rate_hz": 0}
    station.write()
    running = service()
    running.until_fault(Fault.CAMERA_TIMEOUT)  # the recording's end
    judged = [line for line in running.results if line.split()[1] in ("PASS", "FAIL")]
    assert [line.split()[-1] for line in judged] == [f"{number}0_good.png" for number in range(len(bad))]
    for number, (name, (_, words)) in enumerate(bad.items()):
        told = [line for line in running.results if f"{number}1_{name}." in line]
        assert told, name
        assert all(line.split()[1] == "NOT_INSPECTED" and words in line for line in told)
    log = [line for line in running.log if " fails: " in line]
    assert len([line for line in log if "camera fails" in line]) == 4  # three files, and the recording's end
    assert len([line for line in log if "frame fails" in line]) == 3
