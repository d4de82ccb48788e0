"""A GigE Vision or USB3 Vision camera behind Aravis: the only opener of such cameras.

Nothing here has a deadline of its own: a camera that is gone holds each call for Aravis' retries, 2.5 s, and
:meth:`AravisCamera.close` for several of them. The calls belong into a :class:`firmware_bridge.links.worker.Worker`.
"""

from __future__ import annotations

import contextlib
import ctypes
from ctypes import byref, c_double, c_int, c_size_t, c_uint
from dataclasses import dataclass
from typing import Any

from firmware_bridge.errors import BridgeError, DeviceGone
from firmware_bridge.links.aravis_library import Library

BUFFERS = 4
"""Frames that may wait; what comes beyond is lost, and seen as a gap in the ids."""

_ADJUST_NEVER = 0
"""Of ArvGvPacketSizeAdjustment."""

STATUS = {0: "complete", 1: "cleared", 2: "late", 3: "missing packets", 4: "wrong packet id", 5: "wrong size",
          6: "filling", 7: "aborted"}  # fmt: skip
"""ArvBufferStatus in words."""


@dataclass(frozen=True, slots=True)
class Received:
    """A buffer as it came, its bytes a copy. Times in nanoseconds: the camera's own, and Unix time of arrival."""

    status: str
    camera_id: int
    camera_time_ns: int
    arrived_ns: int
    pixel_code: int
    width_px: int
    height_px: int
    data: bytearray


class AravisCamera:
    """One camera. Everything raises DeviceGone or Refused, but :meth:`close`, which raises nothing."""

    def __init__(self, device: str) -> None:
        self._device = device
        self._library: Library | None = None
        self._camera: int | None = None
        self._stream: int | None = None

    def open(self, name: str | None) -> str:
        """Take control of the camera of that address, id or serial number (None: of the first one); return its serial.

        A serial number is looked for last, and takes 2 s to be found.
        """
        library = self._library = Library(self._device)
        try:
            self._camera = library.call("arv_camera_new", name and name.encode())
        except DeviceGone:
            known = self._id_of_serial(name)
            if known is None:
                raise
            self._camera = library.call("arv_camera_new", known.encode())
        return self.text("get_device_id")

    def _id_of_serial(self, serial: str | None) -> str | None:
        """Aravis looks for ids, addresses and names, not for bare serial numbers."""
        library = self._opened()
        library.call("arv_update_device_list")
        for index in range(library.call("arv_get_n_devices")):
            if library.text("arv_get_device_serial_nbr", index) == serial:
                return library.text("arv_get_device_id", index)
        return None

    def close(self) -> None:
        """Stop, and give control and memory back. May be called at any time, and twice."""
        if self._library is None or self._camera is None:
            return
        with contextlib.suppress(BridgeError):
            self._stop()
        self._library.call("g_object_unref", self._camera)
        self._camera = None

    def _stop(self) -> None:
        stream, self._stream = self._stream, None
        if stream is not None:
            try:
                self.call("stop_acquisition")
            finally:
                self._opened().call("g_object_unref", stream)

    def _opened(self) -> Library:
        if self._library is None:
            raise DeviceGone(self._device, "is not open", "open it first")
        return self._library

    def call(self, name: str, *arguments: Any) -> Any:
        """``arv_camera_NAME`` of this camera."""
        return self._opened().call(f"arv_camera_{name}", self._camera, *arguments)

    def text(self, name: str, *arguments: Any) -> str:
        """``arv_camera_NAME`` of this camera, a text."""
        return self._opened().text(f"arv_camera_{name}", self._camera, *arguments)

    def integers(self, name: str, count: int = 2) -> tuple[int, ...]:
        """What ``arv_camera_NAME`` gives through pointers, such as bounds."""
        values = [c_int() for _ in range(count)]
        self.call(name, *map(byref, values))
        return tuple(value.value for value in values)

    def floats(self, name: str) -> tuple[float, float]:
        """The two bounds that ``arv_camera_NAME`` gives through pointers."""
        low, high = c_double(), c_double()
        self.call(name, byref(low), byref(high))
        return low.value, high.value

    def texts(self, name: str) -> tuple[str, ...]:
        """The list of texts that ``arv_camera_NAME`` gives."""
        count = c_uint()
        address = self.call(name, byref(count))
        if not address:
            return ()
        found = (ctypes.c_char_p * count.value).from_address(address)
        texts = tuple((text or b"").decode(errors="replace") for text in found)
        self._opened().call("g_free", address)
        return texts

    def start(self, packet_size_bytes: int | None) -> None:
        """Let frames come, none from before; None: packets as large as the network lets through, which is tried out.

        When they came already, it is by a new port: what is still on its way to the old one is lost.
        """
        self._stop()
        if packet_size_bytes is not None and self.call("is_gv_device"):
            self.call("gv_set_packet_size_adjustment", _ADJUST_NEVER)
            self.call("gv_set_packet_size", packet_size_bytes)
        library = self._opened()
        self._stream = self.call("create_stream_full", None, None, None)
        payload_bytes = self.call("get_payload")
        for _ in range(BUFFERS):
            library.call("arv_stream_push_buffer", self._stream, library.call("arv_buffer_new_allocate", payload_bytes))
        self.call("start_acquisition")

    def drain(self) -> int:
        """Throw away the frames that wait; how many they were."""
        library, count = self._opened(), 0
        while buffer := library.call("arv_stream_try_pop_buffer", self._stream):
            library.call("arv_stream_push_buffer", self._stream, buffer)
            count += 1
        return count

    def drain_and_trigger(self) -> int:
        """The next frame is the one that this begins; how many were thrown away."""
        count = self.drain()
        self.call("software_trigger")
        return count

    def pop(self, wait_s: float) -> Received | None:
        """The next frame, None if none came in that time."""
        library = self._opened()
        buffer = library.call("arv_stream_timeout_pop_buffer", self._stream, int(wait_s * 1e6))
        if not buffer:
            return None
        received = self._received(library, buffer)
        library.call("arv_stream_push_buffer", self._stream, buffer)
        return received

    def _received(self, library: Library, buffer: int) -> Received:
        status = library.call("arv_buffer_get_status", buffer)
        width_px, height_px, code, data = 0, 0, 0, bytearray()
        if status == 0:  # in others, not even the leader with the image's form may have come
            width_px = library.call("arv_buffer_get_image_width", buffer)
            height_px = library.call("arv_buffer_get_image_height", buffer)
            code = library.call("arv_buffer_get_image_pixel_format", buffer)
            data = _copied(library, buffer)
        return Received(
            STATUS.get(status, "unknown"),
            library.call("arv_buffer_get_frame_id", buffer),
            library.call("arv_buffer_get_timestamp", buffer),
            library.call("arv_buffer_get_system_timestamp", buffer),
            code,
            width_px,
            height_px,
            data,
        )

    def check_alive(self) -> None:
        """Raise DeviceGone if the camera does not answer, or another program controls it."""
        library = self._opened()
        if self.call("is_gv_device"):
            device = self.call("get_device")
            if not library.call("arv_gv_device_is_controller", device):
                what = "control of it was lost"
                raise DeviceGone(self._device, what, "it was restarted, or another program took it: end that")
        self.call("get_exposure_time")


def _copied(library: Library, buffer: int) -> bytearray:
    size = c_size_t()
    address = library.call("arv_buffer_get_image_data", buffer, byref(size))
    data = bytearray(size.value)
    if data:
        ctypes.memmove((ctypes.c_char * len(data)).from_buffer(data), address, len(data))
    return data
