"""The thesis' height of a seed: from its two spots carried back to the panel (P. Gnanaprakasam, 2004, sec. 4.3, 5.11).

Kept as printed, with one view angle for the whole field and one surface point for both spots; the product's default
is the exact model of :mod:`inspector.reflection`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from inspector.model import FloatArray


@dataclass(frozen=True)
class ThesisHeights:
    """The chain's values for n seeds, each (n,) mm, named after the thesis' figure 4.5.

    ``spacing_mm`` is X, ``first_stage_mm`` is h, ``height_mm`` is a, corrected for where on the sphere the spot sits.
    """

    spacing_mm: FloatArray
    ea_mm: FloatArray
    ca_mm: FloatArray
    first_stage_mm: FloatArray
    height_mm: FloatArray


def spacing_mm(direct_xy_mm: FloatArray, mirror_xy_mm: FloatArray) -> FloatArray:
    """Distance X (n,) of two spots on the panel, both (n, 2) mm (5.1)."""
    return np.asarray(np.linalg.norm(direct_xy_mm - mirror_xy_mm, axis=-1))


def corrected_mm(first_stage_mm: FloatArray, alpha_deg: float, beta_deg: float) -> FloatArray:
    """Seed height a (n,) from the first-stage height h (n,): the spot sits below the sphere's top (4.5)."""
    return np.asarray(first_stage_mm / (0.5 * (1 + np.cos(np.radians((beta_deg - alpha_deg) / 2)))))


def chain(direct_xy_mm: FloatArray, mirror_xy_mm: FloatArray, alpha_deg: float, beta_deg: float) -> ThesisHeights:
    """Every step of the chain for spots (n, 2) mm on z = 0; ``alpha_deg``, ``beta_deg`` from the panel's normal.

    lambda = 2 beta - 90 and delta = 90 - beta make it h = X / (2 tan beta). NaN spots give NaN heights. Raises
    ValueError where beta is not between 0 and 90 degrees, exclusive.
    """
    if not 0 < beta_deg < 90:
        raise ValueError(f"view angle {beta_deg} deg: the thesis' chain needs one between 0 and 90, exclusive")
    beta = np.radians(beta_deg)
    x = spacing_mm(direct_xy_mm, mirror_xy_mm)
    ea = x * np.cos(beta)  # (4.4)
    ca = ea / np.cos(2 * beta - np.pi / 2)  # (4.1)
    h = ca * np.sin(np.pi / 2 - beta)  # (4.2)
    return ThesisHeights(x, ea, ca, h, corrected_mm(h, alpha_deg, beta_deg))


def thesis_height_mm(
    direct_xy_mm: FloatArray, mirror_xy_mm: FloatArray, alpha_deg: float, beta_deg: float
) -> FloatArray:
    """Heights (n,) mm of seeds by :func:`chain`."""
    return chain(direct_xy_mm, mirror_xy_mm, alpha_deg, beta_deg).height_mm
