"""Charts against published examples and published average run lengths."""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from statistics import NormalDist, fmean, stdev

import pytest
from run_lengths import PUBLISHED, Signal

from inspector.judge.spc import counts, runs
from inspector.judge.spc.charts import Cusum, Ewma
from inspector.judge.spc.spread import expected_distance, neighbours, pattern

MONTGOMERY_9_1 = (
    *(9.45, 7.99, 9.29, 11.66, 12.16, 10.18, 8.04, 11.46, 9.20, 10.34, 9.03, 11.47, 10.51, 9.40, 10.08),
    *(9.37, 10.62, 10.31, 8.52, 10.84, 10.90, 9.33, 12.29, 11.50, 10.60, 11.08, 10.38, 11.62, 11.31, 10.52),
)
"""Montgomery, Introduction to Statistical Quality Control, table 9.1: mean 10, from the 21st value on 11."""


def test_cusum_of_montgomery_example_9_1() -> None:
    cusum, first = Cusum(), 0
    above, below = [], []
    for n, x in enumerate(MONTGOMERY_9_1, 1):
        cusum.step(x - 10.0, 0.5, 5.0)
        above.append(round(cusum.above, 2))
        below.append(round(cusum.below, 2))
        if cusum.above > 5 and not first:
            first, since = n, cusum.since_above
    assert above[:8] == [0, 0, 0, 1.16, 2.82, 2.50, 0.04, 1.00]
    assert above[22:] == [1.79, 2.79, 2.89, 3.47, 3.35, 4.47, 5.28, 5.30]
    assert below[:3] == [0.05, 1.56, 1.77]
    assert (first, since) == (29, 7), "the book: signal at 29, N+ = 7, so the shift began after 22"


def test_ewma_of_montgomery_example_9_2() -> None:
    ewma, values, limits = Ewma(), [], []
    for x in MONTGOMERY_9_1:
        ewma.step(x - 10.0, 0.10)
        values.append(10 + ewma.value)
        limits.append(ewma.limit(0.10, 2.7))
    assert values[:4] == pytest.approx([9.945, 9.7495, 9.7036, 9.8992], abs=6e-5)
    assert values[-2:] == pytest.approx([10.6468, 10.6341], abs=5e-5)
    assert limits[:2] == pytest.approx([0.27, 0.3632], abs=1e-4)
    assert limits[-1] == pytest.approx(0.62, abs=5e-3)


def test_u_chart_of_montgomery_dyed_cloth() -> None:
    """Defects in rolls of dyed cloth of unequal size, in units of 50 square metres."""
    size = (10.0, 8.0, 13.0, 10.0, 9.5, 10.0, 12.0, 10.5, 12.0, 12.5)
    defects = (14, 12, 20, 11, 7, 10, 21, 16, 19, 23)
    mean = sum(defects) / sum(size)
    assert mean == pytest.approx(1.42, abs=5e-3)
    limits = [counts.limits(mean * units, kind="three_sigma") for units in size]
    upper = [limit.upper / units for limit, units in zip(limits, size, strict=True)]
    lower = [limit.lower / units for limit, units in zip(limits, size, strict=True)]
    assert upper == pytest.approx([2.55, 2.68, 2.41, 2.55, 2.58, 2.55, 2.45, 2.52, 2.45, 2.43], abs=0.01)
    assert lower == pytest.approx([0.29, 0.16, 0.43, 0.29, 0.26, 0.29, 0.39, 0.32, 0.39, 0.41], abs=0.01)
    assert all(limit.lower < count < limit.upper for limit, count in zip(limits, defects, strict=True))


