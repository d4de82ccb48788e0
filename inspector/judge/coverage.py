"""What the frames of a panel have seen of it: its area, and whether anything between them was missed. Pure.

The frame's outline on the panel is cut into strips along the travel. In each strip a frame sees one stretch, so what
several frames see together follows from how far the panel moved between them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from inspector.model import Extent, FloatArray
from inspector.optics import Camera
from inspector.recipe import Rectangle

STRIPS = 256
"""Strips across the view: their steps put the area off by less than a thousandth."""
GRID = 64
"""The panel's area is looked through at so many points along each axis."""


@dataclass(frozen=True)
class View:
    """What one frame sees of the panel, strip by strip: from ``begins_mm`` to ``ends_mm`` (n,) along the travel.

    ``across_mm`` (n,) are the strips' middles, ``direction`` (2,) the travel's unit vector in the world, ``outline_mm``
    (m, 2) what it was cut from. ``length_mm``: the shortest stretch in the inner half of the frame.
    """

    outline_mm: FloatArray
    direction: FloatArray
    across_mm: FloatArray
    begins_mm: FloatArray
    ends_mm: FloatArray
    length_mm: float

    @staticmethod
    def of(camera: Camera, direction: tuple[float, float]) -> View | None:
        """The view of a camera; None if its frame is not all on the panel."""
        outline_mm = camera.outline_mm()
        if not np.isfinite(outline_mm).all():
            return None
        along, aside = np.asarray(direction), np.array([-direction[1], direction[0]])
        s, t = outline_mm @ along, outline_mm @ aside
        edges = np.linspace(t.min(), t.max(), STRIPS + 1)
        across = (edges[1:] + edges[:-1]) / 2
        s_next, t_next = np.roll(s, -1), np.roll(t, -1)
        with np.errstate(divide="ignore", invalid="ignore"):
            share = (across[:, None] - t) / (t_next - t)
        crossing = np.where((share >= 0) & (share <= 1), s + share * (s_next - s), np.nan)
        begins, ends = np.nanmin(crossing, axis=1), np.nanmax(crossing, axis=1)
        inner = camera.outline_mm(share=0.5) @ aside
        shortest = (ends - begins)[(inner.min() <= across) & (across <= inner.max())].min()
        return View(outline_mm, along, across, begins, ends, float(shortest))

    @property
    def _lengths_mm(self) -> FloatArray:
        return self.ends_mm - self.begins_mm

    def seen(self, travels_mm: Sequence[float]) -> Extent:
        """What frames with the panel at ``travels_mm``, one or more, see of it together.

        The rim is that of the convex view drawn along the travel without a gap.
        """
        furthest = np.array([-max(travels_mm), -min(travels_mm)])[:, None] * self.direction
        corners = self.outline_mm + furthest[:, None]
        (x_min, y_min), (x_max, y_max) = (f(corners, axis=(0, 1)).tolist() for f in (np.min, np.max))
        sides = np.roll(self.outline_mm, -1, axis=0) - self.outline_mm
        rim_mm = float(np.hypot(*sides.T).sum()) + 2 * (max(travels_mm) - min(travels_mm))
        return Extent(self.area_m2(travels_mm), (x_min, y_min, x_max, y_max), rim_mm)

    def area_m2(self, travels_mm: Sequence[float]) -> float:
        """The area of that, square metres."""
        steps = np.diff(np.sort(travels_mm))
        seen_mm = self._lengths_mm + np.minimum(self._lengths_mm[:, None], steps).sum(axis=1)
        return float(seen_mm.sum() * (self.across_mm[1] - self.across_mm[0])) / 1e6

    def longest_gap_mm(self, travels_mm: Sequence[float]) -> float:
        """The longest stretch between two frames that neither sees, in the inner half of the frame, mm; 0 for none."""
        steps = np.diff(np.sort(travels_mm))
        return max(0.0, float(steps.max(initial=0.0)) - self.length_mm)

    def unseen_share(self, area: Rectangle, travels_mm: Sequence[float]) -> float:
        """The share of an area of the panel that no frame sees, from 0 to 1, at the middles of a grid's cells."""
        middles = (np.arange(GRID) + 0.5) / GRID
        x = area.x_min_mm + middles * (area.x_max_mm - area.x_min_mm)
        y = area.y_min_mm + middles * (area.y_max_mm - area.y_min_mm)
        points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        t = points @ np.array([-self.direction[1], self.direction[0]])
        begins = np.interp(t, self.across_mm, self.begins_mm, left=np.inf, right=np.inf)
        ends = np.interp(t, self.across_mm, self.ends_mm)
        s = (points @ self.direction)[:, None] + np.asarray(travels_mm, dtype=float)
        seen = ((begins[:, None] <= s) & (s <= ends[:, None])).any(axis=1)
        return float(np.mean(~seen))
