"""The report on a shift, or any stretch of time: how many passed, defects over panels, heights, faults, actions."""

from __future__ import annotations

import json
import math
import sqlite3
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice, repeat

from inspector.archive_reading import charts, columns, queries
from inspector.archive_reading.charts import Block
from inspector.archive_reading.control_limits import COLUMNS, Charted, charted
from inspector.archive_reading.document import Document, Picture, Section, Table
from inspector.archive_reading.kept import KeptResult, kept
from inspector.archive_reading.panel_report import drawn, local, missing
from inspector.archive_reading.selection import Selection
from inspector.archive_reading.store_reader import StoreReader
from inspector.model import Verdict

MOST_BLOCKS, MOST_CHARTED, MOST_BARS = 160, 5000, 40
"""Bars of the chart; panels whose control limits are computed; bars of the histogram."""
MOST_FAILING, MOST_LISTED = 24, 200
"""Failing panels with a picture; faults and actions that are listed."""


@dataclass(frozen=True, slots=True)
class Period:
    """What is reported on: the store, and which results."""

    store: StoreReader
    wanted: Selection

    def sql(self, select: str, after: str = "") -> tuple[str, list[float | int]]:
        """A query over the period's results ``r``."""
        bounds = [
            ("r.at_s >= ?", self.wanted.begins_s),
            ("r.at_s < ?", self.wanted.ends_s),
            ("r.sequence >= ?", self.wanted.first),
            ("r.sequence <= ?", self.wanted.last),
        ]
        where = " AND ".join(condition for condition, value in bounds if value is not None) or "1"
        values = [value for _, value in bounds if value is not None]
        return select.replace("{where}", where) + f" {after}", values

    def rows(self, select: str, after: str = "") -> Iterator[sqlite3.Row]:
        """The rows of such a query."""
        return self.store.rows(*self.sql(select, after))


def page(store: StoreReader, wanted: Selection, title: str) -> Document:
    """The report. Raises ArchiveUnreadable, Unusable."""
    period = Period(store, wanted)
    totals = {Verdict(v): n for v, n in period.rows("SELECT verdict, count(*) FROM result r WHERE {where} GROUP BY 1")}
    ends = next(period.rows("SELECT min(at_s), max(at_s), min(sequence), max(sequence) FROM result r WHERE {where}"))
    if not totals:
        return Document(title, _lead(wanted, ends), "", [Section("Totals", paragraphs=["No result was kept in it."])])
    sections = [_totals(period, totals), _defects(period, sum(totals.values())), _heights(period), _recipes(period)]
    sections += [_faults(period, ends), _actions(period, ends), *_failing(period)]
    return Document(title, _lead(wanted, ends), "", sections)


def _lead(wanted: Selection, ends: sqlite3.Row) -> str:
    begin, end = local(wanted.begins_s or ends[0]), local(wanted.ends_s or ends[1])
    sequences = f", results {ends[2]} to {ends[3]}" if ends[2] is not None else ""
    return f"{begin or 'the beginning'} to {end or 'now'}{sequences}"


def _totals(period: Period, totals: dict[Verdict, int]) -> Section:
    count = sum(totals.values())
    judged = totals.get(Verdict.PASS, 0) + totals.get(Verdict.FAIL, 0)
    facts = [("results", str(count))]
    facts += [(verdict.name, f"{totals.get(verdict, 0)} ({totals.get(verdict, 0) / count:.1%})") for verdict in ORDER]
    facts.append(("passed of those judged", f"{totals.get(Verdict.PASS, 0) / judged:.1%}" if judged else "-"))
    select = "SELECT sum(defect_count), max(largest_height_um), avg(cycle_us) FROM result r WHERE {where}"
    seeds, highest, cycle_us = next(period.rows(select))
    facts.append(("seeds", f"{seeds}, {seeds / count:.2f} a panel"))
    facts.append(("highest seed", "-" if highest is None else f"{highest:.0f} um"))
    facts.append(("mean cycle", f"{cycle_us / 1000:.1f} ms"))
    hours = "SELECT min(burnt_hours), max(burnt_hours) FROM lamp WHERE at_s >= ? AND at_s <= ?"
    ends = next(period.rows("SELECT min(at_s), max(at_s) FROM result r WHERE {where}"))
    burnt = period.store.row(hours, (ends[0] - 3600, ends[1] + 1))
    known = burnt is not None and burnt[1] is not None
    facts.append(("lamp hours", f"{burnt[1]:.1f} h" if known and burnt is not None else "not counted"))
    return Section("Totals", facts)


NOT_CHARTED = Charted(None, "")
ORDER = (Verdict.PASS, Verdict.FAIL, Verdict.NOT_INSPECTED)


def _defects(period: Period, count: int) -> Section:
    """The chart of defects per panel, with limits and alarms where there are not too many panels for these."""
    each = math.ceil(count / MOST_BLOCKS)
    select = f"SELECT {COLUMNS}, r.sequence, r.defect_count FROM result r WHERE {{where}} ORDER BY id"
    limits = charted(period.store, period.rows(select)) if count <= MOST_CHARTED else repeat(NOT_CHARTED)
    found = zip(period.rows(select), limits, strict=False)  # the second may go on for ever
    blocks, alarms = list[Block](), list[list[str]]()
    while some := list(islice(found, each)):
        blocks.append(_block(some))
        alarms += [[local(r["at_s"]), str(r["sequence"]), said.alarm] for r, said in some if said.alarm]
    texts = ["Limits and alarms are computed from this period's results alone, by the statistics' settings of then."]
    if count > MOST_CHARTED:
        texts = [f"Limits and alarms are not computed for more than {MOST_CHARTED} panels: ask for a shorter time."]
    elif not alarms:
        texts.append("No alarm.")
    tables = [Table(["alarm began", "result", "what"], alarms[:MOST_LISTED])] if alarms else []
    return Section("Defects per panel", (), texts, tables, [Picture(charts.counts(blocks, each))])