@pytest.mark.parametrize("mean", [0.2, 1.0, 3.7, 20.0, 400.0])
@pytest.mark.parametrize("tail", [0.00135, 1e-4])
def test_probability_limits_are_the_tightest_that_keep_their_promise(mean: float, tail: float) -> None:
    def probability(count: int) -> float:
        return math.exp(count * math.log(mean) - mean - math.lgamma(count + 1))

    limits = counts.limits(mean, tail=tail)
    upper, lower = int(limits.upper), int(limits.lower)
    beyond = sum(probability(n) for n in range(upper + 1, upper + 400))
    assert beyond <= tail < beyond + probability(upper)
    below = sum(probability(n) for n in range(lower))
    assert below <= tail < below + probability(lower)


def test_laney_s_limits_are_u_limits_times_the_scatter_between_panels() -> None:
    """Laney 2002: u +/- 3 sigma_u sigma_z, sigma_z the mean moving range of z over 1.128; here worked by hand:
    counts 10, 30, 10, 30 of mean 20 are z = -2.236, 2.236, ..., ranges 4.472, sigma_z 3.965."""
    sigma_z = counts.sigma_z([10, 30, 10, 30], [20.0] * 4)
    assert sigma_z == pytest.approx(2 * math.sqrt(5) / 1.128)
    limits = counts.limits(20.0, sigma_z, "three_sigma")
    assert limits.upper == pytest.approx(20 + 3 * math.sqrt(20) * 3.9647, abs=1e-3)
    assert limits.lower == 0.0


def test_sigma_z_finds_a_rate_that_varies_from_panel_to_panel() -> None:
    """A rate that is gamma distributed with coefficient of variation v gives counts of variance m + (m v)^2."""
    draw, mean, v = random.Random(4), 20.0, 0.4
    seen = [poisson(draw, mean * draw.gammavariate(1 / v**2, v**2)) for _ in range(4000)]
    assert counts.sigma_z(seen, [mean] * len(seen)) == pytest.approx(math.sqrt(1 + mean * v**2), rel=0.05)
    assert counts.dispersion_is_excessive(seen[:50], [mean] * 50, 0.05)
    plain = [poisson(draw, mean) for _ in range(4000)]
    assert counts.sigma_z(plain, [mean] * len(plain)) == pytest.approx(1.0, rel=0.05)


def test_excess_dispersion_is_called_no_more_often_than_it_says() -> None:
    draw, called = random.Random(5), 0
    for _ in range(1000):
        seen = [poisson(draw, 4.0) for _ in range(50)]
        called += counts.dispersion_is_excessive(seen, [fmean(seen)] * 50, 0.05)
    assert called <= 50 + 3 * math.sqrt(1000 * 0.05 * 0.95)


def poisson(draw: random.Random, mean: float) -> int:
    """Knuth's; for means to some hundreds."""
    limit, product, count = math.exp(-mean), draw.random(), 0
    while product > limit:
        product, count = product * draw.random(), count + 1
    return count


ROWS = [(name, signal, shift, length) for name, signal, lengths in PUBLISHED for shift, length in lengths.items()]


@pytest.mark.parametrize(("name", "signal", "shift", "published"), ROWS)
def test_run_lengths_are_those_published(
    name: str, signal: Callable[[], Signal], shift: float, published: float
) -> None:
    """Of normal values with a mean of ``shift``."""
    draw, lengths = random.Random(7), []
    for _ in range(200 if shift == 0 else 1500):
        is_out, length = signal(), 1
        while not is_out(draw.gauss(shift)):
            length += 1
        lengths.append(length)
    error = stdev(lengths) / math.sqrt(len(lengths))
    assert fmean(lengths) == pytest.approx(published, abs=4 * error + 0.05), name  # published to one decimal


@pytest.mark.parametrize("mean", [0.3, 1.0, 4.0, 20.0])
def test_scores_of_counts_do_not_run_into_a_cusum_sooner_than_normal_values(mean: float) -> None:
    """One-sided, k = 0.5, h = 3: 117.6 for normal values (Brook and Evans 1972)."""
    draw, lengths = random.Random(8), []
    for _ in range(150):
        cusum, length = Cusum(), 0
        while cusum.above <= 3.0 and length < 2000:
            cusum.step(counts.score(poisson(draw, mean), mean), 0.5, 3.0)
            length += 1
        lengths.append(length)
    assert fmean(lengths) > 117.6 - 3 * stdev(lengths) / math.sqrt(len(lengths))


