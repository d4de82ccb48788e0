"""The picture of a fit: the image, each point's number, where it was seen, and its residual, drawn larger than life."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from inspector.estimate.calibration import Fit
from inspector.model import FloatArray, Image

Picture = npt.NDArray[np.uint8]

ZOOM = 2
"""Small frames would have no room for numbers."""
LABEL_OFFSET_PX = np.array([3.0, -3.0])
"""Names stand beside their points, pixels of the image."""
LONGEST_ARROW_PX = 25.0
"""The largest residual is drawn at most this long, in pixels of the image."""
SEEN, ARROW, NAME, AXES = (0, 200, 0), (0, 80, 255), (255, 60, 200), ((60, 60, 255), (60, 255, 60))
"""Blue, green, red; the world's x axis is red, y green."""


def draw(image: Image, fitted: Fit, names: Sequence[str]) -> Picture:
    """``image`` (H, W) with the fit of n points on it, (2 H, 2 W, 3) uint8, blue-green-red."""
    picture = _base(image)
    larger = _enlargement(fitted.distances_px)
    for xy, residual, name in zip(fitted.points.xy_px, fitted.residuals_px, names, strict=True):
        cv2.circle(picture, _at(xy), 4, SEEN, 1, cv2.LINE_AA)
        cv2.arrowedLine(picture, _at(xy), _at(xy + larger * residual), ARROW, 1, cv2.LINE_AA, tipLength=0.2)
        _write(picture, name, _at(xy + LABEL_OFFSET_PX))
    _axes(picture, fitted)
    worst = float(np.max(fitted.distances_px))
    _write(picture, f"{fitted.method}: residuals x {larger:g}, largest {worst:.3f} px", (10, picture.shape[0] - 12))
    return picture


def _base(image: Image) -> Picture:
    """The image in eight bits and three channels, enlarged."""
    grey = (image >> 8 if image.dtype == np.uint16 and int(image.max()) > 255 else image).astype(np.uint8)
    size = (grey.shape[1] * ZOOM, grey.shape[0] * ZOOM)
    large = cv2.resize(grey, size, interpolation=cv2.INTER_NEAREST)
    return np.asarray(cv2.cvtColor(large, cv2.COLOR_GRAY2BGR), np.uint8)


def _enlargement(distances_px: FloatArray) -> float:
    """The largest of 1, 2, 5, 10, 20, ... that keeps the longest arrow in bounds."""
    longest = max(float(np.max(distances_px)), 1e-4)
    steps = [mantissa * 10.0**power for power in range(6) for mantissa in (1, 2, 5)]
    return max([step for step in steps if step * longest <= LONGEST_ARROW_PX], default=1.0)


def _axes(picture: Picture, fitted: Fit) -> None:
    """The world's x and y axes, from the origin as far as the first points."""
    length = float(np.min(np.max(np.abs(fitted.points.world_mm[:, :2]), axis=0))) / 4
    ends = fitted.camera.project(length * np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]))
    for end, colour, name in zip(ends[1:], AXES, "xy", strict=True):
        if np.isfinite(ends).all():
            cv2.arrowedLine(picture, _at(ends[0]), _at(end), colour, 2, cv2.LINE_AA, tipLength=0.1)
            _write(picture, name, _at(end + LABEL_OFFSET_PX))


def _write(picture: Picture, text: str, at: tuple[int, int]) -> None:
    cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.45, NAME, 1, cv2.LINE_AA)


def _at(xy_px: FloatArray) -> tuple[int, int]:
    """A point of the image, whose pixel centres are on integers, in the picture's pixels."""
    x, y = np.clip(np.rint((xy_px + 0.5) * ZOOM - 0.5), -10_000, 10_000)
    return int(x), int(y)
