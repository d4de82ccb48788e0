"""Whatever array comes as a frame, inspection ends with a result: one with a reason, or one that can be right."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from views import View

from inspector.model import Frame, FrameResult, Reason, Verdict
from inspector.pipeline import Station, inspect
from inspector.recipe import Detection, Recipe

BASE = View().calibration
TWELVE_MP = (3000, 4096)


def station(shape: tuple[int, ...], detection: Detection | None = None) -> Station:
    """One whose camera gives frames of this shape, as far as a camera can."""
    height, width = (max(side, 1) for side in (*shape, 1, 1)[:2])
    camera = replace(BASE.camera, width_px=width, height_px=height, cx_px=width / 2, cy_px=height / 2)
    return Station(replace(BASE, camera=camera), Recipe(detection=detection or Detection()))


def checked(image: Any, detection: Detection | None = None) -> FrameResult:
    """The result of any array, after checking what must hold of every result."""
    result = inspect(Frame(image, "any"), station(image.shape, detection))
    if result.verdict is Verdict.NOT_INSPECTED:
        assert result.reasons
        assert result.reasons_text
        assert not result.defects
    for defect in result.defects:
        numbers = (
            defect.x_mm,
            defect.y_mm,
            defect.height_um,
            defect.height_sigma_um,
            *defect.direct_px,
            *defect.mirror_px,
        )
        assert all(number is not None and math.isfinite(number) for number in numbers)
        assert defect.height_um > 0
    places = [p for d in result.defects for p in (d.direct_px, d.mirror_px)] + [
        (u.x_px, u.y_px) for u in result.unpaired
    ]
    assert len(set(places)) == len(places)
    return result


grey_dtypes = st.sampled_from([np.dtype(name) for name in ("u1", "<u2", ">u2")])
shapes = arrays.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=48)


@given(image=grey_dtypes.flatmap(lambda dtype: arrays.arrays(dtype, shapes)))
def test_any_grey_array(image: Any) -> None:
    checked(image)


@given(
    image=arrays.arrays(np.uint8, (24, 30), elements=st.sampled_from([0, 0, 0, 0, 0, 0, 1, 8, 120, 254, 255])),
    threshold_dn=st.none() | st.floats(0.5, 300),
)
def test_any_sparse_array_with_every_pixel_welcome(image: Any, threshold_dn: float | None) -> None:
    """Limits that would refuse the frame early are off, so that fit and pairing see it."""
    checked(image, Detection(threshold_dn=threshold_dn, max_lit_fraction=1.0, max_highlights=10_000))


@given(
    image=arrays.arrays(arrays.scalar_dtypes() | st.just(np.dtype(object)), arrays.array_shapes(min_dims=1, max_side=5))
)
def test_any_dtype_and_number_of_axes(image: Any) -> None:
    result = checked(image)
    if image.ndim != 2:
        assert result.reasons == Reason.FRAME_WRONG_SHAPE
    elif image.dtype.kind != "u" or image.dtype.itemsize > 2:
        assert result.reasons == Reason.FRAME_UNREADABLE


@pytest.mark.parametrize(
    "image",
    [
        pytest.param(np.empty((0, 0), np.uint8), id="empty"),
        pytest.param(np.empty((0, 5), np.uint8), id="no rows"),
        pytest.param(np.empty((5, 0), np.uint16), id="no columns"),
        pytest.param(np.array(7, np.uint8), id="scalar"),
        pytest.param(np.empty(0, np.uint8), id="empty line"),
        pytest.param(np.full((4, 4), np.nan), id="NaN"),
        pytest.param(np.full((4, 4), None), id="objects"),
        pytest.param(np.ones((4, 4), np.bool_), id="bool"),
        pytest.param(np.zeros((4, 4, 3), np.uint8), id="colour"),
        pytest.param(np.full((4, 4), "x"), id="text"),
        pytest.param(np.zeros((4, 4), [("a", "u1")]), id="records"),
        pytest.param(np.zeros((4, 4), "datetime64[s]"), id="dates"),
    ],
)
def test_what_is_no_frame_is_refused(image: Any) -> None:
    assert checked(image).verdict is Verdict.NOT_INSPECTED


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("shape", [(1, 1), (1, 2), (2, 1), (1, 640), (480, 1), (2, 2), (3, 3), (5, 7)])
@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_tiny_frames(shape: tuple[int, int], dtype: type[np.uint8 | np.uint16], share: float) -> None:
    """Black, grey, and white, and each with one bright pixel."""
    image = np.full(shape, int(share * np.iinfo(dtype).max), dtype)
    checked(image)
    image[-1, -1] = np.iinfo(dtype).max
    checked(image)


def pattern(name: str, shape: tuple[int, int], dtype: Any) -> Any:
    full, (rows, columns) = np.iinfo(dtype).max, np.ogrid[: shape[0], : shape[1]]
    light = {
        "all lit": lambda: np.ones(shape),
        "checkerboard": lambda: (rows + columns) % 2,
        "every third pixel": lambda: (rows % 3 == 0) & (columns % 3 == 0),
        "stripes": lambda: np.broadcast_to(rows % 2, shape),
        "half": lambda: np.broadcast_to(columns < shape[1] // 2, shape),
        "ramp": lambda: np.broadcast_to(columns / shape[1], shape),
        "noise": lambda: np.random.default_rng(0).random(shape),
        "a large blob": lambda: (
            (rows - shape[0] / 2) ** 2 + (columns - shape[1] / 2) ** 2 < 0.003 * shape[0] * shape[1]
        ),
        "a grid of dots": lambda: (rows % 64 == 0) & (columns % 64 == 0),
        "a bright row": lambda: np.broadcast_to(rows == shape[0] // 2, shape),
    }[name]()
    return (light * full).astype(dtype)


PATTERNS = (
    "all lit", "checkerboard", "every third pixel", "stripes", "half", "ramp", "noise", "a large blob",
    "a grid of dots", "a bright row",
)  # fmt: skip


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("name", PATTERNS)
def test_patterns(name: str, dtype: Any) -> None:
    checked(pattern(name, (480, 640), dtype))


@pytest.mark.timeout(30)
@pytest.mark.parametrize("name", PATTERNS)
def test_patterns_at_12_megapixels_end_in_bounded_time(name: str) -> None:
    """Each takes a fraction of a second; the limit only catches what does not end."""
    checked(pattern(name, TWELVE_MP, np.uint8))


@pytest.mark.parametrize("name", ["all lit", "checkerboard", "stripes", "half", "noise"])
def test_a_frame_lit_all_over_is_refused_as_such(name: str) -> None:
    result = checked(pattern(name, (480, 640), np.uint8))
    assert result.verdict is Verdict.NOT_INSPECTED
    assert result.reasons in (Reason.FRAME_OVERLIT, Reason.TOO_MANY_HIGHLIGHTS)


def test_a_black_frame_is_refused_as_such() -> None:
    assert checked(np.zeros((480, 640), np.uint8)).reasons == Reason.FRAME_BLACK
    assert checked(np.ones((480, 640), np.uint16)).reasons == Reason.FRAME_BLACK


def test_a_frame_with_too_many_highlights_is_refused_as_such() -> None:
    image = pattern("a grid of dots", (480, 640), np.uint8)
    result = checked(image, Detection(max_highlights=50))
    assert result.reasons == Reason.TOO_MANY_HIGHLIGHTS
    assert "max_highlights (50)" in result.reasons_text[0]
