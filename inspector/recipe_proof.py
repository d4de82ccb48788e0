"""What must hold of a recipe before a station works by it. Pure."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from firmware_bridge.contracts import CameraCapabilities
from inspector.recipe import Recipe, Rectangle

if TYPE_CHECKING:
    from inspector.optics import Camera

Misfit = tuple[tuple[int | str, ...], object, str]
"""Place in the recipe, value, and what is allowed."""


def seen_by(camera: Camera) -> Rectangle | None:
    """The rectangle about what the camera sees of the panel; None if its frame is not all on the panel."""
    import numpy as np  # only stations with zones pay for it

    (x_min_mm, y_min_mm), (x_max_mm, y_max_mm) = (f(camera.outline_mm(), axis=0).tolist() for f in (np.min, np.max))
    if not np.isfinite([x_min_mm, x_max_mm, y_min_mm, y_max_mm]).all():
        return None
    return Rectangle(x_min_mm=x_min_mm, x_max_mm=x_max_mm, y_min_mm=y_min_mm, y_max_mm=y_max_mm)


def misfits(recipe: Recipe, lamp_percent: tuple[float, float], panel: Rectangle | None) -> Iterator[Misfit]:
    """What of a recipe does not fit lamp and panel.

    ``lamp_percent``: the ends of the lamp's curve; ``panel`` None where its place is not known.

    A zone may reach beyond the panel's edge, as one along the edge mostly does; but one that lies off the panel would
    never hold.
    """
    lowest, highest = lamp_percent
    if not lowest <= recipe.lamp_percent <= highest:
        allowed = f"lamp.curve does not reach it; allowed: {lowest:g} to {highest:g}"
        yield ("lamp_percent",), recipe.lamp_percent, allowed
    for n, zone in enumerate(recipe.limits.zones):
        if panel is not None and not zone.overlaps(panel):
            yield ("limits", "zones", n), zone.name, f"{zone} is off the panel; allowed: a zone that meets {panel}"


def beyond_camera(recipe: Recipe, camera: CameraCapabilities) -> Iterator[Misfit]:
    """What of a recipe the camera cannot do."""
    least_us, most_us = camera.exposure_min_us, camera.exposure_max_us
    if not least_us <= recipe.exposure_us <= most_us:
        yield ("exposure_us",), recipe.exposure_us, f"the camera takes {least_us:g} to {most_us:g} us"
    ranges = recipe.automatic_exposure
    if ranges and (ranges.min_us > most_us or ranges.max_us < least_us):
        asked = f"{ranges.min_us:g} to {ranges.max_us:g}"
        yield ("automatic_exposure",), asked, f"the camera takes {least_us:g} to {most_us:g} us"
