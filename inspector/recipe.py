"""What a paint colour and part type decide: exposure, lamp level, detection, method, limits and zones.

Frozen and strict; the stages take these models as they are.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from typing import Literal, Self

from pydantic import Field, PositiveFloat, PositiveInt, model_validator

from firmware_bridge.strict import Strict


class Detection(Strict):
    """How highlights are found."""

    threshold_dn: PositiveFloat | None = None
    """Grey level above which a pixel is lit, DN; null: set from each frame's own background and noise."""
    threshold_sigma: float = Field(8.0, ge=3, le=100)
    """With threshold_dn null: how many background standard deviations above the background a lit pixel is."""
    min_area_px: PositiveInt = 1
    """Smaller highlights are flagged too_small, pixels."""
    max_area_px: PositiveInt = 2000
    """Larger highlights are flagged too_large, pixels."""
    max_highlights: PositiveInt = 2048
    """A frame with more is refused as lit all over."""
    max_lit_fraction: float = Field(0.05, gt=0, le=1)
    """A frame with a larger share of lit pixels is refused as lit all over."""


class Rectangle(Strict):
    """A rectangle of the panel, its edges along the world's axes."""

    x_min_mm: float
    """Left edge on the panel, mm."""
    x_max_mm: float
    """Right edge on the panel, mm."""
    y_min_mm: float
    """Lower edge on the panel, mm."""
    y_max_mm: float
    """Upper edge on the panel, mm."""

    def overlaps(self, other: Rectangle) -> bool:
        """Whether the two have a point in common."""
        across = self.x_min_mm <= other.x_max_mm and other.x_min_mm <= self.x_max_mm
        return across and self.y_min_mm <= other.y_max_mm and other.y_min_mm <= self.y_max_mm

    def __str__(self) -> str:
        return f"x {self.x_min_mm:g} to {self.x_max_mm:g}, y {self.y_min_mm:g} to {self.y_max_mm:g} mm"

    @model_validator(mode="after")
    def _has_extent(self) -> Self:
        for low, high in (("x_min_mm", "x_max_mm"), ("y_min_mm", "y_max_mm")):
            if not getattr(self, low) < getattr(self, high):
                raise ValueError(f"{low} must be below {high}, {getattr(self, high):g}")
        return self


class Zone(Rectangle):
    """A rectangle of the panel with limits of its own (the stricter of its own and the panel's holds)."""

    name: str = Field(min_length=1)
    """Name shown in reasons."""
    max_height_um: PositiveFloat | None = None
    """A defect higher than this fails the panel, um; null: no limit of its own."""
    max_count: int | None = Field(None, ge=0)
    """More defects than this in the zone fail the panel; null: no limit."""
    ignore: bool = False
    """True: defects in the zone are reported but not judged."""


class Limits(Strict):
    """When a panel fails. A null limit is not applied."""

    max_height_um: PositiveFloat | None = 500.0
    """A defect higher than this fails the panel, um."""
    min_height_um: float = Field(0.0, ge=0)
    """Defects surely lower than this are reported but not judged, um."""
    guard_band_sigma: float = Field(2.0, ge=0, le=10)
    """Guard band: a height within this many of its own sigmas of a limit is decided by guard_band."""
    guard_band: Literal["fail", "pass"] = "fail"
    """What a height within the guard band of its limit means; fail is the safe side (ISO 14253-1)."""
    max_count: int | None = Field(None, ge=0)
    """More defects than this fail the panel."""
    max_per_m2: PositiveFloat | None = None
    """A higher density of defects fails the panel, defects per square metre of inspected area."""
    max_unpaired: int | None = Field(None, ge=0)
    """More unexplained unpaired highlights than this fail the panel."""
    unmeasured_seed: Literal["fail", "report"] = "fail"
    """What a highlight that is surely a seed, but has no height (merged, partner hidden or cut off), means."""
    zones: tuple[Zone, ...] = Field((), strict=False)
    """Rectangles with limits of their own."""


class AutomaticExposure(Strict):
    """Between panels, exposure and lamp level are moved so that the brightest spots come near full scale, and none
    bleeds: the exposure as long, the lamp as low as can be."""

    min_us: PositiveFloat = 10.0
    """Shortest exposure, microseconds."""
    max_us: PositiveFloat = 10000.0
    """Longest exposure, microseconds: that in which the panel moves by a small part of a pixel."""
    lamp_min_percent: float = Field(75.0, ge=75, le=100)
    """Lowest lamp level, percent; a halogen bulb below 75 lives shorter."""
    lamp_max_percent: float = Field(100.0, ge=75, le=100)
    """Highest lamp level, percent."""

    @model_validator(mode="after")
    def _are_ranges(self) -> Self:
        for low, high in (("min_us", "max_us"), ("lamp_min_percent", "lamp_max_percent")):
            if getattr(self, low) > getattr(self, high):
                raise ValueError(f"{low} is above {high}; allowed: at most {getattr(self, high):g}")
        return self


class Recipe(Strict):
    """Everything a paint colour or part type decides."""

    id: int = Field(1, ge=1, le=65535)
    """Number by which the PLC selects the recipe."""
    name: str = Field("default", min_length=1)
    """Name shown to people."""
    exposure_us: PositiveFloat = 1000.0
    """Exposure, microseconds."""
    lamp_percent: float = Field(80.0, ge=0, le=100)
    """Lamp intensity, percent of full."""
    automatic_exposure: AutomaticExposure | None = None
    """Ranges within which exposure and lamp level follow the spots, beginning with the two above; null: they stay."""
    method: Literal["exact", "thesis"] = "exact"
    """How heights are computed: exact (the product's model) or thesis (the 2004 formula)."""
    detection: Detection = Detection.default()
    """How highlights are found."""
    limits: Limits = Limits.default()
    """When a panel fails."""

    @model_validator(mode="after")
    def _begins_within(self) -> Self:
        ranges = self.automatic_exposure
        if ranges and not ranges.min_us <= self.exposure_us <= ranges.max_us:
            allowed = f"{ranges.min_us:g} to {ranges.max_us:g}"
            raise ValueError(f"exposure_us {self.exposure_us:g} is outside automatic_exposure, {allowed}")
        if ranges and not ranges.lamp_min_percent <= self.lamp_percent <= ranges.lamp_max_percent:
            allowed = f"{ranges.lamp_min_percent:g} to {ranges.lamp_max_percent:g}"
            raise ValueError(f"lamp_percent {self.lamp_percent:g} is outside automatic_exposure, {allowed}")
        return self


def content_hash(recipe: Recipe) -> int:
    """32 bits of SHA-256 of what the recipe says, defaults filled in: the same for the same content."""
    text = json.dumps(recipe.model_dump(mode="json"), sort_keys=True)
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:4], "big")


def find(recipes: Iterable[Recipe], wanted: object) -> Recipe | None:
    """The recipe of this id (a whole number) or name (a text); None if there is none."""
    return next((r for r in recipes if wanted in (r.id, r.name) and not isinstance(wanted, bool)), None)
