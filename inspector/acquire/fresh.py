"""A camera whose every frame is a new one: what comes twice is an error, whoever drives it."""

from __future__ import annotations

from firmware_bridge.contracts import Camera, CameraCapabilities, CameraFrame
from firmware_bridge.errors import ReplyWrong


class FreshFrames:
    """The camera, with :meth:`grab` held to rising frame ids.

    A camera that was opened again may count anew. It may as well still hold an old frame, which the same id or a lower
    one does not tell from a new count: then a second frame has to.
    """

    def __init__(self, camera: Camera) -> None:
        self.simulated = camera.simulated
        self._camera = camera
        self._last_id: int | None = None
        self._first = True

    def open(self) -> None:
        """See the contract."""
        self._first = True
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
        """See the contract. Raises ReplyWrong for a frame that has been seen."""
        frame = self._camera.grab()
        if self._first and not self._is_new(frame):
            self._last_id, frame = frame.frame_id, self._camera.grab()
        if not self._is_new(frame):
            what = f"gave frame {frame.frame_id} after frame {self._last_id}: an old one"
            raise ReplyWrong("camera", what, "check the frame source; reopening starts it anew")
        self._last_id, self._first = frame.frame_id, False
        return frame

    def _is_new(self, frame: CameraFrame) -> bool:
        return self._last_id is None or frame.frame_id > self._last_id
