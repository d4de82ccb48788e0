"""A camera without hardware whose frames go wrong on request: what then happens can be tried before it happens."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from firmware_bridge.camera_settings import CameraFault, FaultSettings
from firmware_bridge.contracts import Camera, CameraCapabilities, CameraFrame
from firmware_bridge.errors import BridgeError, DeviceGone, NoReply, ReplyWrong

Image = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]
IDS_BACK = 5
ASKED_FOR = "this was asked for by camera.faults"


class FaultyCamera:
    """The camera, with :meth:`grab` as ``faults`` say. Frames count on through closing and opening; each fault has a
    stretch of its own, and the first that is due counts."""

    def __init__(self, camera: Camera, faults: Sequence[FaultSettings], device: str = "camera") -> None:
        self.simulated = camera.simulated
        self._camera, self._faults, self._device = camera, tuple(faults), device
        self._asked = 0
        self._last: CameraFrame | None = None
        self._random = np.random.default_rng(1)

    def open(self) -> None:
        """See the contract."""
        self._camera.open()

    def close(self) -> None:
        """See the contract."""
        self._camera.close()

    def capabilities(self) -> CameraCapabilities:
        """See the contract."""
        return self._camera.capabilities()

    def set_exposure_us(self, exposure_us: float) -> float:
        """See the contract."""
        return self._camera.set_exposure_us(exposure_us)

    def grab(self) -> CameraFrame:
        """See the contract, but for what was asked to go wrong."""
        frame, kind = self._camera.grab(), self._due()
        self._asked += 1
        if kind is None:
            self._last = frame
            return frame
        if kind == "hangs":
            threading.Event().wait()
        if error := self._error(kind):
            raise error
        return self._spoilt(frame, kind, self._last or frame)

    def _due(self) -> CameraFault | None:
        due = (fault for fault in self._faults if 0 <= self._asked - fault.after < fault.count)
        return next((fault.kind for fault in due), None)

    def _error(self, kind: CameraFault) -> BridgeError | None:
        match kind:
            case "gone":
                return DeviceGone(self._device, "unplugged", ASKED_FOR)
            case "silent":
                return NoReply(self._device, "no frame in time", ASKED_FOR)
            case "damaged":
                return ReplyWrong(self._device, "the frame is damaged", ASKED_FOR)
            case _:
                return None

    def _spoilt(self, frame: CameraFrame, kind: CameraFault, before: CameraFrame) -> CameraFrame:
        match kind:
            case "old":
                return before
            case "ids back":
                return replace(frame, frame_id=frame.frame_id - IDS_BACK)
            case "other exposure":
                return replace(frame, exposure_us=2 * (frame.exposure_us or 1.0))
            case _:
                return replace(frame, image=self._image(frame.image, kind))

    def _image(self, image: Image, kind: CameraFault) -> Image:
        spoilt, full = image.copy(), int(np.iinfo(image.dtype).max)
        match kind:
            case "black":
                spoilt[:] = 0
            case "saturated":
                spoilt[:] = full
            case "noise":
                spoilt[:] = self._random.integers(0, full, image.shape, endpoint=True)
            case _:
                return spoilt[: image.shape[0] // 2]
        return spoilt
