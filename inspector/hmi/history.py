"""Results as the page has seen them, the last ones. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from inspector.model import Reason, Verdict
from inspector.publish.registers import Status

KEPT = 100


@dataclass(frozen=True, slots=True)
class Seen:
    """One result. ``unseen``: results between this one and the one before it that the page did not see."""

    sequence: int
    at_s: float
    """Unix time of the result, seconds."""
    verdict: Verdict
    reasons: Reason
    seeds: int
    largest_um: float | None
    panel_id: int
    recipe_id: int
    unseen: int = 0
    simulated: bool = False


def result_of(block: Mapping[str, Any], now_s: float) -> Seen | None:
    """The result that a block shows; None before the first. ``now_s`` is Unix time."""
    if block["result_age_ms"] is None:
        return None
    status = Status(int(block["status"]))
    valid = Status.RESULTS_VALID in status and Status.FAULT not in status
    return Seen(
        int(block["sequence_u32"]),
        now_s - block["result_age_ms"] / 1000,
        Verdict(block["verdict"]) if valid and block["verdict"] in tuple(Verdict) else Verdict.NOT_INSPECTED,
        Reason(int(block["reasons"]) | int(block["reasons_high"]) << 16),
        int(block["defect_count"] or 0),
        block["largest_height_um"],
        int(block["panel_id"]),
        int(block["recipe_id"]),
        simulated=Status.SIMULATED in status,
    )


def after(kept: tuple[Seen, ...], seen: Seen | None) -> tuple[Seen, ...]:
    """The history, newest first, with a result in it. One that is known stays as it was first seen; a sequence that is
    lower than the last is a station that began anew."""
    if seen is None or (kept and kept[0].sequence == seen.sequence):
        return kept
    gap = seen.sequence - kept[0].sequence - 1 if kept else 0
    if gap > 0:
        seen = Seen(**({name: getattr(seen, name) for name in Seen.__slots__} | {"unseen": gap}))
    return (seen, *kept)[:KEPT]
