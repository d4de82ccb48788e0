"""The loop closed over a simulated booth: panels -> statistics -> registers -> PLC program -> booth, many times over.

The PLC program is given what it would read: the statistics area, packed and decoded by the table that the server and
the integrator have. What is compared: the same booth, with the same luck, left alone; kept by a calendar; and tended by
the loop. Booth and program are handed in, so that what renders the truth stays apart from what measures it.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from statistics import fmean, stdev
from typing import Any, Protocol

import numpy as np

from inspector.judge.spc.monitor import Monitor
from inspector.judge.spc.panel import Panel
from inspector.judge.spc.settings import StatisticsSettings
from inspector.line_statistics import Statistics
from inspector.model import FloatArray
from inspector.publish.registers import decode
from inspector.publish.statistics_registers import STATISTICS_ADDRESS, STATISTICS_WORDS, Shown, encode_statistics

RECIPE_ID = 1
HEAD_WORDS = 14
"""Sequence, status, alarm, action, confidence, age, trend and spread."""
UNTENDED, LOOP = "left alone", "tended by the loop"
CALENDARS = (1500, 500)
"""Everything is done every so many panels: at the end of a filter's life, and three times as often."""
HEIGHT_SIGMA = 0.05
"""Measuring is taken as perfect here, with this share of a height as its sigma: its errors are told elsewhere."""


class Painted(Protocol):
    """A panel of the booth."""

    @property
    def heights_um(self) -> FloatArray: ...
    @property
    def places_mm(self) -> FloatArray: ...
    def __len__(self) -> int: ...


class BoothMake(Protocol):
    """Of a booth: the size of its panels."""

    @property
    def width_mm(self) -> float: ...
    @property
    def height_mm(self) -> float: ...
    @property
    def area_m2(self) -> float: ...


class TendedBooth(Protocol):
    """A booth that paints, and takes orders."""

    deeds: list[tuple[int, Any]]

    @property
    def settings(self) -> BoothMake: ...
    def paint(self) -> Painted: ...
    def order(self, deed: Any) -> None: ...


class Program(Protocol):
    """A PLC program: registers in; orders, and whether to reset the statistics."""

    def scan(self, registers: Mapping[str, Any]) -> tuple[tuple[Any, ...], bool]: ...


@dataclass(frozen=True, slots=True)
class History:
    """One run: defects of each panel, and how much the crew did."""

    defects: Sequence[int]
    deeds: int

    def settled(self, first: int) -> float:
        """Defects per panel from panel ``first`` on."""
        return fmean(self.defects[first:])


def panel_of(painted: Painted, make: BoothMake, at_s: float) -> Panel:
    """A painted panel as the station would have measured it."""
    heights = tuple(painted.heights_um.tolist())
    return Panel(
        at_s=at_s,
        recipe_id=RECIPE_ID,
        inspected=True,
        count=len(painted),
        area_m2=make.area_m2,
        heights_um=heights,
        sigmas_um=tuple(HEIGHT_SIGMA * h for h in heights),
        places_mm=tuple((x, y) for x, y in painted.places_mm.tolist()),
        bounds_mm=(0.0, 0.0, make.width_mm, make.height_mm),
    )


def read_registers(statistics: Statistics, sequence: int) -> dict[str, Any]:
    """The statistics area as a PLC reads it, just after it was published: its head, and the sequence at its end."""
    data = encode_statistics(Shown(statistics, sequence, statistics.at_s), "high_first")
    words = struct.unpack(f">{STATISTICS_WORDS}H", data)
    return decode(words[:HEAD_WORDS], STATISTICS_ADDRESS) | decode(
        words[-1:], STATISTICS_ADDRESS + STATISTICS_WORDS - 1
    )


def untended(booth: TendedBooth, panels: int) -> History:
    """Nobody looks."""
    return History([len(booth.paint()) for _ in range(panels)], len(booth.deeds))


def by_calendar(booth: TendedBooth, panels: int, every: int, deeds: Iterable[Any]) -> History:
    """Everything is done every so many panels, needed or not."""
    defects, plan = [], tuple(deeds)
    for n in range(panels):
        if n and n % every == 0:
            for deed in plan:
                booth.order(deed)
        defects.append(len(booth.paint()))
    return History(defects, len(booth.deeds))