def _block(some: Sequence[tuple[sqlite3.Row, Charted]]) -> Block:
    found = [row["defect_count"] for row, _ in some]
    limits = [said.upper for _, said in some if said.upper is not None]
    alarms = [said.alarm for _, said in some if said.alarm]
    return Block(
        sum(found) / len(found), max(found), min(limits, default=None), alarms, local(some[0][0]["at_s"])[11:19]
    )


def _heights(period: Period) -> Section:
    of = "FROM defect d JOIN result r ON r.id = d.result WHERE {where} AND d.height_um < 1e9 AND d.height_um >= 0"
    known, most = next(period.rows(f"SELECT count(*), max(d.height_um) {of}"))
    if not known:
        return Section("Heights", paragraphs=["No seed has a height."])
    step = charts.step_of(most, MOST_BARS)
    numbers = [0] * (int(most / step) + 1)
    for bar, number in period.rows(
        f"SELECT CAST(d.height_um / {step!r} AS INTEGER) AS bar, count(*) {of}", "GROUP BY 1"
    ):
        numbers[min(bar, len(numbers) - 1)] += number
    last = next(period.rows("SELECT * FROM result r WHERE {where} ORDER BY id DESC LIMIT 1"))
    version = kept(period.store, last).version
    limit_um = version.recipe.limits.max_height_um if version else None
    caption = f"{known} seeds with a height, by {step:g} um; the limit is the last result's recipe's"
    return Section("Heights", pictures=[Picture(charts.histogram(numbers, step, limit_um), caption)])


def _recipes(period: Period) -> Section:
    select = (
        "SELECT r.recipe_id, v.name, r.recipe, r.settings, count(*), sum(r.verdict = 1), sum(r.verdict = 2), "
        "sum(r.verdict = 0), min(r.sequence), max(r.sequence) FROM result r LEFT JOIN recipe_version v "
        "ON v.hash = r.recipe WHERE {where} GROUP BY 1, 2, 3, 4 ORDER BY min(r.id)"
    )
    rows = [["" if value is None else str(value) for value in row] for row in period.rows(select)]
    header = ["id", "recipe", "hash", "settings", "results", "PASS", "FAIL", "NOT INSPECTED", "first", "last"]
    return Section("Recipes used", tables=[Table(header, rows)])


def _between(period: Period, ends: sqlite3.Row) -> Selection:
    """The period in times, for what has no sequence."""
    begin = ends[0] if period.wanted.begins_s is None else period.wanted.begins_s
    end = ends[1] + 1 if period.wanted.ends_s is None else period.wanted.ends_s
    return Selection(begin, end)


def _faults(period: Period, ends: sqlite3.Row) -> Section:
    rows = list(period.store.rows(*queries.query(columns.FAULTS, _between(period, ends))))
    lines = [
        [
            local(row["began"]),
            str(row["code"]),
            columns.meaning(row["code"]) or "",
            "lasts, or ended with its run" if row["duration_s"] is None else f"{row['duration_s']:.1f} s",
        ]
        for row in rows[:MOST_LISTED]
    ]
    if not lines:
        return Section("Faults", paragraphs=["None."])
    table = Table(["began", "code", "meaning", "duration"], lines)
    return Section("Faults", (("faults", str(len(rows))), ("in all", _in_all(rows))), _more(rows), [table])


def _in_all(rows: Sequence[sqlite3.Row]) -> str:
    return f"{sum(row['duration_s'] or 0.0 for row in rows):.1f} s"


def _actions(period: Period, ends: sqlite3.Row) -> Section:
    rows = list(period.store.rows(*queries.query(columns.ACTIONS, _between(period, ends))))
    lines = [[local(row["at"]), row["who"], row["what"], row["detail"]] for row in rows[:MOST_LISTED]]
    if not lines:
        return Section("Actions", paragraphs=["None."])
    return Section("Actions", (), _more(rows), [Table(["when", "who", "what", "detail"], lines)])


def _more(rows: Sequence[object]) -> list[str]:
    return [f"The first {MOST_LISTED} of {len(rows)} (inspector export has all)."] if len(rows) > MOST_LISTED else []


def _failing(period: Period) -> Iterator[Section]:
    """The last failing panels, with small pictures."""
    count = next(period.rows("SELECT count(*) FROM result r WHERE {where} AND verdict = 2"))[0]
    if not count:
        yield Section("Failing panels", paragraphs=["None."])
        return
    select = f"SELECT * FROM result r WHERE {{where}} AND verdict = 2 ORDER BY id DESC LIMIT {MOST_FAILING}"
    found = [kept(period.store, row) for row in period.rows(select)]
    text = f"The last {len(found)} of {count}." if count > len(found) else f"All {count}, the latest first."
    yield Section("Failing panels", paragraphs=[text], pictures=[_thumbnail(one) for one in found])


def _thumbnail(found: KeptResult) -> Picture:
    row = found.row
    panel = f", panel {row['panel_id']}" if row["panel_id"] else ""
    caption = f"Result {row['sequence']}{panel}, {local(row['at_s'])[11:19]}: {_first_reason(row)}"
    pictures = [(frame, drawn(frame, small=True)) for frame in found.frames[:1]]
    if not pictures:
        return Picture('<p class="gone">No frame was taken.</p>', caption, narrow=True)
    frame, markup = pictures[0]
    return Picture(markup or f'<p class="gone">{missing(frame)}</p>', caption, narrow=True)


def _first_reason(row: sqlite3.Row) -> str:
    reasons = json.loads(row["reasons_text"])
    return str(reasons[0]) if reasons else ""
