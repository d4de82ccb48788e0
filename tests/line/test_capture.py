"""Capture with read-back, and devices kept with back-off, over fakes that keep to the contracts."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_bridge import errors
from firmware_bridge.contracts import CameraCapabilities, CameraFrame
from firmware_bridge.errors import BridgeError, DeviceGone, EndOfRecording, NoReply, ReadBackWrong
from inspector.acquire.capture import Wanted, capture
from inspector.acquire.device_faults import FAULTS, fault_of
from inspector.acquire.keeper import Keeper, Retry
from inspector.faults import Fault

WANTED = Wanted(exposure_us=1000.0, lamp_v=4.0, lamp_tolerance_v=0.05, exposure_tolerance=0.01)
RETRY = Retry(first_s=1.0, longest_s=4.0)
NAN = math.nan


@dataclass
class FakeLamp:
    """Reads back ``reads`` in turn, the last one for ever; an error in its place is raised."""

    reads: list[Any] = field(default_factory=lambda: [4.0])
    simulated: bool = False
    opened: int = 0
    closed: int = 0
    opening: BridgeError | None = None

    def open(self) -> None:
        self.opened += 1
        if self.opening:
            raise self.opening

    def close(self) -> None:
        self.closed += 1

    def set_volts(self, volts: float) -> float:
        return self.read_volts()

    def read_volts(self) -> float:
        value = self.reads.pop(0) if len(self.reads) > 1 else self.reads[0]
        if isinstance(value, BridgeError):
            raise value
        return float(value)


@dataclass
class FakeCamera:
    """Sets ``set_us``, takes the frame at ``taken_us``; an error in either's place is raised."""

    set_us: Any = 1000.0
    taken_us: Any = 1000.0
    simulated: bool = True

    def open(self) -> None: ...

    def close(self) -> None: ...

    def capabilities(self) -> CameraCapabilities:
        return CameraCapabilities(1, 1e6, 1, None, None)

    def set_exposure_us(self, exposure_us: float) -> float:
        if isinstance(self.set_us, BridgeError):
            raise self.set_us
        return float(self.set_us)

    def grab(self) -> CameraFrame:
        if isinstance(self.taken_us, BridgeError):
            raise self.taken_us
        return CameraFrame(np.zeros((2, 3), np.uint8), 7, "fake", self.taken_us, 12.0, 34.0)


class Clock:
    """Seconds that only a test moves."""

    now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def take(lamp: FakeLamp, camera: FakeCamera) -> Any:
    return capture(Keeper("lamp", lamp, RETRY), Keeper("camera", camera, RETRY), WANTED)


@pytest.mark.parametrize("taken_us", [1000.0, 1009.0, None])
def test_a_frame_says_what_it_was_taken_at(taken_us: float | None) -> None:
    frame = take(FakeLamp([4.0, 4.01]), FakeCamera(set_us=1001.0, taken_us=taken_us))
    assert frame.lamp_v == 4.01
    assert frame.exposure_us == (1001.0 if taken_us is None else taken_us)
    assert (frame.frame_id, frame.name, frame.taken_at_s, frame.taken_s, frame.image.shape) == (
        7,
        "fake",
        12.0,
        34.0,
        (2, 3),
    )


@pytest.mark.parametrize(
    ("lamp", "camera", "device"),
    [
        (FakeLamp([3.9]), FakeCamera(), "lamp"),
        (FakeLamp([4.0, 0.0]), FakeCamera(), "lamp"),
        (FakeLamp([NAN]), FakeCamera(), "lamp"),
        (FakeLamp(), FakeCamera(set_us=900.0), "camera"),
        (FakeLamp(), FakeCamera(taken_us=900.0), "camera"),
        (FakeLamp(), FakeCamera(taken_us=NAN), "camera"),
    ],
    ids=["lamp", "lamp died during the exposure", "lamp unknown", "exposure set", "exposure taken", "exposure unknown"],
)
def test_what_is_not_as_set_is_no_frame(lamp: FakeLamp, camera: FakeCamera, device: str) -> None:
    with pytest.raises(ReadBackWrong) as raised:
        take(lamp, camera)
    assert raised.value.device == device


VALUES = st.one_of(
    st.floats(0, 5), st.just(4.0), st.just(NAN), st.sampled_from([NoReply("module", "silent"), DeviceGone("lamp", "x")])
)
EXPOSURES = st.one_of(st.floats(900, 1100), st.just(1000.0), st.just(NAN), st.sampled_from([NoReply("camera", "late")]))


