"""libaravis-0.8 through ctypes: the functions that a grey camera needs, with their types, and its errors as ours.

ctypes instead of PyGObject: the plain library package suffices, and any Python finds it.
"""

from __future__ import annotations

import ctypes
import functools
from ctypes import POINTER, byref, c_char_p, c_double, c_int, c_size_t, c_uint, c_uint32, c_uint64, c_void_p
from typing import Any

from firmware_bridge.errors import BridgeError, DeviceGone, Refused

LIBRARY = "libaravis-0.8.so.0"
PACKAGE = "libaravis-0.8-0"
"""Where Debian and Ubuntu keep it."""


class _GError(ctypes.Structure):
    """GLib's error: whose it is, which, and in words."""

    _fields_ = (("domain", c_uint32), ("code", c_int), ("message", c_char_p))


_DOUBLES, _INTS = POINTER(c_double), POINTER(c_int)
_Signature = tuple[Any, tuple[Any, ...]]

_FALLIBLE: dict[str, _Signature] = {
    "arv_camera_new": (c_void_p, (c_char_p,)),
    "arv_camera_create_stream_full": (c_void_p, (c_void_p, c_void_p, c_void_p, c_void_p)),
    "arv_camera_dup_available_trigger_sources": (c_void_p, (c_void_p, POINTER(c_uint))),
    "arv_camera_clear_triggers": (None, (c_void_p,)),
    "arv_camera_execute_command": (None, (c_void_p, c_char_p)),
    "arv_camera_get_device_id": (c_char_p, (c_void_p,)),
    "arv_camera_get_exposure_time": (c_double, (c_void_p,)),
    "arv_camera_get_exposure_time_bounds": (None, (c_void_p, _DOUBLES, _DOUBLES)),
    "arv_camera_get_float_increment": (c_double, (c_void_p, c_char_p)),
    "arv_camera_get_gain": (c_double, (c_void_p,)),
    "arv_camera_get_gain_bounds": (None, (c_void_p, _DOUBLES, _DOUBLES)),
    "arv_camera_get_height_bounds": (None, (c_void_p, _INTS, _INTS)),
    "arv_camera_get_payload": (c_uint, (c_void_p,)),
    "arv_camera_get_pixel_format_as_string": (c_char_p, (c_void_p,)),
    "arv_camera_get_region": (None, (c_void_p, _INTS, _INTS, _INTS, _INTS)),
    "arv_camera_get_trigger_source": (c_char_p, (c_void_p,)),
    "arv_camera_get_width_bounds": (None, (c_void_p, _INTS, _INTS)),
    "arv_camera_gv_set_packet_size": (None, (c_void_p, c_int)),
    "arv_camera_is_exposure_auto_available": (c_int, (c_void_p,)),
    "arv_camera_is_feature_available": (c_int, (c_void_p, c_char_p)),
    "arv_camera_is_gain_auto_available": (c_int, (c_void_p,)),
    "arv_camera_is_gain_available": (c_int, (c_void_p,)),
    "arv_camera_set_acquisition_mode": (None, (c_void_p, c_int)),
    "arv_camera_set_exposure_time": (None, (c_void_p, c_double)),
    "arv_camera_set_exposure_time_auto": (None, (c_void_p, c_int)),
    "arv_camera_set_gain": (None, (c_void_p, c_double)),
    "arv_camera_set_gain_auto": (None, (c_void_p, c_int)),
    "arv_camera_set_pixel_format_from_string": (None, (c_void_p, c_char_p)),
    "arv_camera_set_region": (None, (c_void_p, c_int, c_int, c_int, c_int)),
    "arv_camera_set_trigger": (None, (c_void_p, c_char_p)),
    "arv_camera_software_trigger": (None, (c_void_p,)),
    "arv_camera_start_acquisition": (None, (c_void_p,)),
    "arv_camera_stop_acquisition": (None, (c_void_p,)),
}
"""Result and arguments, without the error that comes last."""

