"""The map of a panel as SVG: what was seen of it, its zones, and each seed with its height. Pure."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from html import escape

import numpy as np

from inspector.model import Defect, FloatArray, PanelResult, PanelSpot, Verdict
from inspector.optics import Camera
from inspector.recipe import Limits, Rectangle

WIDTH_PX, MARGIN_PX, BANNER_PX = 1000.0, 40.0, 30.0
GREEN, AMBER, RED, GREY, BLUE = "#2e8b57", "#d98e04", "#c62828", "#9e9e9e", "#1565c0"
VERDICT_COLOUR = {Verdict.PASS: GREEN, Verdict.FAIL: RED, Verdict.NOT_INSPECTED: AMBER}
NEAR_PX, TEXT_PX = 4.0, 12.0
"""Radius of a seed's mark, since seeds are far too small to be drawn to scale, and height of the letters."""


class _Sheet:
    """Where millimetres of the panel are on the sheet: x to the right, y upwards, as in the world."""

    def __init__(self, box_mm: tuple[float, float, float, float], size: float, banner: bool) -> None:
        self.near_px, self.text_px, self.banner_px = NEAR_PX * size, TEXT_PX * size, BANNER_PX if banner else 0.0
        self._labels: list[tuple[float, float, float]] = []
        self._left_mm, self._bottom_mm, right_mm, self._top_mm = box_mm
        room_px, high_mm = WIDTH_PX - 2 * MARGIN_PX, self._top_mm - self._bottom_mm
        self.px_per_mm = room_px / max(right_mm - self._left_mm, high_mm, 1e-6)
        self.height_px = (self._top_mm - self._bottom_mm) * self.px_per_mm + 2 * MARGIN_PX + self.banner_px

    def at(self, x_mm: float, y_mm: float) -> tuple[float, float]:
        x = MARGIN_PX + (x_mm - self._left_mm) * self.px_per_mm
        return x, self.banner_px + MARGIN_PX + (self._top_mm - y_mm) * self.px_per_mm

    def label(self, x: float, y: float, text: str) -> str:
        """A text beside a mark, where it hides no other label as far as there is room."""
        width, far = 0.6 * self.text_px * len(text), 1.75 * self.near_px
        places = [(x + far, y), (x - far - width, y), (x - width / 2, y - self.text_px - self.near_px),
                  (x - width / 2, y + self.text_px + self.near_px)]  # fmt: skip
        left, middle = next((place for place in places if self._is_free(*place, width)), places[0])
        self._labels.append((left, middle, width))
        return f'<text x="{left:.1f}" y="{middle + self.text_px / 3:.1f}">{text}</text>'

    def _is_free(self, left: float, middle: float, width: float) -> bool:
        apart = all(
            left > other + its_width or left + width < other or abs(middle - at) > self.text_px
            for other, at, its_width in self._labels
        )
        return apart and left >= 0 and left + width <= WIDTH_PX

    def rectangle(self, area: Rectangle, style: str) -> str:
        x, y = self.at(area.x_min_mm, area.y_max_mm)
        width, height = area.x_max_mm - area.x_min_mm, area.y_max_mm - area.y_min_mm
        size = f'width="{width * self.px_per_mm:.1f}" height="{height * self.px_per_mm:.1f}"'
        return f'<rect x="{x:.1f}" y="{y:.1f}" {size} {style}/>'


def svg(
    panel: PanelResult,
    camera: Camera,
    direction: tuple[float, float],
    limits: Limits | None,
    area: Rectangle | None = None,
    *,
    size: float = 1.0,
    banner: bool = True,
) -> str:
    """The map of the panel's area; where that is not known, of what the inner halves of its frames saw, as an oblique
    view reaches far; and of every seed: a disc within its limit, a triangle above. ``direction``: the travel's unit
    vector; ``limits`` None: not known; ``size``: of marks and letters; ``banner``: with verdict and reasons on top."""
    moved = [np.array([travel * direction[0], travel * direction[1]]) for travel in panel.travels_mm]
    views = [camera.outline_mm() - by for by in moved]
    sheet = _Sheet(_box([camera.outline_mm(share=0.5) - by for by in moved], panel, area), size, banner)
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH_PX:.0f} {sheet.height_px:.0f}" '
        f'font-family="sans-serif" font-size="{sheet.text_px:g}">',
        '<rect width="100%" height="100%" fill="white"/>',
        *_frames(sheet, views),
        *_areas(sheet, area, limits),
        *(_lone(sheet, spot) for spot in panel.unpaired if math.isfinite(spot.x_mm + spot.y_mm)),
        *(_seed(sheet, seed, limits) for seed in panel.defects if math.isfinite(seed.x_mm + seed.y_mm)),
        *(_banner(panel) if banner else ()),
        *_scale(sheet),
        "</svg>",
    ]
    return "\n".join(parts) + "\n"