@given(st.lists(VALUES, min_size=2, max_size=2), EXPOSURES, st.one_of(EXPOSURES, st.none()))
def test_whatever_the_devices_say_a_frame_is_one_taken_as_asked(reads: list[Any], set_us: Any, taken_us: Any) -> None:
    said = [*reads, set_us, taken_us]
    try:
        frame = take(FakeLamp(list(reads)), FakeCamera(set_us, taken_us))
    except BridgeError:
        return
    assert not any(isinstance(value, BridgeError) for value in said)
    assert all(abs(read_v - 4.0) <= 0.05 for read_v in reads)
    assert all(abs(exposure_us - 1000.0) <= 10.0 for exposure_us in (set_us, taken_us) if exposure_us is not None)
    assert frame.lamp_v == reads[1]


def kept(device: FakeLamp) -> tuple[Keeper[FakeLamp], Clock]:
    clock = Clock()
    return Keeper("lamp", device, RETRY, clock=clock), clock


def read(lamp: FakeLamp) -> float:
    return lamp.read_volts()


def test_a_failed_device_is_left_alone_twice_as_long_each_time_up_to_the_longest() -> None:
    lamp = FakeLamp(opening=DeviceGone("module", "port is missing"))
    keeper, clock = kept(lamp)
    waits = []
    for tries in range(1, 6):
        with pytest.raises(DeviceGone):
            keeper.use(read)
        assert lamp.opened == tries
        with pytest.raises(DeviceGone):
            keeper.use(read)
        assert lamp.opened == tries
        waits.append(keeper.due_s - clock.now_s)
        clock.now_s = keeper.due_s
    assert waits == [1.0, 2.0, 4.0, 4.0, 4.0]
    lamp.opening = None
    assert keeper.use(read) == 4.0
    lamp.reads = [NoReply("module", "silent")]
    with pytest.raises(NoReply):
        keeper.use(read)
    assert keeper.due_s - clock.now_s == 1.0


def test_an_outage_ends_with_work_done_and_is_logged_twice(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    lamp = FakeLamp([NoReply("module", "silent")])
    keeper, clock = kept(lamp)
    for _ in range(3):
        with pytest.raises(NoReply):
            keeper.use(read)
        clock.now_s = keeper.due_s
    lamp.reads = [4.0]
    keeper.use(read)
    keeper.use(read)
    assert (lamp.opened, lamp.closed) == (4, 3)
    assert [r.getMessage() for r in caplog.records] == [
        "lamp fails: module: silent",
        "lamp works again after 7.0 s",
    ]


def test_a_failure_is_known_before_the_device_is_closed() -> None:
    lamp = FakeLamp([NoReply("module", "silent")])
    keeper, _ = kept(lamp)
    with pytest.raises(NoReply):
        keeper.use(read)
    assert lamp.closed == 0
    keeper.ready()
    keeper.ready()
    assert lamp.closed == 1


def test_how_long_it_has_worked_counts_from_the_last_outage() -> None:
    lamp = FakeLamp()
    keeper, clock = kept(lamp)
    assert (keeper.works, keeper.worked_s) == (False, 0.0)
    keeper.use(read)
    clock.now_s += 5
    assert (keeper.works, keeper.worked_s) == (True, 5.0)
    lamp.reads = [NoReply("module", "silent")]
    with pytest.raises(NoReply):
        keeper.use(read)
    assert (keeper.works, keeper.worked_s) == (False, 0.0)


def test_another_device_in_its_place_is_tried_at_once() -> None:
    old, new = FakeLamp(opening=DeviceGone("module", "gone")), FakeLamp()
    keeper, _ = kept(old)
    with pytest.raises(DeviceGone):
        keeper.use(read)
    keeper.replace(new)
    assert old.closed == 1
    assert keeper.use(read) == 4.0


def test_a_stop_is_not_a_failure_of_the_device() -> None:
    class Stop(BaseException): ...

    def stop(_: FakeLamp) -> None:
        raise Stop

    keeper, _ = kept(FakeLamp())
    with pytest.raises(Stop):
        keeper.use(stop)
    assert keeper.use(read) == 4.0


def below(kind: type[BridgeError]) -> list[type[BridgeError]]:
    return [kind, *(found for child in kind.__subclasses__() for found in below(child))]


@pytest.mark.parametrize("device", FAULTS)
@pytest.mark.parametrize("kind", below(BridgeError)[1:], ids=lambda kind: kind.__name__)
def test_every_error_of_every_device_has_a_code(device: str, kind: type[BridgeError]) -> None:
    fault = fault_of(kind(device, "x"))
    assert fault not in (Fault.NONE, Fault.INTERNAL)
    assert (300 <= fault < 400) == (device == "camera")


def test_the_nearest_class_decides() -> None:
    assert fault_of(errors.WatchdogTripped("module", "x")) is Fault.MODULE_WATCHDOG_TRIPPED
    assert fault_of(errors.Refused("module", "x")) is Fault.MODULE_REFUSED
    assert fault_of(EndOfRecording("camera", "x")) is Fault.CAMERA_TIMEOUT
    assert fault_of(BridgeError("camera", "x")) is Fault.INTERNAL
    assert fault_of(NoReply("toaster", "x")) is Fault.INTERNAL
