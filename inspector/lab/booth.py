"""A simulated paint booth: how dirty its panels are, and what maintenance does to that. Pure; one seed, one history.

A panel's seeds have three sources. *Air*: dust through the filter, at random places; its rate grows with the square of
the filter's load, and by a step when a filter tears. *Walls*: overspray that flakes off, in clusters, the more the
longer the booth was not cleaned. *Fixture*: a dirty hanger that drips at one place on every other panel. On top, the
rate of air wanders with the weather, and now and then dust comes from outside for a while, which no maintenance helps.

The numbers are round and of the trade's order of size, not measured in any one plant: a filter lasts some 1,500 panels,
a booth is cleaned about as often. Maintenance is done some panels after it is asked for, and does not always help.
"""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass, field

import numpy as np

from inspector.model import FloatArray


class Deed(enum.Enum):
    """What a crew can do to the booth."""

    CHANGE_FILTER = "change the filter"
    CLEAN_BOOTH = "clean the booth"
    CLEAN_FIXTURE = "clean the fixtures"


@dataclass(frozen=True, slots=True)
class BoothSettings:
    """The booth's make. Rates are per panel."""

    width_mm: float = 600.0
    height_mm: float = 400.0
    air_seeds: float = 2.0
    """Seeds of a panel through a new filter."""
    filter_life: float = 1500.0
    """Panels after which a filter is fully loaded; seeds through it are then (1 + filter_growth) times as many."""
    filter_growth: float = 3.0
    tear_rate: float = 1 / 4000
    tear_seeds: float = 5.0
    """More seeds a panel through a torn filter."""
    wall_life: float = 1500.0
    """Panels after which walls shed as much as they ever do."""
    wall_flakes: float = 0.5
    """Flakes a panel then; each is a cluster of about four seeds within flake_mm."""
    flake_mm: float = 25.0
    fixture_rate: float = 1 / 1500
    fixture_panels: float = 400.0
    """A dirty fixture frees itself after so many panels on average."""
    outside_rate: float = 1 / 3000
    outside_panels: int = 60
    outside_factor: float = 1.8
    weather_sd: float = 0.08
    """Standard deviation of the logarithm of the rate of air, as it wanders."""
    weather_panels: float = 50.0
    """It forgets itself in so many panels."""
    crew_panels: int = 20
    """Panels from the order to the deed."""
    success: float = 0.9
    """How often a deed does what it should."""
    height_um: float = 300.0
    """Median height of seeds; logarithms have a standard deviation of 0.4."""

    @property
    def area_m2(self) -> float:
        """Of a panel, square metres."""
        return self.width_mm * self.height_mm / 1e6


@dataclass(frozen=True, slots=True)
class PaintedPanel:
    """The seeds of one panel: (n,) heights, um, and (n, 2) places, mm from its corner."""

    heights_um: FloatArray
    places_mm: FloatArray

    def __len__(self) -> int:
        return len(self.heights_um)


@dataclass(slots=True)
class Condition:
    """How the booth stands: what no station sees."""

    filter_load: float = 0.0
    torn: bool = False
    walls: float = 0.0
    drip_mm: tuple[float, float] | None = None
    weather: float = 0.0
    outside: int = 0
    orders: dict[Deed, int] = field(default_factory=dict)
    """Deeds that were ordered, and in how many panels each is done."""