def _box(
    inner_mm: Sequence[FloatArray], panel: PanelResult, area: Rectangle | None
) -> tuple[float, float, float, float]:
    """What the map shows, mm: left, bottom, right, top."""
    points = [(x, y) for view in inner_mm for x, y in view.tolist()] if area is None else []
    if area is not None:
        points += [(area.x_min_mm, area.y_min_mm), (area.x_max_mm, area.y_max_mm)]
    points += [(seed.x_mm, seed.y_mm) for seed in panel.defects] + [(spot.x_mm, spot.y_mm) for spot in panel.unpaired]
    points = [point for point in points if math.isfinite(sum(point))]
    xs, ys = [x for x, _ in points] or [0.0, 1.0], [y for _, y in points] or [0.0, 1.0]
    return min(xs), min(ys), max(xs), max(ys)


def _frames(sheet: _Sheet, views: Sequence[FloatArray]) -> Iterator[str]:
    for number, view in enumerate(views, 1):
        corners = [sheet.at(x, y) for x, y in view.tolist() if math.isfinite(x + y)]
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in corners)
        yield f'<polygon points="{path}" fill="{GREY}" fill-opacity="0.12" stroke="{GREY}"/>'
        if corners and len(views) > 1:
            x, y = (sum(values) / len(values) for values in zip(*corners, strict=True))
            x, y = min(max(x, 4.0), WIDTH_PX - 60), min(max(y, sheet.banner_px + sheet.text_px), sheet.height_px - 30)
            yield f'<text x="{x:.1f}" y="{y:.1f}" fill="{GREY}">frame {number}</text>'


def _areas(sheet: _Sheet, area: Rectangle | None, limits: Limits | None) -> Iterator[str]:
    if area is not None:
        yield sheet.rectangle(area, f'fill="none" stroke="{BLUE}" stroke-width="2"')
    for zone in limits.zones if limits else ():
        fill = f'fill="{GREY}" fill-opacity="0.3"' if zone.ignore else 'fill="none"'
        yield sheet.rectangle(zone, f'{fill} stroke="{BLUE}" stroke-dasharray="6 4"')
        x, y = sheet.at(zone.x_min_mm, zone.y_max_mm)
        yield f'<text x="{x + 4:.1f}" y="{y + sheet.text_px + 2:.1f}" fill="{BLUE}">{escape(zone.name)}</text>'


def _seed(sheet: _Sheet, seed: Defect, limits: Limits | None) -> str:
    """Colour and form alike say whether the seed is within its limit; one without a height is not."""
    x, y = sheet.at(seed.x_mm, seed.y_mm)
    near, height = sheet.near_px, f"{seed.height_um:.0f}" if math.isfinite(seed.height_um) else "?"
    limit_um = math.inf if limits is None or limits.max_height_um is None else limits.max_height_um
    sigma = "" if seed.height_sigma_um is None else f" ± {seed.height_sigma_um:.0f}"
    told = f"x {seed.x_mm:.1f}, y {seed.y_mm:.1f} mm, {height}{sigma} um {' '.join(seed.flags.names())}"
    mark = f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{near}" fill="{BLUE if limits is None else GREEN}"/>'
    if not seed.height_um <= limit_um:
        corners = f"M{x:.1f} {y - 1.5 * near:.1f}l{1.5 * near} {2.5 * near}h{-3 * near}z"
        mark = f'<path d="{corners}" fill="{RED}"/>'
    return f'<g class="seed"><title>{escape(told.strip())}</title>{mark}{sheet.label(x, y, height)}</g>'


def _lone(sheet: _Sheet, spot: PanelSpot) -> str:
    x, y = sheet.at(spot.x_mm, spot.y_mm)
    told = f"x {spot.x_mm:.1f}, y {spot.y_mm:.1f} mm, no height: {' '.join(spot.flags.names()) or 'unexplained'}"
    near, side = sheet.near_px, 2 * sheet.near_px
    return (
        f'<g class="lone"><title>{escape(told)}</title><rect x="{x - near:.1f}" y="{y - near:.1f}" '
        f'width="{side}" height="{side}" fill="none" stroke="{AMBER}" stroke-width="2"/></g>'
    )


def _banner(panel: PanelResult) -> Iterator[str]:
    said = "   ".join([panel.verdict.name, *(panel.reasons_text or ("no reason to fail",))])
    colour = VERDICT_COLOUR[panel.verdict]
    yield f'<text x="{MARGIN_PX}" y="22" font-size="16" fill="{colour}">{escape(said)}</text>'


def _scale(sheet: _Sheet) -> Iterator[str]:
    length_mm = 10.0 ** math.floor(math.log10(max(WIDTH_PX / 4 / sheet.px_per_mm, 1e-6)))
    left, y = MARGIN_PX, sheet.height_px - 12
    right = left + length_mm * sheet.px_per_mm
    yield f'<path d="M{left} {y:.1f}H{right:.1f}" stroke="black" stroke-width="2"/>'
    yield f'<text x="{right + 6:.1f}" y="{y + 4:.1f}">{length_mm:g} mm; heights in um</text>'
