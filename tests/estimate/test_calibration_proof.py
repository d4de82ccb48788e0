"""What is proved of a calibration without arrays is what arrays say."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from inspector import calibration_proof
from inspector.model import FloatArray
from inspector.optics import Camera

NUMBERS = st.floats(-100, 100)
MATRICES = arrays(np.float64, (3, 3), elements=NUMBERS)


@given(MATRICES)
def test_how_far_a_matrix_is_from_a_rotation(r: FloatArray) -> None:
    away = np.max(np.abs(r @ r.T - np.eye(3)))
    assert calibration_proof.off_orthonormal(r.tolist()) == pytest.approx(away, rel=1e-9, abs=1e-9)
    assert calibration_proof.determinant(r.tolist()) == pytest.approx(np.linalg.det(r), rel=1e-6, abs=1e-6)


@given(arrays(np.float64, 4, elements=st.floats(0.1, 1)), arrays(np.float64, 3, elements=NUMBERS))
def test_how_high_the_camera_stands(quaternion: FloatArray, translation_mm: FloatArray) -> None:
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    rotation = np.eye(3) + 2 * w * cross + 2 * cross @ cross
    camera = Camera(640, 480, 8.0, 0.0, 1.0, 320, 240, 0.0075, 0.0075, rotation, translation_mm)
    height_mm = calibration_proof.height_mm(rotation.tolist(), translation_mm.tolist())
    assert height_mm == pytest.approx(camera.centre_mm[2], rel=1e-9, abs=1e-9)


# Squares of less would not be told from nought.
ROOTS = st.floats(-3, 3).map(lambda x: round(x, 6))


@given(st.integers(1, 8).flatmap(lambda n: arrays(np.float64, (n, n), elements=ROOTS)), st.floats(-1, 1))
def test_a_covariance_has_no_negative_eigenvalue(root: FloatArray, added: float) -> None:
    c = root @ root.T + added * np.eye(len(root))
    variances = np.where(np.diag(c) > 0, np.diag(c), 1.0)
    lowest = np.linalg.eigvalsh(c / np.sqrt(np.outer(variances, variances)))[0]
    if abs(lowest + calibration_proof.CORRELATION_ROUNDING) > 1e-9:  # nearer than that rounding decides
        assert calibration_proof.is_covariance(c.tolist()) is bool(lowest > -calibration_proof.CORRELATION_ROUNDING)


def test_a_covariance_is_symmetric() -> None:
    assert calibration_proof.is_covariance([[1.0, 0.5], [0.5, 1.0]])
    assert not calibration_proof.is_covariance([[1.0, 0.5], [0.4, 1.0]])
