"""The compiled inner loops (`_kernel.c`), through ctypes: they hold no Python object and run without the lock."""

from __future__ import annotations

import ctypes
import importlib.util
from ctypes import Structure, byref, c_double, c_int64, c_void_p
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from inspector.model import FloatArray, Image, IntArray


def _library() -> ctypes.CDLL:
    spec = importlib.util.find_spec("inspector.detect._kernel")
    if spec is None or spec.origin is None:
        raise ImportError("inspector.detect._kernel is not built: install the package (make setup needs a C compiler)")
    library = ctypes.CDLL(spec.origin)
    for name in ("kernel_components", "kernel_lit", "kernel_fit", "bloom_fit"):
        getattr(library, name).restype = c_int64
    library.kernel_peaks.restype = library.kernel_hot.restype = None
    return library


_LIBRARY = _library()


class _Image(Structure):
    _fields_ = (("data", c_void_p), ("bytes", c_int64), ("height", c_int64), ("width", c_int64), ("stride", c_int64))


class Rules(Structure):
    """How grey values become light, what is clipped, and when a fit has settled: `Rules` of `_kernel.c`."""

    _fields_ = (
        *(
            (name, c_double)
            for name in ("black", "gamma", "clipped", "full", "level", "read_dn", "shot_per_dn", "pattern")
        ),
        *((name, c_double) for name in ("reach_px", "tangled_px", "damping", "settled_px")),
        *((name, c_double) for name in ("held_share", "free_share", "steep_share")),
        *((name, c_int64) for name in ("bloom_rows", "bloom_columns", "rounds")),
    )


def packed(image: Image) -> Image:
    """The image with each row's pixels side by side and in native byte order; a copy only where it is needed."""
    if image.strides[1] == image.itemsize and image.dtype.isnative and image.strides[0] >= 0:
        return image
    return image.astype(np.uint8, order="C") if image.itemsize == 1 else image.astype(np.uint16, order="C")


def _image(image: Image) -> _Image:
    """The image as the kernel takes it; ``image`` must be :func:`packed` and outlive the call."""
    height, width = image.shape
    return _Image(image.ctypes.data, image.itemsize, height, width, image.strides[0])


def _pointer(array: npt.NDArray[np.generic]) -> c_void_p:
    return c_void_p(array.ctypes.data)


def lit(image: Image, thresholds_dn: FloatArray, most: int) -> tuple[IntArray, IntArray, FloatArray] | None:
    """Rows, columns and grey values (n,) of pixels above thresholds given at tile centres (rows, columns).

    Between tile centres thresholds are bilinear, beyond them constant. None where more than ``most`` are lit.
    """
    rows, columns, values = np.empty(most, np.int64), np.empty(most, np.int64), np.empty(most)
    tiles = np.ascontiguousarray(thresholds_dn, dtype=np.float64)
    largest = c_double()
    n = _LIBRARY.kernel_lit(
        byref(_image(image)), _pointer(tiles), c_int64(tiles.shape[0]), c_int64(tiles.shape[1]), c_int64(most),
        _pointer(rows), _pointer(columns), _pointer(values), byref(largest),
    )  # fmt: skip
    return None if n < 0 else (rows[:n].copy(), columns[:n].copy(), values[:n].copy())


def components(rows: IntArray, columns: IntArray) -> IntArray:
    """8-connected component numbers (n,) of pixels given in row-major order, in order of first pixel.

    Raises MemoryError.
    """
    rows, columns = np.ascontiguousarray(rows, np.int64), np.ascontiguousarray(columns, np.int64)
    label = np.empty(len(rows), np.int64)
    if _LIBRARY.kernel_components(c_int64(len(rows)), _pointer(rows), _pointer(columns), _pointer(label)) < 0:
        raise MemoryError("no memory for the frame's components")
    return label


