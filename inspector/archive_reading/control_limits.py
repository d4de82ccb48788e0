"""Control limits and alarms of results in the archive: the paint line's statistics fed with them again, in order."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from inspector.archive_reading.kept import defects_of, version_of
from inspector.archive_reading.store_reader import StoreReader
from inspector.judge.spc.monitor import Monitor
from inspector.judge.spc.settings import StatisticsSettings
from inspector.line_statistics import Rule
from inspector.model import Extent, Snapshot, Verdict
from inspector.reinspection import Reinspection
from inspector.service.line_history import extent_of, panel_of
from inspector.settings_version import VersionWrong

COLUMNS = "r.id, r.at_s, r.recipe_id, r.verdict, r.settings, r.frame_count"
"""What the rows must have."""


@dataclass(frozen=True, slots=True)
class Charted:
    """Of one result: the upper control limit of its count (None: not known yet), and the alarm that began with it."""

    upper: float | None
    alarm: str


def charted(store: StoreReader, rows: Iterable[sqlite3.Row]) -> Iterator[Charted]:
    """The limits of each of these results in turn. Raises ArchiveUnreadable."""
    monitor, rule, stations = Monitor(StatisticsSettings()), Rule.NONE, dict[str, _Station]()
    for row in rows:
        name = row["settings"]
        station = stations[name] = stations.get(name) or _station(store, name)
        extent = station.extent(store, row)
        monitor.settings = station.statistics
        shown = Snapshot(
            recipe_id=row["recipe_id"],
            verdict=Verdict(row["verdict"]),
            defects=defects_of(store, row["id"]),
            extent=extent,
            result_at_s=row["at_s"],
        )
        said = monitor.add(panel_of(shown, extent))
        began = said.alarm_text if said.rule is not rule else ""
        rule = said.rule
        yield Charted(None if said.upper_per_m2 is None else said.upper_per_m2 * extent.area_m2, began)


@dataclass(frozen=True)
class _Station:
    """What one version of the settings says: of the statistics, and of what frames see."""

    statistics: StatisticsSettings
    one_frame: Extent
    again: Reinspection | None

    def extent(self, store: StoreReader, row: sqlite3.Row) -> Extent:
        """What was seen of a result's panel; of no area where that is not known."""
        view = self.again.panel_station.view if self.again and row["frame_count"] > 1 else None
        if view is None:
            return self.one_frame
        travels_mm = [frame[0] for frame in store.rows("SELECT travel_mm FROM frame WHERE result = ?", (row["id"],))]
        return view.seen(travels_mm) if travels_mm else Extent()


def _station(store: StoreReader, name: str) -> _Station:
    try:
        again = Reinspection(version_of(store, name))
        return _Station(again.version.statistics, extent_of(again.station.calibration.camera), again)
    except VersionWrong:  # its panels are of no known area, and enter no chart
        return _Station(StatisticsSettings(), Extent(), None)
