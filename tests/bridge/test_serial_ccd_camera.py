"""A CCD head on a real serial line (a pseudo-terminal), its frames in a pipe or a file; every fault at the wire."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import TypeAdapter

from firmware_bridge import errors
from firmware_bridge.camera_settings import CameraSettings
from firmware_bridge.factory import build_camera
from firmware_bridge.simulators.ccd_frames import FrameFault
from firmware_bridge.simulators.ccd_server import CcdServer, LineFault
from firmware_bridge.simulators.ccd_state import SimulatedCcdHead
from firmware_bridge.wire.ccd_dialects import DIALECTS
from firmware_bridge.wire.raw_frames import RawFormat, RawFrame

WIDTH_PX, HEIGHT_PX = 48, 36
COMMAND_S, FRAME_S = 0.25, 0.4
SLACK_S = 2.0
"""A loaded machine wakes late; a call that takes so much longer than its deadline has none."""

SET_5000 = {"dalsa": [b"set 5000", b"get set"], "jai": [b"PE=5000", b"PE?"]}
FREE_RUNNING = {"dalsa": [b"sem 2"], "jai": [b"SM=1", b"TR=0"]}
TRIGGERED = {"dalsa": [b"sem 6"], "jai": [b"SM=1", b"TR=1"]}


class RecordingHead(SimulatedCcdHead):
    """A head that keeps the lines of command it was sent."""

    def __init__(self, dialect: str, **range_us: float) -> None:
        super().__init__(DIALECTS[dialect], **range_us)
        self.heard: list[bytes] = []

    def answer(self, line: bytes) -> Any:
        self.heard.append(line)
        return super().answer(line)


class Rig:
    """A served head and a driver that leads to it."""

    def __init__(self, folder: Path, dialect: str, *, bits: int, header: bool, as_file: bool) -> None:
        self.folder, self.dialect = folder, dialect
        self.form = RawFormat(WIDTH_PX, HEIGHT_PX, bits, header)
        self.frames, self.port = folder / "frames", folder / "port"
        if as_file:
            self.frames.write_bytes(self.form.encode(RawFrame(np.zeros((HEIGHT_PX, WIDTH_PX), np.uint8), 0)))
        self.head = RecordingHead(dialect)
        self.server = self.plug()

    def plug(self, rate_hz: float = 200.0) -> CcdServer:
        self.server = CcdServer(
            self.head, symlink=self.port, frames=self.frames, form=self.form, rate_hz=rate_hz
        ).start()
        return self.server

    def camera(self, **more: Any) -> Any:
        frames = {"kind": "raw", "path": str(self.frames), "width_px": WIDTH_PX, "height_px": HEIGHT_PX}
        frames |= {"bits": self.form.bits, "header": self.form.header}
        settings = {"kind": "serial_ccd", "dialect": self.dialect, "port": str(self.port), "frames": frames}
        deadlines = {"command_deadline_s": COMMAND_S, "deadline_s": FRAME_S}
        return build_camera(TypeAdapter(CameraSettings).validate_python(settings | deadlines | more))


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Callable[..., Rig]]:
    """``rig(dialect, bits=8, header=True, as_file=False)``: a head, plugged in."""
    with contextlib.ExitStack() as stack:

        def make(dialect: str = "dalsa", *, bits: int = 8, header: bool = True, as_file: bool = False) -> Rig:
            made = Rig(tmp_path, dialect, bits=bits, header=header, as_file=as_file)
            stack.callback(lambda: made.server.stop())
            return made

        yield make


@pytest.fixture
def opened(rig: Any) -> Iterator[Callable[..., tuple[Rig, Any]]]:
    """``opened(dialect, ...)``: a rig and its camera, open, with time to spare."""
    with contextlib.ExitStack() as stack:

        def make(dialect: str = "dalsa", deadlines: bool = False, **more: Any) -> tuple[Rig, Any]:
            made = rig(dialect, **more)
            camera = made.camera() if deadlines else made.camera(command_deadline_s=5.0, deadline_s=10.0)
            stack.callback(camera.close)
            camera.open()
            return made, camera

        yield make


@contextlib.contextmanager
def within(deadline_s: float) -> Iterator[None]:
    begun_s = time.monotonic()
    yield
    assert time.monotonic() - begun_s < deadline_s + SLACK_S


BOTH = pytest.mark.parametrize("dialect", DIALECTS)


@BOTH
@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("header", [True, False], ids=["headed", "bare"])
@pytest.mark.parametrize("as_file", [True, False], ids=["file", "pipe"])
def test_frames_are_as_the_exposure_that_was_set(
    dialect: str, bits: int, header: bool, as_file: bool, opened: Any
) -> None:
    _, camera = opened(dialect, bits=bits, header=header, as_file=as_file)
    means, ids = [], []
    for exposure_us in (2000.0, 8000.0):
        assert camera.set_exposure_us(exposure_us) == exposure_us
        frame = camera.grab()
        assert frame.image.shape == (HEIGHT_PX, WIDTH_PX)
        assert frame.image.dtype == (np.uint16 if bits == 16 else np.uint8)
        assert frame.exposure_us == (exposure_us if header else None)
        assert abs(frame.taken_at_s - time.time()) < 60
        means.append(frame.image.mean())
        ids.append(frame.frame_id)
    assert means[1] == pytest.approx(4 * means[0], rel=0.1)
    assert 0 < ids[0] < ids[1]


@BOTH
def test_the_bytes_on_the_wire_are_the_manuals(dialect: str, opened: Any) -> None:
    made, camera = opened(dialect)
    assert made.head.heard == FREE_RUNNING[dialect]
    made.head.heard.clear()
    assert camera.set_exposure_us(5000.0) == 5000.0
    assert made.head.heard == SET_5000[dialect]


@BOTH
def test_a_signal_on_its_input_takes_one_frame(dialect: str, rig: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    made = rig(dialect)
    made.server.stop()
    made.plug(rate_hz=0.0)
    camera = made.camera(trigger="Line0", deadline_s=10.0)
    camera.open()
    assert made.head.heard == TRIGGERED[dialect]
    assert made.head.trigger == "Line0"
    discard = camera._source.discard

    def discard_then_signal() -> None:
        discard()
        made.server.writer.trigger()

    monkeypatch.setattr(camera._source, "discard", discard_then_signal)
    assert [camera.grab().frame_id for _ in range(3)] == [1, 2, 3]
    camera.close()


@BOTH
def test_a_line_that_stands_still_is_told_from_a_head_that_is_dead(dialect: str, rig: Any) -> None:
    made = rig(dialect)
    made.server.stop()
    made.plug(rate_hz=0.0)
    camera = made.camera(trigger="Line0", deadline_s=0.2)
    camera.open()
    with pytest.raises(errors.NoTrigger, match="no signal on Line0"):
        camera.grab()
    made.server.fault = LineFault.SILENT
    with pytest.raises(errors.NoReply) as raised:
        camera.grab()
    assert not isinstance(raised.value, errors.NoTrigger)
    camera.close()


def test_capabilities_are_the_settings_and_the_last_frames(opened: Any) -> None:
    made, camera = opened("jai")
    can = camera.capabilities()
    assert (can.exposure_min_us, can.exposure_max_us, can.exposure_step_us) == (1.0, 1e6, 1.0)
    assert (can.width_px, can.height_px, can.triggers) == (None, None, ("Off", "Line0"))
    camera.grab()
    assert (camera.capabilities().width_px, camera.capabilities().height_px) == (WIDTH_PX, HEIGHT_PX)
    assert made.camera(exposure_min_us=40.0).capabilities().exposure_min_us == 40.0


@BOTH
@pytest.mark.parametrize("exposure_us", [0.5, 1_000_001.0, -1.0, float("nan"), float("inf")])
def test_exposures_outside_its_range_are_not_sent(dialect: str, exposure_us: float, opened: Any) -> None:
    made, camera = opened(dialect)
    made.head.heard.clear()
    with pytest.raises(errors.OutOfRange, match="outside 1 to 1e"):
        camera.set_exposure_us(exposure_us)
    assert made.head.heard == []


def test_an_exposure_that_the_head_clips_is_not_taken_for_the_one_asked_for(rig: Any) -> None:
    made = rig("dalsa")
    made.head.range_us = (40.0, 5000.0)
    camera = made.camera(command_deadline_s=5.0)
    camera.open()
    with pytest.raises(errors.ReadBackWrong, match=r"reads back 5000 us, not 9000 us \(Clipped to max\)"):
        camera.set_exposure_us(9000.0)
    # Even within what it may round, a clipped exposure is another.
    with pytest.raises(errors.ReadBackWrong, match=r"reads back 40 us, not 20 us \(Clipped to min\)"):
        camera.set_exposure_us(20.0)
    assert camera.set_exposure_us(4000.0) == 4000.0
    camera.close()


def test_an_exposure_that_the_head_refuses_is_refused(rig: Any) -> None:
    made = rig("jai")
    made.head.range_us = (2.0, 511.0)
    camera = made.camera(command_deadline_s=5.0)
    camera.open()
    with pytest.raises(errors.Refused, match=r"'PE=512'.*error 2, Bad Parameters!!.*check dialect"):
        camera.set_exposure_us(512.0)
    camera.close()


def test_a_head_that_counts_lines_is_set_in_lines(rig: Any) -> None:
    made = rig("jai")
    camera = made.camera(us_per_count=62.5, command_deadline_s=5.0)
    camera.open()
    made.head.heard.clear()
    assert camera.set_exposure_us(5000.0) == 5000.0
    assert made.head.heard == [b"PE=80", b"PE?"]
    assert camera.set_exposure_us(5010.0) == 5000.0, "rounded to a whole line"
    camera.close()


@BOTH
@pytest.mark.parametrize("cause", ["deaf", "read_back"])
def test_a_wrong_read_back_is_noticed(dialect: str, cause: str, opened: Any) -> None:
    made, camera = opened(dialect)
    if cause == "deaf":
        made.head.deaf = True
    else:
        made.head.read_back_us = 10_000.0
    with pytest.raises(errors.ReadBackWrong, match="reads back 10000 us, not 5000 us"):
        camera.set_exposure_us(5000.0)


LINE_FAULTS = [
    (LineFault.SILENT, errors.NoReply, "no answer to 'set 5000' in 0.25 s; check the head's power"),
    (LineFault.LATE, errors.NoReply, "no answer to 'set 5000'"),
    (LineFault.GARBAGE, errors.ReplyWrong, "bytes and no answer to 'set 5000'"),
    (LineFault.TRUNCATED, errors.ReplyWrong, "bytes and no answer"),
]


@pytest.mark.parametrize(("fault", "error", "says"), LINE_FAULTS, ids=[row[0] for row in LINE_FAULTS])
def test_each_fault_of_the_line_is_told_in_time_and_passes(
    fault: LineFault, error: type[errors.BridgeError], says: str, opened: Any, wait_until: Any
) -> None:
    made, camera = opened("dalsa", deadlines=True)
    made.server.late_s, made.server.fault = 2 * COMMAND_S, fault
    with within(COMMAND_S), pytest.raises(error, match=says):
        camera.set_exposure_us(5000.0)
    made.server.fault = LineFault.NONE

    def recovered() -> bool:
        with contextlib.suppress(errors.BridgeError):
            camera.open()
            return camera.set_exposure_us(4000.0) == 4000.0
        return False

    wait_until(recovered, "the head answered again")


@BOTH
def test_noise_around_answers_does_no_harm(dialect: str, opened: Any) -> None:
    made, camera = opened(dialect)
    made.server.fault = LineFault.NOISY
    for exposure_us in (3000.0, 4000.0, 5000.0):
        assert camera.set_exposure_us(exposure_us) == exposure_us


@BOTH
def test_another_dialect_is_found_when_opening(dialect: str, rig: Any) -> None:
    made = rig(dialect)
    made.dialect = "jai" if dialect == "dalsa" else "dalsa"
    camera = made.camera()
    with within(COMMAND_S), pytest.raises((errors.NoReply, errors.ReplyWrong, errors.Refused), match="check"):
        camera.open()
    camera.close()


FRAME_FAULTS = [
    (FrameFault.SILENT, False, errors.NoReply, "no frame from .* in 0.4 s"),
    (FrameFault.SILENT, True, errors.NoReply, "holds an old frame, and no new one came"),
    (FrameFault.SHORT, False, errors.ReplyWrong, "gave 880 of a frame's 1760 bytes"),
    (FrameFault.SHORT, True, errors.ReplyWrong, "holds 880 bytes that are no frame of 1760"),
    (FrameFault.OLD, False, errors.ReplyWrong, "gave frame .* again"),
    (FrameFault.OLD, True, errors.NoReply, "holds an old frame, and no new one came"),
]


@pytest.mark.parametrize(
    ("fault", "as_file", "error", "says"), FRAME_FAULTS, ids=lambda v: v if isinstance(v, str) else ""
)
def test_each_fault_of_the_frames_is_told_in_time_and_passes(
    fault: FrameFault, as_file: bool, error: type[errors.BridgeError], says: str, opened: Any, wait_until: Any
) -> None:
    made, camera = opened(deadlines=True, as_file=as_file)
    made.server.writer.fault = fault
    seen: list[errors.BridgeError] = []

    def told() -> bool:
        with within(FRAME_S):
            try:
                camera.grab()
            except errors.BridgeError as raised:
                seen.append(raised)
                with contextlib.suppress(errors.BridgeError):
                    camera.open()
        return any(isinstance(each, error) for each in seen)

    wait_until(told, f"{error.__name__}, after {seen}")
    with pytest.raises(error, match=says):
        raise next(each for each in seen if isinstance(each, error))
    made.server.writer.fault = FrameFault.NONE
    _recover(camera, wait_until)


def _recover(camera: Any, wait_until: Any) -> Any:
    def frame() -> Any:
        with contextlib.suppress(errors.BridgeError):
            camera.open()
            return camera.grab()
        return None

    return wait_until(frame, "a frame came again")


@BOTH
@pytest.mark.parametrize("as_file", [True, False], ids=["file", "pipe"])
def test_a_head_pulled_and_plugged_in_again_is_found_under_its_name(
    dialect: str, as_file: bool, opened: Any, wait_until: Any
) -> None:
    made, camera = opened(dialect, as_file=as_file)
    before = camera.grab().frame_id
    for _ in range(3):
        made.server.stop()
        with pytest.raises(errors.DeviceGone, match=r"port: .*check its cable and power"):
            camera.set_exposure_us(5000.0)
        camera.close()
        with pytest.raises(errors.DeviceGone, match=r"cannot open .*port: .*by-id"):
            camera.open()
        made.plug()
        frame = _recover(camera, wait_until)
        assert frame.frame_id > before, "ids rise over a new beginning"
        before = frame.frame_id


def test_frames_that_stop_with_their_writer_are_told(opened: Any) -> None:
    made, camera = opened(deadlines=True)
    camera.grab()
    made.server.stop()
    with within(FRAME_S), pytest.raises((errors.DeviceGone, errors.ReplyWrong), match="check"):
        camera.grab()


def test_frames_that_are_not_there_are_told(rig: Any, tmp_path: Path) -> None:
    made = rig()
    made.frames = tmp_path / "missing"
    with pytest.raises(errors.DeviceGone, match=r"cannot open .*missing: No such file.*check the frame grabber"):
        made.camera().open()


def test_frames_of_another_shape_are_refused(rig: Any) -> None:
    made = rig()
    frames = {"kind": "raw", "path": str(made.frames), "width_px": WIDTH_PX + 1, "height_px": HEIGHT_PX, "header": True}
    camera = made.camera(frames=frames)
    camera.open()
    with (
        within(FRAME_S),
        pytest.raises(errors.ReplyWrong, match=r"no frame's header that fits; check the frame's width"),
    ):
        camera.grab()
    camera.close()


def test_frames_lost_on_the_way_are_counted(opened: Any, wait_until: Any) -> None:
    made, camera = opened(as_file=True)
    first = camera.grab().frame_id
    begun = made.server.writer._number
    wait_until(lambda: made.server.writer._number > begun + 20, "frames passed that nobody took")
    assert camera.grab().frame_id > first + 20


@BOTH
def test_it_closes_twice_and_opens_again_and_leaves_nothing_behind(dialect: str, opened: Any, descriptors: Any) -> None:
    made, camera = opened(dialect)
    camera.grab()
    camera.close()
    camera.close()
    with pytest.raises(errors.DeviceGone, match="not open"):
        camera.set_exposure_us(5000.0)
    with pytest.raises(errors.DeviceGone, match="not open"):
        camera.grab()
    made.server.writer.fault = FrameFault.SILENT
    before, threads = descriptors(), threading.active_count()
    for _ in range(12):
        camera.open()
        camera.open()
        camera.set_exposure_us(5000.0)
        camera.close()
    # The simulator in this process opens and closes its own end of the pipe.
    assert abs(descriptors() - before) <= 1
    assert threading.active_count() == threads


def test_its_port_is_its_own(opened: Any) -> None:
    made, _ = opened()
    with pytest.raises(errors.DeviceGone, match="another program has it open"):
        made.camera().open()


def test_a_fault_while_opening_leaves_nothing_open(rig: Any, descriptors: Any) -> None:
    made = rig()
    made.server.fault = LineFault.SILENT
    before = descriptors()
    for _ in range(3):
        with pytest.raises(errors.NoReply):
            made.camera().open()
    assert abs(descriptors() - before) <= 1


def test_a_stream_without_pauses_needs_headers(tmp_path: Path, rig: Any) -> None:
    made = rig(header=False)
    made.server.stop()
    made.head = RecordingHead("dalsa")
    made.server = CcdServer(made.head, symlink=made.port).start()
    frames = {"kind": "raw", "path": "/dev/zero", "width_px": WIDTH_PX, "height_px": HEIGHT_PX}
    camera = made.camera(frames=frames)
    with within(1.0), pytest.raises(errors.ReplyWrong, match=r"never pauses between frames.*headers"):
        camera.open()
