"""The gain that brings computed heights to those measured on samples, and how far it can be trusted.

All errors of the thesis' ceramic samples have one sign: one factor halves them (Table 5.5: 5.93 % becomes 2.71 %, each
sample judged by the gain of the others). Real seeds are no spheres at rest; what they have in common is in the gain.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from inspector.model import FloatArray

LEAST_SAMPLES = 3
"""Two cannot tell which of them is wrong."""
OUTLIER_SIGMA = 3.5
"""Modified z-score beyond which a sample is left out (B. Iglewicz, D. Hoaglin, How to Detect and Handle Outliers)."""
SIGMA_PER_MAD = 1.4826
"""Standard deviation of a Gaussian over its median absolute deviation."""
LEAST_SCATTER = 0.01
"""Scatter of a sample's gain assumed at the least: a gauge reads 0.02 mm of a 2 mm seed."""
MOST_SCATTER = 0.10
"""Samples that scatter by more have no gain in common; the thesis' scatter by 0.034."""
MOST_LEFT_OUT = 1 / 3
"""Share of the samples that may be outliers."""
GAIN_RANGE = (0.5, 2.0)
"""A gain beyond is a wrong unit or a wrong calibration, not a correction."""


class SamplesRefused(ValueError):
    """The samples fix no gain; the message says why and what to do."""


@dataclass(frozen=True)
class HeightGain:
    """A gain with its standard uncertainty ``gain_sigma``, and what it does to each of n samples.

    ``used`` (n,): not an outlier. Errors (n,) are computed less measured, percent of measured: ``before_pct`` with
    gain 1, ``after_pct`` with ``gain``, ``leave_one_out_pct`` with the gain of the other samples.
    """

    gain: float
    gain_sigma: float
    used: npt.NDArray[np.bool_]
    before_pct: FloatArray
    after_pct: FloatArray
    leave_one_out_pct: FloatArray


def fit(computed_mm: FloatArray, measured_mm: FloatArray) -> HeightGain:
    """The gain of samples whose heights were computed with gain 1 and measured, both (n,) mm.

    It is the mean of measured over computed, outliers left out. Raises SamplesRefused.
    """
    _check(computed_mm, measured_mm)
    gains = measured_mm / computed_mm
    used = _consistent(gains)
    gain, n = float(gains[used].mean()), int(used.sum())
    if not GAIN_RANGE[0] <= gain <= GAIN_RANGE[1]:
        raise SamplesRefused(
            f"the samples ask for a gain of {gain:.3g}, allowed: {GAIN_RANGE[0]:g} to {GAIN_RANGE[1]:g}: check that"
            " heights are in mm and that calibration and frames are of one camera"
        )
    others = np.where(used, (n * gain - gains) / (n - 1), gain)
    return HeightGain(
        gain=gain,
        gain_sigma=float(gains[used].std(ddof=1) / np.sqrt(n)),
        used=used,
        before_pct=100 * (1 / gains - 1),
        after_pct=100 * (gain / gains - 1),
        leave_one_out_pct=100 * (others / gains - 1),
    )


def _check(computed_mm: FloatArray, measured_mm: FloatArray) -> None:
    """Refuse what is no list of heights. Raises SamplesRefused."""
    if len(measured_mm) < LEAST_SAMPLES:
        raise SamplesRefused(f"too few samples: {len(measured_mm)}; needed: {LEAST_SAMPLES} or more, better 10")
    for name, heights_mm in (("computed", computed_mm), ("measured", measured_mm)):
        wrong = np.flatnonzero(~(np.isfinite(heights_mm) & (heights_mm > 0)))
        if len(wrong):
            raise SamplesRefused(
                f"sample {wrong[0] + 1} has a {name} height of {heights_mm[wrong[0]]:g} mm, allowed: above 0"
            )


def _consistent(gains: FloatArray) -> npt.NDArray[np.bool_]:
    """Which samples (n,) agree with the most of them. Raises SamplesRefused where most agree on nothing."""
    middle = float(np.median(gains))
    scatter = SIGMA_PER_MAD * float(np.median(np.abs(gains - middle)))
    used = np.asarray(np.abs(gains - middle) <= OUTLIER_SIGMA * max(scatter, LEAST_SCATTER * middle))
    left_out = len(used) - int(used.sum())
    if scatter > MOST_SCATTER * middle or left_out > MOST_LEFT_OUT * len(gains):
        raise SamplesRefused(
            f"the samples agree on no gain: each alone asks for {gains.min():.3f} to {gains.max():.3f}, and"
            f" {left_out} of {len(gains)} stand out; check positions and measured heights, and the camera's calibration"
        )
    return used
