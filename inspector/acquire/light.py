"""Light kept constant: a reference patch in the field is watched, and the lamp's level trimmed slowly. Pure.

A bulb ages, glass gets dusty. The patch (white, matt, in every frame) shows it; the level read back does not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Self

from pydantic import Field, PositiveFloat, PositiveInt, model_validator

from firmware_bridge.strict import Strict
from inspector.faults import Fault
from inspector.model import Image

SETTLED = 0.002
"""A patch within this share of its target is left alone: the level's own steps are of this size."""
LEAST_SHARE = 0.01
"""Less of the target than this says no more about how much is missing."""
SPARSE = 16
"""One row of so many, and one pixel of so many in it, tell how dark the panel is."""
LONGEST_STEP_S = 60.0
"""After a longer pause the level moves as after this one: what the light did meanwhile is not known."""


class Patch(Strict):
    """A rectangle of the image."""

    x_px: int = Field(ge=0)
    """Its left column, pixels."""
    y_px: int = Field(ge=0)
    """Its top row, pixels."""
    width_px: PositiveInt
    """Its columns, pixels."""
    height_px: PositiveInt
    """Its rows, pixels."""


class LightSettings(Strict):
    """A reference patch in the field, by which the light is kept constant and a failing lamp is noticed."""

    patch: Patch
    """Where the reference is in the image, its rim included: its inner half is measured, and none of it inspected."""
    target_dn: PositiveFloat
    """Its mean grey value at the recipe's exposure and lamp level, DN."""
    black_dn: float = Field(0.0, ge=0)
    """Its mean grey value without light, DN."""
    tolerance: float = Field(0.15, gt=0, lt=1)
    """A frame whose patch is further from its target, as a share of it, is not inspected."""
    trim_limit_percent: float = Field(10.0, ge=0, le=25)
    """The lamp is trimmed by no more than this, points of intensity up or down."""
    trim_percent_per_minute: PositiveFloat = 1.0
    """The lamp is trimmed no faster than this, points of intensity a minute."""
    weak_share: float = Field(0.6, gt=0, le=1)
    """The lamp is called weak when it needs more than this share of trim_limit_percent."""

    @model_validator(mode="after")
    def _has_range(self) -> Self:
        if not self.black_dn < self.target_dn:
            raise ValueError(f"black_dn must be below target_dn, {self.target_dn:g}")
        return self


@dataclass(frozen=True, slots=True)
class Trim:
    """What is added to the lamp's level, points of intensity, and when that was last looked at."""

    percent: float = 0.0
    at_s: float | None = None


def patch_mean_dn(image: Image, patch: Patch) -> float:
    """Mean grey value of the patch's inner half, DN; NaN where the patch is not all in the image."""
    whole = image[_area(patch)]
    if whole.shape != (patch.height_px, patch.width_px):
        return math.nan
    return float(inner(image, patch).mean())


def inner(image: Image, patch: Patch) -> Image:
    """The patch without a quarter of its width and height at each side: what is measured."""
    rim_x, rim_y = patch.width_px // 4, patch.height_px // 4
    whole = image[_area(patch)]
    return whole[rim_y : patch.height_px - rim_y, rim_x : patch.width_px - rim_x]


def without(image: Image, patch: Patch) -> Image:
    """A copy of the image in which the patch is as dark as the panel: a reference is no seed."""
    import numpy as np  # settings are read without

    blank = image.copy()
    blank[_area(patch)] = np.median(image[::SPARSE, ::SPARSE])
    return blank


def _area(patch: Patch) -> tuple[slice, slice]:
    return slice(patch.y_px, patch.y_px + patch.height_px), slice(patch.x_px, patch.x_px + patch.width_px)


def fault_of_light(mean_dn: float, target_dn: float, tolerance: float) -> Fault:
    """NONE if the patch is near its target, both over black; else what is wrong: weak or dead lamp, or other light."""
    if abs(mean_dn - target_dn) <= tolerance * target_dn:
        return Fault.NONE
    return Fault.FRAME_OVERLIT if mean_dn > target_dn else Fault.LAMP_WEAK


def trimmed(
    trim: Trim, mean_dn: float, target_dn: float, level_percent: float, settings: LightSettings, now_s: float
) -> Trim:
    """The next trim, from a frame taken at ``level_percent`` (trim included): slowly, within its limit.

    Patch and target are over black. A patch without light, or none, moves nothing.
    """
    elapsed_s = 0.0 if trim.at_s is None else min(max(now_s - trim.at_s, 0.0), LONGEST_STEP_S)
    step = settings.trim_percent_per_minute * elapsed_s / 60
    if not mean_dn > 0 or abs(mean_dn / target_dn - 1) <= SETTLED:
        return replace(trim, at_s=now_s)
    missing = level_percent * (target_dn / max(mean_dn, LEAST_SHARE * target_dn) - 1)
    limit = settings.trim_limit_percent
    return Trim(min(max(trim.percent + min(max(missing, -step), step), -limit), limit), now_s)


def is_weak(trim: Trim, settings: LightSettings) -> bool:
    """Whether most of what the level may be raised by is used up."""
    return trim.percent > settings.weak_share * settings.trim_limit_percent
