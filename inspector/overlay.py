"""A picture of one result: the frame, each seed's two spots with its height, what stayed unpaired, the verdict."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from inspector.model import Defect, FrameResult, Image, Unpaired, Verdict

Picture = npt.NDArray[np.uint8]
Colour = tuple[int, int, int]

GREEN, AMBER, RED, CYAN, WHITE = (96, 224, 96), (0, 176, 255), (64, 64, 255), (255, 224, 96), (255, 255, 255)
"""Blue, green, red, as OpenCV orders them."""
VERDICT_COLOUR: dict[Verdict, Colour] = {Verdict.PASS: GREEN, Verdict.FAIL: RED, Verdict.NOT_INSPECTED: AMBER}
LEAST_WIDTH_PX = 1200
"""Smaller frames are drawn twice as large, so that texts have room."""
BANNER_PX = 26
RING_PX = 9
"""Radius of the rings about spots, in the picture: they must not cover what they point at."""


def draw(image: Image, result: FrameResult) -> Picture:
    """The picture (h, w, 3) uint8 of a frame (H, W) and its result, brightened by the square root."""
    factor = 2 if image.shape[1] < LEAST_WIDTH_PX else 1
    grey = np.sqrt(image / max(int(image.max(initial=0)), 1)) * 255
    large = grey.astype(np.uint8).repeat(factor, axis=0).repeat(factor, axis=1)
    banner = np.zeros((BANNER_PX, large.shape[1]), np.uint8)
    picture = np.dstack([np.vstack([banner, large])] * 3)
    for spot in result.unpaired:
        _draw_unpaired(picture, spot, factor)
    for defect in result.defects:
        _draw_defect(picture, defect, factor)
    _write(picture, _headline(result), (6, BANNER_PX - 8), VERDICT_COLOUR[result.verdict])
    return picture


def _draw_defect(picture: Picture, defect: Defect, factor: int) -> None:
    import cv2

    direct, mirror = _at(defect.direct_px, factor), _at(defect.mirror_px, factor)
    cv2.circle(picture, direct, RING_PX, GREEN, 1, cv2.LINE_AA)
    cv2.circle(picture, mirror, RING_PX, CYAN, 1, cv2.LINE_AA)
    sigma = "" if defect.height_sigma_um is None else f" +/- {defect.height_sigma_um:.0f}"
    beside = max(direct[0], mirror[0]) + RING_PX + 4, (direct[1] + mirror[1]) // 2 + 5
    _write(picture, f"{defect.height_um:.0f}{sigma} um", beside, WHITE)


def _draw_unpaired(picture: Picture, spot: Unpaired, factor: int) -> None:
    import cv2

    x, y = _at((spot.x_px, spot.y_px), factor)
    cv2.drawMarker(picture, (x, y), AMBER, cv2.MARKER_SQUARE, 2 * RING_PX, 1, cv2.LINE_AA)
    _write(picture, " ".join(spot.flags.names()), (x - RING_PX, y + 2 * RING_PX + 6), AMBER)


def _headline(result: FrameResult) -> str:
    return "   ".join([result.verdict.name, *(result.reasons_text or ["no defect"])])


def _write(picture: Picture, text: str, at: tuple[int, int], colour: Colour) -> None:
    import cv2

    plain = text.encode("ascii", "replace").decode()
    cv2.putText(picture, plain, at, cv2.FONT_HERSHEY_SIMPLEX, 0.5, colour, 1, cv2.LINE_AA)


def _at(xy_px: tuple[float, float], factor: int) -> tuple[int, int]:
    """Where a frame's pixel is in the picture: pixel centres lie on integers in both."""
    x, y = ((v + 0.5) * factor - 0.5 for v in xy_px)
    return round(x), round(y) + BANNER_PX
