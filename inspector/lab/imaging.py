"""From light to grey levels: the lens' blur and halo, then the sensor's noise, response and faults."""

from __future__ import annotations

import numpy as np

from inspector.lab.light import Light
from inspector.lab.scene import Lens, Sensor
from inspector.model import FloatArray, Image

_BLOOM_ROUNDS = 12


def through_lens(light: Light, lens: Lens) -> FloatArray:
    """Irradiance (height, width) on the sensor for an exposure of 1, blurred.

    Spots are blurred by the Gaussian's exact integral over each pixel, from their exact places; a pixel grid, however
    fine, would move them.
    """
    from scipy.ndimage import gaussian_filter

    scale = np.pi / 4 / lens.f_number**2
    sharp = gaussian_filter(light.matt, lens.psf_sigma_px, mode="nearest")
    _splat(sharp, light, lens.psf_sigma_px)
    wide = gaussian_filter(sharp, np.sqrt(lens.halo_sigma_px**2 - lens.psf_sigma_px**2), mode="nearest")
    return np.asarray(scale * ((1 - lens.halo) * sharp + lens.halo * wide))


def noise_free_dn(irradiance: FloatArray, sensor: Sensor) -> FloatArray:
    """Grey levels (of the sensor's bits) of irradiance (...) at the sensor's exposure, not clipped."""
    return _response(irradiance * sensor.exposure / sensor.e_saturation, sensor)


def expose(irradiance: FloatArray, sensor: Sensor) -> Image:
    """The frame (height, width), uint8 or uint16, with all its noise; the same for the same ``sensor.seed``."""
    random = np.random.default_rng(sensor.seed)
    relative = irradiance * sensor.exposure / sensor.e_saturation
    # One pattern for a sensor of a size, whatever the frame: a fixed pattern is fixed.
    pattern = np.random.default_rng(irradiance.shape).normal(1.0, sensor.prnu, irradiance.shape)
    electrons = random.poisson(relative * pattern * sensor.full_well_e).astype(float)
    if sensor.bloom > 0:
        electrons = _bloomed(electrons, sensor.full_well_e, sensor.bloom)
    electrons += random.normal(0.0, sensor.read_noise_e, electrons.shape)
    grey = _response(np.maximum(electrons / sensor.full_well_e, 0.0), sensor)
    for x, y, above_dn in sensor.hot:
        grey[y, x] += above_dn * _unit_dn(sensor)
    top = 2**sensor.bits - 1
    whole = np.rint(np.clip(grey, 0, top))
    return whole.astype(np.uint8) if sensor.bits == 8 else whole.astype(np.uint16)


def _unit_dn(sensor: Sensor) -> float:
    """Grey levels of this sensor for one level of 8 bits."""
    return float((2**sensor.bits - 1) / 255)


def _response(relative: FloatArray, sensor: Sensor) -> FloatArray:
    grey = sensor.offset_dn + (255 - sensor.offset_dn) * relative**sensor.gamma
    return np.asarray(grey * _unit_dn(sensor))


def _splat(image: FloatArray, light: Light, sigma_px: float) -> None:
    """Add spots, each a Gaussian of ``sigma_px`` integrated over every pixel it reaches."""
    from scipy.special import ndtr

    reach = int(np.ceil(5 * sigma_px)) + 1
    offsets = np.arange(-reach, reach + 1)
    edges = np.arange(-reach, reach + 2) - 0.5
    padded = np.zeros((image.shape[0] + 2 * reach, image.shape[1] + 2 * reach))
    for start in range(0, len(light.spots), 2000):
        at, weight = light.spots_px[start : start + 2000], light.spots[start : start + 2000]
        nearest = np.clip(np.rint(at), 0, [image.shape[1] - 1, image.shape[0] - 1]).astype(int)
        across = np.diff(ndtr((edges + (nearest - at)[..., None]) / sigma_px), axis=-1)
        values = weight[:, None, None] * across[:, 1, :, None] * across[:, 0, None, :]
        row = nearest[:, 1, None, None] + offsets[None, :, None] + reach
        column = nearest[:, 0, None, None] + offsets[None, None, :] + reach
        np.add.at(padded, (row, column), values)
    image += padded[reach:-reach, reach:-reach]


def _bloomed(electrons: FloatArray, full_well_e: float, share: float) -> FloatArray:
    """Charge above the full well, its ``share`` handed on in halves to the column's neighbours, the rest drained."""
    charge = electrons.copy()
    for _ in range(_BLOOM_ROUNDS):
        excess = np.maximum(charge - full_well_e, 0.0)
        spilt = share * excess / 2
        charge -= excess
        charge[:-1] += spilt[1:]
        charge[1:] += spilt[:-1]
    return charge