def peaks(
    image: Image, rows: IntArray, columns: IntArray, grey_dn: FloatArray, saturated_dn: float
) -> npt.NDArray[np.bool_]:
    """Which of the lit pixels (n,) are below ``saturated_dn`` and outshone by no neighbour; equals go to the first."""
    best = np.empty(len(rows), np.bool_)
    _LIBRARY.kernel_peaks(
        byref(_image(image)), c_int64(len(rows)), _pointer(rows), _pointer(columns), _pointer(grey_dn),
        c_double(saturated_dn), _pointer(best),
    )  # fmt: skip
    return best


def hot(image: Image, centre: IntArray, share: float) -> npt.NDArray[np.bool_]:
    """Which spots at integer centres (n, 2) x, y are one pixel that no lens can have made: hot pixels, never light.

    The four pixels beside it hold together less than ``share`` of its light.
    """
    is_hot = np.empty(len(centre), np.bool_)
    centre = np.ascontiguousarray(centre, np.int64)
    _LIBRARY.kernel_hot(byref(_image(image)), c_int64(len(centre)), _pointer(centre), c_double(share), _pointer(is_hot))
    return is_hot


@dataclass(frozen=True)
class Fit:
    """Parameters (n, 9), centre covariance (n, 2, 2), chi2 (n,) per freedom, and the worst misfit: offset, sigmas."""

    theta: FloatArray
    covariance: FloatArray
    chi2: FloatArray
    misfit: IntArray
    misfit_sigma: FloatArray


def fit(
    image: Image,
    rules: Rules,
    centre: IntArray,
    radius: FloatArray,
    typical: npt.NDArray[np.bool_],
    start: FloatArray,
) -> Fit:
    """Fit n spots around integer centres (n, 2) x, y in windows of radius (n,), from first guesses (n, 9)."""
    n = len(centre)
    centre, theta = np.ascontiguousarray(centre, np.int64), np.ascontiguousarray(start).copy()
    radius, typical = np.ascontiguousarray(radius), np.ascontiguousarray(typical)
    result = Fit(theta, np.empty((n, 2, 2)), np.empty(n), np.empty((n, 2), np.int64), np.empty(n))
    rounds = _LIBRARY.kernel_fit(
        byref(_image(image)), byref(rules), c_int64(n), _pointer(centre), _pointer(radius), _pointer(typical),
        _pointer(theta), _pointer(result.covariance), _pointer(result.chi2), _pointer(result.misfit),
        _pointer(result.misfit_sigma),
    )  # fmt: skip
    if rounds < 0:
        raise MemoryError(f"no memory to fit {n} spots")
    return result


@dataclass(frozen=True)
class BloomFit:
    """Parameters (m,), their covariance (m, m), the sum of squares reached and each pixel's deviation (h, w)."""

    theta: FloatArray
    covariance: FloatArray
    cost: float
    deviation: FloatArray


def bloom_fit(
    light: FloatArray,
    weight: FloatArray,
    *,
    along_rows: bool,
    full_dn: float,
    end_variance: float,
    start: FloatArray,
    prior: FloatArray,
    rounds: int,
) -> BloomFit:
    """Fit spots and the overflow of their charge to a patch (h, w): `bloom_fit` of `_bloom.c`.

    ``start`` (3 k + 5,) and ``prior`` (inverse variances about it): k times x, y, log flux; level, slopes, log blur
    variance, kept. ``along_rows``: charge runs along a column. Raises MemoryError.
    """
    height, width = light.shape
    theta, m = start.copy(), len(start)
    covariance, deviation, cost = np.empty((m, m)), np.empty((height, width)), c_double()
    light, weight, prior = (np.ascontiguousarray(a, np.float64) for a in (light, weight, prior))
    done = _LIBRARY.bloom_fit(
        c_int64(height), c_int64(width), c_int64(along_rows), _pointer(light), _pointer(weight), c_double(full_dn),
        c_double(end_variance), c_int64((m - 5) // 3), _pointer(theta), _pointer(prior), c_int64(rounds),
        _pointer(covariance), byref(cost), _pointer(deviation),
    )  # fmt: skip
    if done < 0:
        raise MemoryError("no memory to fit a bloomed patch")
    return BloomFit(theta, covariance, cost.value, deviation)
