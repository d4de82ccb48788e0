"""Average run lengths of the statistics' charts by simulation, beside the published ones: Markdown for docs/loop.md.

    .venv/bin/python benchmarks/run_lengths.py [counts]

The charts are the service's own code. A run length is how many values it takes until a chart signals.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from statistics import fmean, stdev

import numpy as np

from inspector.judge.spc import counts, runs
from inspector.judge.spc.baseline import CountBaseline
from inspector.judge.spc.charts import Cusum, Ewma
from inspector.judge.spc.settings import StatisticsSettings

RUNS = 2000
"""Of each row of published lengths; a standard error of about 2 %."""
COUNT_RUNS = 200
LONGEST = 30_000
"""A run is given up here; the mean is then a lower bound, and marked."""
AREA_M2 = 1.0

Signal = Callable[[float], bool]


def cusum_signal(limit: float, head_start: float) -> Signal:
    cusum = Cusum(head_start, head_start)

    def is_out(z: float) -> bool:
        cusum.step(z, 0.5, limit)
        return max(cusum.above, cusum.below) > limit

    return is_out


def ewma_signal(weight: float, width: float) -> Signal:
    ewma, limit = Ewma(), Ewma(steps=10**6).limit(weight, width)

    def is_out(z: float) -> bool:
        ewma.step(z, weight)
        return abs(ewma.value) > limit

    return is_out


def runs_signal(*rules: int) -> Signal:
    seen: list[float] = []

    def is_out(z: float) -> bool:
        seen.append(z)
        del seen[: -runs.LONGEST]
        return runs.broken(seen, rules) > 0

    return is_out


def count_signals(mean: float, settings: StatisticsSettings) -> dict[str, Signal]:
    """The charts of counts with the settings' limits, the rate known."""
    base = CountBaseline(mean / AREA_M2)
    limits = counts.limits(mean, 1.0, settings.limits, settings.tail)
    cusum, ewma = Cusum(), Ewma()

    def cusum_out(count: float) -> bool:
        cusum.step(base.score(int(count), AREA_M2), settings.cusum_reference, settings.cusum_limit)
        return max(cusum.above, cusum.below) > settings.cusum_limit

    def ewma_out(count: float) -> bool:
        ewma.step(base.score(int(count), AREA_M2), settings.ewma_weight)
        return abs(ewma.value) > ewma.limit(settings.ewma_weight, settings.ewma_width)

    def count_out(count: float) -> bool:
        return not limits.lower <= count <= limits.upper

    return {"u": count_out, "EWMA": ewma_out, "CUSUM": cusum_out}


def run_length(signal: Signal, draw: Callable[[], np.ndarray]) -> int:
    """Values until the signal; they are drawn in blocks."""
    length = 0
    while length < LONGEST:
        for value in draw().tolist():
            length += 1
            if signal(value):
                return length
    return LONGEST


def mean_length(lengths: Sequence[int]) -> str:
    """Mean and its standard error; a mean with runs that were given up is a lower bound."""
    mark = ">" if LONGEST in lengths else ""
    digits = 2 if fmean(lengths) < 100 else 0
    return f"{mark}{fmean(lengths):.{digits}f} ± {stdev(lengths) / math.sqrt(len(lengths)):.{digits}f}"


# Lucas and Crosier 1982, table 1: two-sided CUSUM, k = 0.5, h = 4, without and with h/2 to begin; shift and run length.
# Lucas and Saccucci 1990, as in Montgomery's table 9.11: weight 0.1, width 2.814, limits constant.
# Champ and Woodall, Technometrics 29 (1987) 393-399: Shewhart charts with one more rule, no shift.
LUCAS_CROSIER = {0: 168, 0.5: 26.6, 1: 8.38, 2: 3.34}, {0: 149, 0.5: 20.1, 1: 5.29, 2: 2.01}
LUCAS_SACCUCCI = {0: 500, 0.5: 31.3, 1: 10.3, 2: 4.4}
PUBLISHED: list[tuple[str, Callable[[], Signal], dict[float, float]]] = [
    ("CUSUM k 0.5, h 4 (Lucas and Crosier 1982)", lambda: cusum_signal(4, 0), LUCAS_CROSIER[0]),
    ("the same, head start h/2", lambda: cusum_signal(4, 2), LUCAS_CROSIER[1]),
    ("EWMA 0.1, L 2.814 (Lucas and Saccucci 1990)", lambda: ewma_signal(0.1, 2.814), LUCAS_SACCUCCI),
    ("run rule 1 (Champ and Woodall 1987)", lambda: runs_signal(1), {0: 370.40}),
    ("run rules 1 and 5", lambda: runs_signal(1, 5), {0: 225.44}),
    ("run rules 1 and 6", lambda: runs_signal(1, 6), {0: 166.05}),
]
"""Charts with their published run lengths by shift; the tests hold the service's charts to them too."""


def published() -> None:
    print("| chart | shift, sigma | published | simulated |\n| --- | --- | --- | --- |")
    for seed, (name, signal, lengths) in enumerate(PUBLISHED):
        for shift, length in lengths.items():
            draw = np.random.default_rng((seed, int(10 * shift)))
            found = [run_length(signal(), lambda d=draw, s=shift: d.normal(s, 1, 64)) for _ in range(RUNS)]
            print(f"| {name} | {shift:g} | {length:g} | {mean_length(found)} |", flush=True)


def of_counts() -> None:
    settings = StatisticsSettings()
    print("\n| seeds a panel | rate | u-chart | EWMA | CUSUM |\n| --- | --- | --- | --- | --- |")
    for mean in (0.5, 2.0, 8.0):
        for factor in (1.0, 1.5, 2.0, 3.0):
            cells = []
            for n, name in enumerate(count_signals(mean, settings)):
                draw = np.random.default_rng((n, int(100 * mean), int(100 * factor)))
                found = [
                    run_length(count_signals(mean, settings)[name], lambda d=draw, m=mean * factor: d.poisson(m, 64))
                    for _ in range(COUNT_RUNS)
                ]
                cells.append(mean_length(found))
            print(f"| {mean:g} | {factor:g} times | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    if "counts" not in sys.argv[1:]:
        published()
    of_counts()
