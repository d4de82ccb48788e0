"""Frames with spots drawn in: a Gaussian integrated over each pixel, then noise, clip, response and rounding."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import erf

from inspector import optics
from inspector.model import FloatArray, Highlights, Image


@dataclass(frozen=True)
class Drawing:
    """How a frame comes about. Light is in DN of a linear sensor above ``black_dn``; full scale is ``full_dn``.

    ``slope_dn`` is how much the panel's light grows over the frame along x and y; ``bloom`` the share of charge above
    full scale that runs to the two neighbours along the column.
    """

    shape: tuple[int, int] = (480, 640)
    blur_px: float = 0.7
    panel_dn: float = 8.0
    slope_dn: tuple[float, float] = (0.0, 0.0)
    black_dn: float = 3.0
    full_dn: float = 255.0
    gamma: float = 1.0
    noise_dn: float = 1.0
    electrons_per_dn: float = 60.0
    bloom: float = 0.0

    @property
    def sensor(self) -> optics.Sensor:
        return optics.Sensor(gamma=self.gamma, black_dn=self.black_dn, saturation_dn=self.full_dn)

    def draw(self, xy_px: FloatArray, peak_dn: FloatArray | float, seed: int = 0) -> Image:
        """The frame, uint8 or uint16, with spots at (n, 2) whose Gaussians peak at ``peak_dn`` (n,) over the panel."""
        rng, span = np.random.default_rng(seed), self.full_dn - self.black_dn
        light = self._light(xy_px, np.broadcast_to(peak_dn, len(xy_px)))
        scale = self.full_dn / 255
        light += rng.normal(size=self.shape) * np.sqrt(
            (self.noise_dn * scale) ** 2 + light * scale / self.electrons_per_dn
        )
        grey = self.black_dn + span * np.clip(self._bloomed(light, span) / span, 0, 1) ** self.gamma
        return np.rint(grey).astype(np.uint8 if self.full_dn <= 255 else np.uint16)

    def _light(self, xy_px: FloatArray, peak_dn: FloatArray) -> FloatArray:
        height, width = self.shape
        rows, columns = np.linspace(-0.5, 0.5, height)[:, None], np.linspace(-0.5, 0.5, width)
        light = self.panel_dn * (self.full_dn / 255) + self.slope_dn[0] * columns + self.slope_dn[1] * rows
        for (x, y), peak in zip(xy_px, peak_dn, strict=True):
            across, down = self._profile(width, x), self._profile(height, y)
            light += 2 * np.pi * self.blur_px**2 * peak * down[:, None] * across
        return np.maximum(light, 0.0)

    def _profile(self, length: int, at: float) -> FloatArray:
        """Share of a Gaussian's light that falls on each of ``length`` pixels."""
        edges = (np.arange(length + 1) - 0.5 - at) / (np.sqrt(2) * self.blur_px)
        return np.diff(erf(edges)) / 2

    def _bloomed(self, light: FloatArray, span: float) -> FloatArray:
        columns = np.flatnonzero(light.max(axis=0) > span)
        part = light[:, columns]
        while self.bloom and (excess := np.maximum(part - span, 0)).max(initial=0) > 1:
            part = np.minimum(part, span)
            part[1:] += self.bloom * excess[:-1] / 2
            part[:-1] += self.bloom * excess[1:] / 2
        light[:, columns] = part
        return light


def lattice(columns: int, rows: int, shape: tuple[int, int], rng: np.random.Generator) -> FloatArray:
    """Spots (n, 2) far from each other and from the frame's edge, each anywhere on its pixel."""
    x, y = (np.linspace(20, n - 21, k).round() for n, k in ((shape[1], columns), (shape[0], rows)))
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    return grid + rng.uniform(-0.5, 0.5, grid.shape)


def nearest(found: Highlights, xy_px: FloatArray) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
    """Index (n,) of the highlight nearest to each of the points (n, 2)."""
    return np.hypot(*(found.xy_px[:, None] - xy_px).transpose(2, 0, 1)).argmin(axis=0)
