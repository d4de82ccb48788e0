"""What `inspector replay` prints: a table for people, JSON for programs."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict

from inspector.replay.tally import Difference, Tally, heights


def as_json(counted: Tally) -> str:
    """The tally, with how heights moved in the seeds' place."""
    said = counted.as_json()
    del said["seeds"]
    said["heights"] = asdict(heights(counted))
    return json.dumps(said, indent=1, allow_nan=False)


def as_table(counted: Tally) -> str:
    """The tally in lines."""
    return "\n".join([*_counts(counted), *_differences(counted), *_heights(counted), *_not_compared(counted)])


FORMATS = {"table": as_table, "json": as_json}


def _counts(counted: Tally) -> Iterator[str]:
    for what, all_, alike in (
        ("frames", counted.frames, counted.frames_same),
        ("panels of several frames", counted.panels, counted.panels_same),
    ):
        if all_ or what == "frames":
            yield f"{all_} {what} compared: {alike} the same to the last bit, {all_ - alike} differ"
    if counted.not_compared:
        yield f"not compared: {len(counted.not_compared)}, listed below"


def _differences(counted: Tally) -> Iterator[str]:
    flipped = [d for d in counted.differences if d.flipped]
    others = [d for d in counted.differences if not d.flipped]
    yield f"verdicts changed: {len(flipped)}"
    yield from map(_difference, flipped)
    if others:
        yield f"verdict kept, something else changed: {len(others)}"
        yield from map(_difference, others)


def _difference(one: Difference) -> str:
    of = "" if one.panel_id is None else f"  panel {one.panel_id}"
    whose = "" if one.what == "frame" else "  the panel's"
    verdict = f"{one.then} -> {one.now}" if one.flipped else one.now
    why = one.why_now or "no reason against it"
    was = f" (was: {one.why_then})" if one.why_then and one.why_then != one.why_now else ""
    return f"  {one.where}{of}{whose}  {verdict}: {why}{was}"


def _heights(counted: Tally) -> Iterator[str]:
    if not counted.seeds:
        return
    moved = heights(counted)
    told = f"heights: {moved.matched} seeds found both times, {moved.gained} gained, {moved.lost} lost"
    if moved.mean_um is not None and moved.largest_um is not None:
        told += f"; moved by {moved.mean_um:+.1f} um (sd {moved.sd_um:.1f}), at most {moved.largest_um:+.1f} um"
        told += f" in {moved.largest_in}" if moved.largest_um else ""
    yield told


def _not_compared(counted: Tally) -> Iterator[str]:
    """What could not be compared; those with the same reason together."""
    alike: dict[str, list[str]] = {}
    for one in counted.not_compared:
        alike.setdefault(one.why, []).append(one.where)
    for why, where in alike.items():
        yield f"not compared ({len(where)}): {why}"
        yield from (f"  {name}" for name in where)
