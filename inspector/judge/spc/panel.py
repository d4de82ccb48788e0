"""What a panel brings to the statistics."""

from __future__ import annotations

import math
from dataclasses import dataclass

MOST_DEFECTS = 256
"""Heights and places of so many defects of a panel are looked at; all are counted."""

Bounds = tuple[float, float, float, float]
"""x_min, y_min, x_max, y_max of what was inspected, mm on the panel."""


@dataclass(frozen=True, slots=True)
class Panel:
    """One panel as judged. ``heights_um``, ``sigmas_um`` and ``places_mm`` have an entry for each measured defect;
    ``count`` may be larger: a seed without a height counts too."""

    at_s: float
    """Unix time of the result, seconds, as the caller has it."""
    recipe_id: int
    inspected: bool
    """False: NOT_INSPECTED. Such a panel is counted apart, and enters no chart."""
    count: int = 0
    area_m2: float = 0.0
    heights_um: tuple[float, ...] = ()
    sigmas_um: tuple[float | None, ...] = ()
    places_mm: tuple[tuple[float, float], ...] = ()
    bounds_mm: Bounds = (0.0, 0.0, 0.0, 0.0)
    rim_mm: float = 0.0
    """Length of the rim of what was inspected; an oblique view's is no rectangle. 0: that of the bounds."""

    @property
    def is_sound(self) -> bool:
        """Whether it may enter a chart: it was inspected, and how much of it is known."""
        return self.inspected and self.count >= 0 and math.isfinite(self.area_m2) and self.area_m2 > 0
