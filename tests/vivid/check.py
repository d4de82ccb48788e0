"""What tests/vivid/run does inside the emulated machine: a serial CCD camera whose frames come from the kernel.

Frames are vivid's test picture over /dev/video0, commands go to our simulated head over a pseudo-terminal: driver,
settings and factory are the service's own.
"""

from __future__ import annotations

import itertools
import subprocess
from collections.abc import Callable

import numpy as np
from pydantic import TypeAdapter

from firmware_bridge import errors
from firmware_bridge.camera_settings import CameraSettings
from firmware_bridge.contracts import Camera
from firmware_bridge.factory import build_camera
from firmware_bridge.simulators.ccd_server import CcdServer
from firmware_bridge.simulators.ccd_state import SimulatedCcdHead
from firmware_bridge.wire.ccd_dialects import DIALECTS

DEVICE = "/dev/video0"
WIDTH_PX, HEIGHT_PX = 640, 360
FRAMES, TRIES = 20, 20
V4L2_CTL = ("v4l2-ctl", "--device", DEVICE)


def control(text: str) -> None:
    """Set one of vivid's controls, as v4l2-ctl names them."""
    subprocess.run([*V4L2_CTL, "--set-ctrl", text], check=True)


def raises(kind: type[errors.BridgeError], work: Callable[[], object]) -> errors.BridgeError:
    """The error that ``work`` ends with."""
    try:
        work()
    except kind as error:
        return error
    raise AssertionError(f"no {kind.__name__}")


def frames_come_in_order(camera: Camera) -> None:
    camera.open()
    camera.set_exposure_us(1000.0)
    taken = [camera.grab() for _ in range(FRAMES)]
    ids = [frame.frame_id for frame in taken]
    assert all(later > earlier for earlier, later in itertools.pairwise(ids)), ids
    for frame in taken:
        assert frame.image.shape == (HEIGHT_PX, WIDTH_PX)
        assert np.ptp(frame.image) > 100, "the test picture has black and white bars"
    moved = sum(not np.array_equal(a.image, b.image) for a, b in itertools.pairwise(taken))
    assert moved == FRAMES - 1, "the picture carries a running count: no frame came twice"


def lost_frames_are_counted(camera: Camera) -> None:
    control("percentage_of_dropped_buffers=50")
    ids = [camera.grab().frame_id for _ in range(FRAMES)]
    control("percentage_of_dropped_buffers=0")
    # Two frames that were under way are thrown away for each one taken: without losses, ids rise by three.
    assert ids[-1] - ids[0] > 3 * (FRAMES - 1), ids


def damaged_frames_are_told(camera: Camera) -> None:
    def until_told() -> None:
        for _ in range(TRIES):  # a damaged frame that comes between two grabs is thrown away with the old ones
            with subprocess.Popen([*V4L2_CTL, "--set-ctrl", "inject_v4l2_buf_flag_error=1"]) as setting:
                while setting.poll() is None:
                    camera.grab()

    error = raises(errors.ReplyWrong, until_told)
    assert "damaged" in str(error), error
    camera.open()
    camera.grab()


def a_camera_pulled_is_gone_and_found_again(camera: Camera) -> None:
    control("disconnect=1")
    error = raises(errors.DeviceGone, camera.grab)
    assert "check the camera's cable" in str(error), error
    camera.close()
    camera.close()
    camera.open()  # with its last user gone, vivid plugs itself in again
    camera.grab()


def settings(bits: int, width_px: int = WIDTH_PX) -> dict[str, object]:
    frames = {"kind": "v4l2", "path": DEVICE, "width_px": width_px, "height_px": HEIGHT_PX, "bits": bits}
    return {"kind": "serial_ccd", "dialect": "dalsa", "frames": frames, "deadline_s": 10.0, "command_deadline_s": 5.0}


def main() -> None:
    server = CcdServer(SimulatedCcdHead(DIALECTS["dalsa"])).start()

    def built(bits: int = 8, width_px: int = WIDTH_PX) -> Camera:
        wanted = settings(bits, width_px) | {"port": server.address}
        return build_camera(TypeAdapter(CameraSettings).validate_python(wanted))

    error = raises(errors.ReplyWrong, built(width_px=1234).open)
    print(f"another width: {error}", flush=True)
    for bits in (16, 8):
        camera = built(bits)
        frames_come_in_order(camera)
        print(f"{bits} bits: {FRAMES} frames in order, each a new one", flush=True)
        camera.close()
    camera.open()
    for check in (lost_frames_are_counted, damaged_frames_are_told, a_camera_pulled_is_gone_and_found_again):
        check(camera)
        print(f"{check.__name__}: holds", flush=True)
    server.stop()


if __name__ == "__main__":
    main()