_INFALLIBLE: dict[str, _Signature] = {
    "arv_buffer_get_frame_id": (c_uint64, (c_void_p,)),
    "arv_buffer_get_image_data": (c_void_p, (c_void_p, POINTER(c_size_t))),
    "arv_buffer_get_image_height": (c_int, (c_void_p,)),
    "arv_buffer_get_image_pixel_format": (c_uint32, (c_void_p,)),
    "arv_buffer_get_image_width": (c_int, (c_void_p,)),
    "arv_buffer_get_status": (c_int, (c_void_p,)),
    "arv_buffer_get_system_timestamp": (c_uint64, (c_void_p,)),
    "arv_buffer_get_timestamp": (c_uint64, (c_void_p,)),
    "arv_buffer_new_allocate": (c_void_p, (c_size_t,)),
    "arv_camera_get_device": (c_void_p, (c_void_p,)),
    "arv_camera_gv_set_packet_size_adjustment": (None, (c_void_p, c_int)),
    "arv_camera_is_gv_device": (c_int, (c_void_p,)),
    "arv_device_error_quark": (c_uint32, ()),
    "arv_get_device_id": (c_char_p, (c_uint,)),
    "arv_get_device_serial_nbr": (c_char_p, (c_uint,)),
    "arv_get_n_devices": (c_uint, ()),
    "arv_gv_device_is_controller": (c_int, (c_void_p,)),
    "arv_stream_push_buffer": (None, (c_void_p, c_void_p)),
    "arv_stream_timeout_pop_buffer": (c_void_p, (c_void_p, c_uint64)),
    "arv_stream_try_pop_buffer": (c_void_p, (c_void_p,)),
    "arv_update_device_list": (None, ()),
    "g_error_free": (None, (c_void_p,)),
    "g_free": (None, (c_void_p,)),
    "g_object_unref": (None, (c_void_p,)),
}

_GONE = frozenset({2, 4, 5, 6, 10})
"""ArvDeviceError: not connected, transfer error, time-out, not found, not the controller."""


@functools.cache
def _functions() -> dict[str, Any]:
    """Every function with its types. Raises OSError or AttributeError where the library is missing or too old."""
    library = ctypes.CDLL(LIBRARY)
    functions: dict[str, Any] = {}
    for name, (result, arguments) in (_FALLIBLE | _INFALLIBLE).items():
        function = library[name]
        function.restype = result
        function.argtypes = [*arguments, POINTER(POINTER(_GError))] if name in _FALLIBLE else arguments
        functions[name] = function
    return functions


class Library:
    """Calls into the library. All block, with the interpreter's lock released; ``device`` is what errors call it."""

    def __init__(self, device: str) -> None:
        """Raises DeviceGone where the library is missing."""
        self._device = device
        try:
            self._functions = _functions()
        except (OSError, AttributeError) as error:
            raise DeviceGone(device, f"{LIBRARY} cannot be used ({error})", f"apt install {PACKAGE}") from error

    def call(self, name: str, *arguments: Any) -> Any:
        """What the function returns. Raises DeviceGone or Refused if it says so."""
        function = self._functions[name]
        if name not in _FALLIBLE:
            return function(*arguments)
        failure = POINTER(_GError)()
        result = function(*arguments, byref(failure))
        if failure:
            raise self._error(failure)
        return result

    def _error(self, failure: Any) -> BridgeError:
        """The library's error in the bridge's words, and its memory given back."""
        error = failure.contents
        gone = error.domain == self.call("arv_device_error_quark") and error.code in _GONE
        message = (error.message or b"").decode(errors="replace")
        self.call("g_error_free", failure)
        if gone:
            return DeviceGone(self._device, message, "check its power and cable, and that nobody else controls it")
        return Refused(self._device, message, "see what the camera has with `arv-tool-0.8 features`")

    def text(self, name: str, *arguments: Any) -> str:
        """A text that the library keeps."""
        found: bytes | None = self.call(name, *arguments)
        return (found or b"").decode(errors="replace")
