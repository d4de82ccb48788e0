"""Lit pixels are those above thresholds that bend over the frame, wherever the compiled loop does not look closely."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from inspector.detect import kernel
from inspector.model import FloatArray


def along(length: int, tiles: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Of each pixel the tile before, the one after and how far on it is: straight on beyond the outermost centres."""
    at = (np.arange(length) + 0.5) * tiles / length - 0.5
    low = np.clip(np.floor(at), 0, max(tiles - 2, 0)).astype(np.intp)
    return low, np.minimum(low + 1, tiles - 1), at - low


@given(
    arrays.arrays(np.float64, st.tuples(st.integers(1, 4), st.integers(1, 6)), elements=st.integers(20, 200)),
    st.integers(8, 140),
    st.integers(0, 2**32 - 1),
)
def test_pixels_above_bilinear_thresholds_are_lit(tiles: FloatArray, width: int, seed: int) -> None:
    up, down, share = along(12, tiles.shape[0])
    at_rows = tiles[up] + (tiles[down] - tiles[up]) * share[:, None]
    left, right, share = along(width, tiles.shape[1])
    thresholds = at_rows[:, left] + (at_rows[:, right] - at_rows[:, left]) * share
    just_below = np.floor(thresholds) - np.random.default_rng(seed).integers(0, 4, thresholds.shape)
    spots = np.random.default_rng(seed).random(thresholds.shape) < 0.01
    image = np.clip(just_below + np.where(spots, 5, 0), 0, 255).astype(np.uint8)
    found = kernel.detect(kernel.packed(image), tiles, image.size, 255.0, 0.25)
    assert found is not None
    assert np.array_equal(np.column_stack([found.rows, found.columns]), np.argwhere(image > thresholds))