def test_scores_of_large_counts_are_standard_normal() -> None:
    normal = NormalDist()
    for z in (-3.0, -1.0, 0.0, 2.0):
        count = round(10_000 + 100 * z)
        assert counts.score(count, 10_000.0) == pytest.approx(z, abs=0.02)
    assert normal.cdf(counts.score(3, 3.0)) == pytest.approx(0.5352, abs=1e-3), "P(X<3) + P(X=3)/2 = 0.42319 + 0.11202"


# Each pattern ends where its rule first holds; the value before must not be enough.
NELSON = {
    1: [0.0, 3.1],
    2: [0.1, *[0.5, 0.2] * 4, 0.3][1:],
    3: [0.0, 0.1, 0.2, 0.3, 0.4, 0.5],
    4: [0.1, -0.1] * 7,
    5: [2.1, 0.0, 2.2],
    6: [1.1, 1.2, 0.0, 1.3, 1.1],
    7: [0.5, -0.5, 0.2] * 5,
    8: [1.1, -1.2] * 4,
}


@pytest.mark.parametrize("rule", NELSON)
def test_nelson_s_rules_hold_at_their_last_value_and_not_before(rule: int) -> None:
    values = NELSON[rule]
    assert runs.broken(values, (rule,)) == rule
    assert runs.broken([-v for v in values], (rule,)) == rule
    assert runs.broken(values[:-1], (rule,)) == 0
    assert runs.broken([], tuple(NELSON)) == 0


def test_nearest_neighbours_of_a_hexagonal_lattice() -> None:
    """Clark and Evans 1954: R is 2.1491 at most, where each place has six others around it; the panel's rim apart."""
    step, rows, columns = 10.0, 30, 30
    places = [(step * (x + 0.5 * (y % 2)), step * math.sqrt(0.75) * y) for y in range(rows) for x in range(columns)]
    area = step * columns * step * math.sqrt(0.75) * rows
    found = neighbours(places, area, 4 * math.sqrt(area))
    assert found is not None
    without_rim = 0.5 * math.sqrt(area / len(places))
    assert found.total_mm / len(places) / without_rim == pytest.approx(2.1491, abs=1e-4)


def test_random_places_are_called_random_as_often_as_they_should() -> None:
    draw, z = random.Random(9), []
    for _ in range(400):
        panels = [
            neighbours([(draw.uniform(0, 400), draw.uniform(0, 250)) for _ in range(6)], 400.0 * 250.0, 1300.0)
            for _ in range(10)
        ]
        found = pattern(panel for panel in panels if panel)
        assert found is not None
        z.append(found.z)
    assert fmean(z) == pytest.approx(0.0, abs=0.2)
    assert stdev(z) == pytest.approx(1.0, abs=0.15)
    assert expected_distance(100, 100.0, 40.0)[0] == pytest.approx(0.5 + 0.0555 * 40 / 100)


def test_random_places_in_an_oblique_view_are_called_random() -> None:
    """The field of an oblique camera is a trapezium: its own area and rim count, not those of a box around it."""
    draw, panels = random.Random(10), []
    sides = math.hypot(100, 200)
    for _ in range(300):
        places: list[tuple[float, float]] = []
        while len(places) < 12:
            x, y = draw.uniform(0, 400), draw.uniform(0, 200)
            if y / 2 < x < 400 - y / 2:
                places.append((x, y))
        panels.append(neighbours(places, (400 + 200) / 2 * 200, 400 + 200 + 2 * sides))
    found = pattern(panel for panel in panels if panel)
    assert found is not None
    assert abs(found.z) < 3.3
