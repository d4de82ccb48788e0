"""A scene's frame and its truth."""

from __future__ import annotations

from typing import Any

from inspector.lab import truth
from inspector.lab.imaging import expose, noise_free_dn, through_lens
from inspector.lab.light import gather
from inspector.lab.scene import Scene
from inspector.model import FloatArray, Image


def irradiance(scene: Scene) -> FloatArray:
    """Light on the sensor (height, width), W/m2, for an exposure of 1; noise and exposure come after it."""
    return through_lens(gather(scene), scene.lens)


def render(scene: Scene, light: FloatArray | None = None) -> tuple[Image, dict[str, Any]]:
    """The frame (height, width), uint8 or uint16, and its truth as plain values fit for JSON.

    ``light``: :func:`irradiance` of the scene where the caller has it already. The same scene gives the same frame.
    """
    light = irradiance(scene) if light is None else light
    return expose(light, scene.sensor), truth.of(scene, noise_free_dn(light, scene.sensor))