def tended(booth: TendedBooth, program: Program, settings: StatisticsSettings, panels: int) -> History:
    """The PLC acts on what the station advises."""
    monitor, defects = Monitor(settings), []
    for n in range(panels):
        painted = booth.paint()
        defects.append(len(painted))
        statistics = monitor.add(panel_of(painted, booth.settings, float(n)))
        deeds, reset = program.scan(read_registers(statistics, n + 1))
        for deed in deeds:
            booth.order(deed)
        if reset:
            monitor.reset()
    return History(defects, len(booth.deeds))


@dataclass(frozen=True)
class Comparison:
    """Runs of the same seeds in each way, by the way's name."""

    panels: int
    settled_from: int
    runs: dict[str, list[History]]

    def rates(self, way: str) -> list[float]:
        """Settled defects per panel of each seed."""
        return [run.settled(self.settled_from) for run in self.runs[way]]

    def saved(self, way: str, than: str) -> list[float]:
        """By what share the settled rate of each seed is below the other way's."""
        pairs = zip(self.rates(way), self.rates(than), strict=True)
        return [1.0 - mine / other for mine, other in pairs]

    def table(self) -> str:
        """Markdown: settled rate, its spread over the seeds, and how much the crew did."""
        lines = [
            "| booth | defects per panel, mean | sd | 5 % to 95 % of seeds | deeds per 1000 panels |",
            "| --- | --- | --- | --- | --- |",
        ]
        for way, runs in self.runs.items():
            rates = self.rates(way)
            low, high = np.quantile(rates, [0.05, 0.95])
            deeds = fmean(run.deeds for run in runs) / self.panels * 1000
            spread = stdev(rates) if len(rates) > 1 else 0.0
            lines.append(f"| {way} | {fmean(rates):.2f} | {spread:.2f} | {low:.2f} to {high:.2f} | {deeds:.1f} |")
        return "\n".join(lines) + "\n"

    def sentence(self) -> str:
        """How much the loop saves, with its spread over the seeds."""
        saved = self.saved(LOOP, UNTENDED)
        spread = stdev(saved) if len(saved) > 1 else 0.0
        return (
            f"With the loop the settled rate is {fmean(saved):.1%} below the untended booth's "
            f"(sd {spread:.1%}, least {min(saved):.1%}, most {max(saved):.1%} of {len(saved)} seeds)."
        )

    def in_blocks(self, way: str, block: int) -> FloatArray:
        """(blocks, 3): mean over seeds of defects per panel in blocks of panels, and their 10 % and 90 % quantiles."""
        whole = self.panels // block * block
        each = np.array([run.defects[:whole] for run in self.runs[way]], dtype=float)
        blocks = each.reshape(len(each), -1, block).mean(axis=2)
        return np.stack([blocks.mean(axis=0), *np.quantile(blocks, [0.1, 0.9], axis=0)], axis=1)


def _by_calendar(
    booth: Callable[[int], TendedBooth], panels: int, every: int, deeds: Sequence[Any], seed: int
) -> History:
    return by_calendar(booth(seed), panels, every, deeds)


def compare(ways: Mapping[str, Callable[[int], History]], seeds: int, panels: int, settled_from: int) -> Comparison:
    """Each way of keeping a booth, over the same seeds."""
    runs = {way: [run(seed) for seed in range(seeds)] for way, run in ways.items()}
    return Comparison(panels, settled_from, runs)


def compare_keeping(
    booth: Callable[[int], TendedBooth], program: Callable[[], Program], deeds: Sequence[Any], seeds: int, panels: int
) -> Comparison:
    """A booth left alone, kept by two calendars, and tended by the loop; settled in its second half."""
    settings = StatisticsSettings()
    ways: dict[str, Callable[[int], History]] = {UNTENDED: lambda seed: untended(booth(seed), panels)}
    for every in CALENDARS:
        ways[f"everything every {every} panels"] = partial(_by_calendar, booth, panels, every, deeds)
    ways[LOOP] = lambda seed: tended(booth(seed), program(), settings, panels)
    return compare(ways, seeds, panels, panels // 2)
