"""The gain of measured samples: the thesis' own samples, outliers, and samples that have no gain in common."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from inspector.estimate.height_gain import LEAST_SAMPLES, SamplesRefused, fit
from inspector.model import FloatArray

TABLE_5_5 = Path(__file__).parents[1] / "data" / "thesis" / "table_5_5.csv"
MEASURED = np.linspace(0.8, 7.0, 12)


def test_one_gain_halves_the_errors_of_the_thesis_samples() -> None:
    with TABLE_5_5.open(newline="") as file:
        rows = [(float(r["corrected_mm"]), float(r["actual_mm"])) for r in csv.DictReader(file)]
    computed, actual = np.array(rows).T
    fitted = fit(computed, actual)
    assert fitted.gain == pytest.approx(1.064, abs=5e-4)
    assert fitted.gain_sigma == pytest.approx(0.0055, abs=3e-4)
    assert fitted.used.all()
    assert np.abs(fitted.before_pct).mean() == pytest.approx(5.93, abs=5e-3)
    assert np.abs(fitted.leave_one_out_pct).mean() == pytest.approx(2.71, abs=5e-3)
    assert np.abs(fitted.after_pct).mean() < np.abs(fitted.leave_one_out_pct).mean()


@given(gain=st.floats(0.6, 1.9), seed=st.integers(0, 2**32 - 1))
def test_leave_one_out_is_what_it_says(gain: float, seed: int) -> None:
    computed = MEASURED / gain * np.random.default_rng(seed).uniform(0.99, 1.01, len(MEASURED))
    whole = fit(computed, MEASURED)
    assert whole.used.all()
    assert whole.gain == pytest.approx(gain, rel=0.01)
    for n, error_pct in enumerate(whole.leave_one_out_pct):
        others = fit(np.delete(computed, n), np.delete(MEASURED, n))
        assert error_pct == pytest.approx(100 * (others.gain * computed[n] / MEASURED[n] - 1), abs=1e-9)


def test_uncertainty_is_what_scatter_does() -> None:
    """Samples off by 2 %: the gain's error over its stated uncertainty scatters by one."""
    noise = np.random.default_rng(0)
    fits = [fit(MEASURED / 1.05 * noise.normal(1, 0.02, len(MEASURED)), MEASURED) for _ in range(200)]
    assert 0.85 < np.std([(f.gain - 1.05) / f.gain_sigma for f in fits]) < 1.25


@pytest.mark.parametrize("wrong_by", [0.3, 0.8, 1.2, 3.0])
def test_a_mistyped_sample_is_named_and_changes_nothing(wrong_by: float) -> None:
    computed = MEASURED / 1.03
    measured = MEASURED.copy()
    measured[4] *= wrong_by
    fitted = fit(computed, measured)
    assert fitted.gain == pytest.approx(1.03)
    assert np.flatnonzero(~fitted.used).tolist() == [4]
    assert fitted.leave_one_out_pct[4] == pytest.approx(100 * (1 / wrong_by - 1))


SCATTERED = MEASURED * np.tile([1.0, 1.3], 6)
HALF_WRONG = MEASURED * np.repeat([1.0, 1.2, 0.8], [7, 3, 2])


@pytest.mark.parametrize(
    ("computed", "measured", "reason"),
    [
        pytest.param(MEASURED[:0], MEASURED[:0], "too few samples: 0", id="none"),
        pytest.param(MEASURED[:2], MEASURED[:2], f"too few samples: 2; needed: {LEAST_SAMPLES}", id="two"),
        pytest.param(MEASURED, MEASURED * 1000, "gain of 1e.03, allowed: 0.5 to 2", id="micrometres"),
        pytest.param(MEASURED, SCATTERED, "agree on no gain: each alone asks for 1.000 to 1.300", id="scattered"),
        pytest.param(MEASURED, HALF_WRONG, "5 of 12 stand out", id="many wrong"),
        pytest.param(
            MEASURED, np.where(MEASURED > 6.9, 0, MEASURED), "sample 12 has a measured height of 0", id="zero"
        ),
        pytest.param(MEASURED * [np.nan, *[1] * 11], MEASURED, "sample 1 has a computed height of nan", id="nan"),
    ],
)
def test_samples_that_fix_no_gain_are_refused_with_the_reason(
    computed: FloatArray, measured: FloatArray, reason: str
) -> None:
    with pytest.raises(SamplesRefused, match=reason):
        fit(computed, measured)