class Booth:
    """Paints panels one by one. ``seed`` gives its history; the same orders then give the same panels."""

    def __init__(self, seed: int, settings: BoothSettings | None = None) -> None:
        self.settings = settings or BoothSettings()
        self.condition = Condition()
        self.deeds: list[tuple[int, Deed]] = []
        """What was done, and after how many panels."""
        self._painted = 0
        # One stream for what befalls the booth, one for what lands on a panel: orders do not change the weather.
        self._fate, self._dust = (np.random.default_rng((seed, stream)) for stream in (0, 1))

    def order(self, deed: Deed) -> None:
        """Have something done; what is ordered already is not ordered twice."""
        self.condition.orders.setdefault(deed, self.settings.crew_panels)

    def paint(self) -> PaintedPanel:
        """The next panel."""
        self._befall()
        self._work()
        self._painted += 1
        places = np.concatenate([self._air(), self._flakes(), self._drip()])
        heights = self.settings.height_um * np.exp(self._dust.normal(0.0, 0.4, len(places)))
        return PaintedPanel(heights, places)

    @property
    def expected_seeds(self) -> float:
        """Mean number of seeds of a panel in this condition."""
        drip = 0.5 if self.condition.drip_mm else 0.0
        return self._air_rate() + 4.0 * self.settings.wall_flakes * self.condition.walls + drip

    def _befall(self) -> None:
        """A panel's worth of wear and luck. Always the same number of draws, whatever the condition."""
        s, c = self.settings, self.condition
        wear, tear, dirt, drips, frees, wind = self._fate.random(6)
        where, gust = self._fate.random(2), self._fate.normal()
        c.filter_load = min(1.0, c.filter_load + 2.0 * wear / s.filter_life)
        c.torn = c.torn or tear < s.tear_rate
        c.walls = min(1.0, c.walls + 2.0 * dirt / s.wall_life)
        if c.drip_mm is None and drips < s.fixture_rate:
            c.drip_mm = (where[0] * s.width_mm, where[1] * s.height_mm)
        elif c.drip_mm is not None and frees < 1.0 / s.fixture_panels:
            c.drip_mm = None
        memory = math.exp(-1.0 / s.weather_panels)
        c.weather = memory * c.weather + s.weather_sd * math.sqrt(1.0 - memory**2) * gust
        c.outside = s.outside_panels if wind < s.outside_rate else max(0, c.outside - 1)

    def _work(self) -> None:
        """The crew comes nearer, and does what is due."""
        c = self.condition
        for deed in list(c.orders):
            c.orders[deed] -= 1
            if c.orders[deed] <= 0:
                del c.orders[deed]
                self.deeds.append((self._painted, deed))
                if self._dust.random() < self.settings.success:
                    self._do(deed)

    def _do(self, deed: Deed) -> None:
        c = self.condition
        match deed:
            case Deed.CHANGE_FILTER:
                c.filter_load, c.torn = 0.0, False
            case Deed.CLEAN_BOOTH:
                c.walls = 0.0
            case Deed.CLEAN_FIXTURE:
                c.drip_mm = None

    def _air_rate(self) -> float:
        s, c = self.settings, self.condition
        loaded = s.air_seeds * (1.0 + s.filter_growth * c.filter_load**2) + (s.tear_seeds if c.torn else 0.0)
        return loaded * math.exp(c.weather) * (s.outside_factor if c.outside else 1.0)

    def _air(self) -> FloatArray:
        count = self._dust.poisson(self._air_rate())
        return self._dust.random((count, 2)) * (self.settings.width_mm, self.settings.height_mm)

    def _flakes(self) -> FloatArray:
        s = self.settings
        flakes = self._dust.poisson(s.wall_flakes * self.condition.walls)
        clusters = [np.empty((0, 2))]
        for _ in range(flakes):
            centre = self._dust.random(2) * (s.width_mm - s.flake_mm, s.height_mm - s.flake_mm)
            clusters.append(centre + self._dust.random((self._dust.poisson(4.0), 2)) * s.flake_mm)
        return np.concatenate(clusters)

    def _drip(self) -> FloatArray:
        drip = self.condition.drip_mm
        if drip is None or self._dust.random() < 0.5:
            return np.empty((0, 2))
        s = self.settings
        place = np.asarray(drip) + self._dust.normal(0.0, 3.0, 2)
        return np.clip(place, (0.0, 0.0), (s.width_mm, s.height_mm))[None, :]
