"""Compiled C beside its Python, through ctypes: it holds no Python object and runs without the interpreter's lock.

Arrays go in as bytes (``array.tobytes()``: contiguous, whatever the strides, and the cheapest for small ones) and come
out in fresh arrays handed over with :func:`out`.
"""

from __future__ import annotations

import ctypes
import importlib.util
from collections.abc import Callable
from ctypes import byref, c_char, c_double, c_int64, c_void_p
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy.typing as npt

_AnyLength = c_char * 0


def function(module: str, name: str, arguments: str) -> Callable[..., int]:
    """The C function ``name`` of the compiled ``module``, returning int64.

    ``arguments`` has a letter for each: p a pointer (bytes, an address or :func:`out`), i an int64, d a double. Raises
    ImportError where the module is not built.
    """
    spec = importlib.util.find_spec(module)
    if spec is None or spec.origin is None:
        raise ImportError(f"{module} is not built: install the package (make setup; it needs a C compiler)")
    found = getattr(ctypes.CDLL(spec.origin), name)
    found.argtypes = [{"p": c_void_p, "i": c_int64, "d": c_double}[a] for a in arguments]
    found.restype = c_int64
    return found  # type: ignore[no-any-return]  # ctypes knows its functions by name only


def out(array: npt.NDArray[Any]) -> object:
    """Pointer to a fresh C-contiguous array that the C function fills; it keeps the array alive."""
    return byref(_AnyLength.from_buffer(array.data))
