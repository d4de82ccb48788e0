"""A GigE Vision or USB3 Vision camera, through Aravis."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

from firmware_bridge.contracts import CameraCapabilities, CameraFrame
from firmware_bridge.drivers.genicam_features import FREE_RUNNING, SOFTWARE, Wanted, set_up
from firmware_bridge.drivers.moment import monotonic_s
from firmware_bridge.errors import BridgeError, DeviceGone, NoReply, NoTrigger, OutOfRange, ReplyWrong
from firmware_bridge.links.aravis import AravisCamera, Received
from firmware_bridge.links.worker import Worker
from firmware_bridge.wire import pixel_formats
from firmware_bridge.wire.image import ImageWrong

ResultT = TypeVar("ResultT")

LOOK_S = 0.2
"""While a frame is waited for, the camera is asked whether it still lives so often."""

LEGACY_IDS = 65535
"""GigE Vision counts frames from 1 to 65535 and on from 1; ids of 64 bits do not come round."""

MOST_LOST = 3
"""Connections to cameras that went away may be ending at a time; Aravis takes up to 15 s for each."""


class GenicamCamera:
    """Implements :class:`firmware_bridge.contracts.Camera`.

    ``camera`` is an address, an id as `arv-tool-0.8` lists it, or a serial number; None is the first one found. Every
    call into Aravis runs in a thread of its own: a camera that is gone would hold it longer than the deadlines. Then
    DeviceGone is raised, and the thread gives the lost connection back by itself.

    Frames carry the exposure that was read back; no frame begun under another one is given: under a software trigger
    each begins after it is set, and otherwise the camera is stopped for the change. Ids rise by what the camera
    counted, so a gap is a frame that was taken and not shown.
    """

    simulated = False

    def __init__(
        self,
        camera: str | None,
        wanted: Wanted,
        *,
        deadline_s: float = 5.0,
        command_deadline_s: float = 1.5,
        device: str = "camera",
    ) -> None:
        self._name, self._wanted, self._device = camera, wanted, device
        self._deadline_s, self._command_deadline_s = deadline_s, command_deadline_s
        self._link = AravisCamera(device)
        self._worker: Worker | None = None
        self._lost: list[Worker] = []
        self._capabilities: CameraCapabilities | None = None
        self._exposure_us: float | None = None
        self._out_of_step = False
        self._serial = camera or ""
        self._frame_id = 0
        self._camera_id: int | None = None
        self._camera_time_ns = 0

    def open(self) -> None:
        """Find the camera, take control and set everything. Raises DeviceGone, Refused, OutOfRange, ReadBackWrong."""
        self.close()
        self._lost = [worker for worker in self._lost if worker.lives]
        if len(self._lost) >= MOST_LOST:
            what = f"{MOST_LOST} lost connections are still being given up"
            raise DeviceGone(self._device, what, "this takes up to 15 s; see why the camera comes and goes")
        self._link, self._worker = AravisCamera(self._device), Worker("genicam")
        try:
            opened = self._ask(lambda link: _opened(link, self._name, self._wanted, self._device), self._deadline_s)
        except BridgeError:
            self.close()
            raise
        self._serial, self._capabilities, self._exposure_us = opened
        self._out_of_step, self._camera_id, self._camera_time_ns = False, None, 0

    def close(self) -> None:
        """Let go of the camera. A grab that waits in another thread ends soon. May be called twice."""
        self._let_go(self._command_deadline_s)

    def _let_go(self, wait_s: float) -> None:
        worker, self._worker = self._worker, None
        if worker is not None:
            worker.end(self._link.close, wait_s)
            if worker.lives:
                self._lost.append(worker)

    def _ask(self, work: Callable[[AravisCamera], ResultT], deadline_s: float | None = None) -> ResultT:
        """What ``work`` returns, done by the thread that owns the connection. Raises DeviceGone after the deadline.

        The work is given its connection, and keeps to it: it may outlive this driver's interest in it.
        """
        deadline_s = self._command_deadline_s if deadline_s is None else deadline_s
        worker, link = self._worker, self._link
        if worker is None:
            raise DeviceGone(self._device, "is not open", "open it first")
        try:
            return worker.call(lambda: work(link), deadline_s)
        except TimeoutError:
            self._let_go(0)
            what = f"{self._name or 'the camera'} did not answer in {deadline_s:g} s"
            raise DeviceGone(self._device, what, "check its power, cable and address") from None

    def capabilities(self) -> CameraCapabilities:
        """See the contract; known once it was open."""
        if self._capabilities is None:
            raise DeviceGone(self._device, "is not open", "open it first")
        return self._capabilities

    def set_exposure_us(self, exposure_us: float) -> float:
        """See the contract."""
        able = self.capabilities()
        if not able.exposure_min_us <= exposure_us <= able.exposure_max_us:
            what = f"exposure {exposure_us} us is outside {able.exposure_min_us:g} to {able.exposure_max_us:g} us"
            raise OutOfRange(self._device, what, "ask for an exposure in that range")
        before_us = self._exposure_us
        self._exposure_us = self._ask(lambda link: _write_exposure(link, exposure_us))
        if self._exposure_us != before_us and self._wanted.trigger != SOFTWARE:
            self._out_of_step = True
        return self._exposure_us

    def grab(self) -> CameraFrame:
        """See the contract: a frame that begins after this call, or, at a camera's own line, that came after it."""
        end_s = time.monotonic() + self._deadline_s
        passed_over = self._begin()
        while (received := self._ask(lambda link: link.pop(LOOK_S), LOOK_S + self._command_deadline_s)) is None:
            if time.monotonic() >= end_s:
                if self._wanted.trigger not in (SOFTWARE, FREE_RUNNING):
                    none = NoTrigger(self._device, f"no signal on {self._wanted.trigger} in {self._deadline_s:g} s")
                    none.passed_over = passed_over
                    raise none
                self._out_of_step = True
                remedy = "check the trigger's wiring, and that no firewall keeps its frames out"
                raise NoReply(self._device, f"no frame in {self._deadline_s:g} s", remedy)
            self._ask(AravisCamera.check_alive)
        return self._frame(received)

    def _begin(self) -> int:
        """Leave no old frame to be taken for a new one; one that was given up may still have come. How many waited."""
        if self._out_of_step:
            self._start()
        software = self._wanted.trigger == SOFTWARE
        return self._ask(AravisCamera.drain_and_trigger if software else AravisCamera.drain)

    def _start(self) -> None:
        """Let frames come that begin from now on."""
        self._ask(lambda link: link.start(self._wanted.packet_size_bytes), self._deadline_s)
        self._out_of_step, self._camera_id = False, None

    def _frame(self, received: Received) -> CameraFrame:
        self._count(received)
        name = f"{self._serial}#{self._frame_id}"
        if received.status != "complete":
            remedy = "check cable, switch and packet_size_bytes, and set sysctl net.core.rmem_max above a frame's bytes"
            raise ReplyWrong(self._device, f"frame {name} is damaged: {received.status}", remedy)
        try:
            image = pixel_formats.unpack(received.pixel_code, received.data, received.width_px, received.height_px)
        except ImageWrong as error:
            raise ReplyWrong(self._device, f"frame {name} {error}") from error  # its words end in what to do
        taken_at_s = received.arrived_ns / 1e9
        taken_s, camera_time_ns = monotonic_s(taken_at_s, self._deadline_s), received.camera_time_ns or None
        return CameraFrame(image, self._frame_id, name, self._exposure_us, taken_at_s, taken_s, camera_time_ns)

    def _count(self, received: Received) -> None:
        """Let the id rise as the camera's own did. Raises ReplyWrong for a frame that came before."""
        step = 1
        if self._camera_id is not None:
            step = received.camera_id - self._camera_id
            if step < 0 and self._camera_id <= LEGACY_IDS:
                step += LEGACY_IDS
        if step < 1 or 0 < received.camera_time_ns <= self._camera_time_ns:
            what = f"frame {received.camera_id} of {self._serial} is no newer than frame {self._camera_id}"
            raise ReplyWrong(self._device, what, "reopening starts it anew")
        self._frame_id += step
        self._camera_id, self._camera_time_ns = received.camera_id, received.camera_time_ns


def _opened(link: AravisCamera, name: str | None, wanted: Wanted, device: str) -> tuple[str, CameraCapabilities, float]:
    """Connect, set everything and let frames come; the camera's serial number, what it can do, and its exposure."""
    serial = link.open(name)
    able = set_up(link, wanted, device)
    exposure_us = _read_exposure(link)
    link.start(wanted.packet_size_bytes)
    return serial, able, exposure_us


def _write_exposure(link: AravisCamera, exposure_us: float) -> float:
    link.call("set_exposure_time", exposure_us)
    return _read_exposure(link)


def _read_exposure(link: AravisCamera) -> float:
    return float(link.call("get_exposure_time"))
