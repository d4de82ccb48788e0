"""A CCD head seen from its serial line, and the frames it takes. Knows no port and no clock."""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from firmware_bridge.wire.ccd_dialects import Answer, Command, Dialect, Verdict

FACTORY_EXPOSURE_US = 10_000.0
SPOT_SIGMA_PX = 0.8
"""How far a lens spreads a point of light."""

Scene = npt.NDArray[np.float32]


class SimulatedCcdHead:
    """Takes commands of one dialect, and keeps exposure and trigger mode. Usable from any thread.

    An exposure outside its range is clipped with a warning if the dialect has one, and else refused. ``read_back_us``,
    if set, is what it says its exposure is. ``deaf``: commands are acknowledged and nothing is done.
    """

    def __init__(self, dialect: Dialect, exposure_min_us: float | None = None, exposure_max_us: float | None = None):
        self.dialect = dialect
        self.range_us = exposure_min_us or dialect.exposure_min_us, exposure_max_us or dialect.exposure_max_us
        self.read_back_us: float | None = None
        self.deaf = False
        self._lock = threading.Lock()
        self._values = {name: float(value) for name, value in dialect.modes["Off"].items()}
        self._values[dialect.exposure] = FACTORY_EXPOSURE_US

    @property
    def exposure_us(self) -> float:
        """The exposure that its frames are taken at."""
        with self._lock:
            return self._values[self.dialect.exposure]

    @property
    def trigger(self) -> str:
        """Its trigger mode, by SFNC name."""
        with self._lock:
            modes = self.dialect.modes.items()
            return next(mode for mode, values in modes if all(self._values[name] == v for name, v in values.items()))

    def answer(self, line: bytes) -> Answer:
        """What it says to a line of command, after doing it."""
        command = self.dialect.decode(line)
        if command is None:
            return self.dialect.message(Verdict.ERROR, self.dialect.unknown_command)
        with self._lock:
            return self._read(command.name) if command.value is None else self._write(command, command.value)

    def _read(self, name: str) -> Answer:
        value = self._values[name]
        if name == self.dialect.exposure and self.read_back_us is not None:
            value = self.read_back_us
        return Answer(Verdict.VALUE, name=name, value=value)

    def _write(self, command: Command, value: float) -> Answer:
        if command.name == self.dialect.exposure:
            return self._expose(value)
        allowed = {values[command.name] for values in self.dialect.modes.values()}
        if value not in allowed:
            return self.dialect.message(Verdict.ERROR, self.dialect.bad_value)
        return self._done(command.name, value)

    def _expose(self, value: float) -> Answer:
        low_us, high_us = self.range_us
        clipped = min(max(value, low_us), high_us)
        if clipped == value:
            return self._done(self.dialect.exposure, value)
        if not self.dialect.clipped:
            return self.dialect.message(Verdict.ERROR, self.dialect.bad_value)
        self._done(self.dialect.exposure, clipped)
        return self.dialect.message(Verdict.WARNING, self.dialect.clipped["low" if clipped > value else "high"])

    def _done(self, name: str, value: float) -> Answer:
        if not self.deaf:
            self._values[name] = value
        return Answer(Verdict.DONE)


def draw(width_px: int, height_px: int, seed: int = 1) -> Scene:
    """What falls on the sensor: a shaded background and a few round spots. Shape (height_px, width_px).

    Values are shares of full scale at FACTORY_EXPOSURE_US. The spots stand in pairs side by side, as a seed's two
    highlights do.
    """
    random = np.random.default_rng(seed)
    y, x = np.mgrid[0:height_px, 0:width_px].astype(np.float32)
    scene = 0.06 + 0.03 * y / height_px
    for _ in range(4):
        at_x, at_y = random.uniform(0.1, 0.85) * width_px, random.uniform(0.1, 0.9) * height_px
        for offset_px, peak in ((0.0, 0.6), (0.03 * width_px, 0.4)):
            scene += peak * np.exp(-((x - at_x - offset_px) ** 2 + (y - at_y) ** 2) / (2 * 1.6**2))
    return np.asarray(scene, np.float32)


def draw_spots(
    width_px: int, height_px: int, spots: Sequence[tuple[float, float, float]], floor: float, exposure_us: float
) -> Scene:
    """Spots (x_px, y_px, peak) over an even floor. Shape (height_px, width_px), shares of full scale as :func:`draw`'s.

    Peaks and floor are shares of full scale at ``exposure_us``. Each spot is a Gaussian integrated over its pixels.
    """
    scene = np.full((height_px, width_px), floor, np.float64)
    for x_px, y_px, peak in spots:
        across, down = _profile(width_px, x_px), _profile(height_px, y_px)
        scene += peak * 2 * np.pi * SPOT_SIGMA_PX**2 * down[:, None] * across
    return np.asarray(scene * (FACTORY_EXPOSURE_US / exposure_us), np.float32)


def _profile(length: int, at_px: float) -> npt.NDArray[np.float64]:
    """Share of a Gaussian's light that falls on each of ``length`` pixels."""
    edges = (np.arange(length + 1) - 0.5 - at_px) / (math.sqrt(2) * SPOT_SIGMA_PX)
    return np.diff([math.erf(edge) for edge in edges]) / 2


class Sensor:
    """Turns a scene into frames: linear in exposure, with noise that is new in each, full at full scale."""

    def __init__(self, scene: Scene, bits: int, seed: int = 1, noise_share: float = 0.002) -> None:
        self._scene, self._full_scale = scene, 2**bits - 1
        self._random = np.random.default_rng(seed)
        # Drawn once: a frame takes a piece of it elsewhere each time, which costs nothing.
        self._noise = self._random.normal(0, noise_share, 2 * scene.size).astype(np.float32)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self._scene.shape[0], self._scene.shape[1]

    def take(self, exposure_us: float) -> npt.NDArray[np.uint8] | npt.NDArray[np.uint16]:
        """A frame (H, W), uint8 or uint16."""
        start = int(self._random.integers(self._scene.size))
        noise = self._noise[start : start + self._scene.size].reshape(self._scene.shape)
        share = self._scene * np.float32(exposure_us / FACTORY_EXPOSURE_US) + noise
        values: Scene = np.clip(np.rint(share * self._full_scale), 0, self._full_scale)
        return values.astype(np.uint16) if self._full_scale > 255 else values.astype(np.uint8)
