"""Results as JSON and back, to the last bit: numbers keep every digit, and what is no number is written as a text.

This is the archive's form. What `inspector inspect` prints is rounded for people (:mod:`inspector.result_text`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from inspector.model import Defect, Extent, Flag, FrameResult, PanelResult, PanelSpot, Reason, Unpaired, Verdict

Said = dict[str, Any]


class ResultWrong(ValueError):
    """This is no result of the archive's; the text says what is missing or wrong."""


def of_frame(result: FrameResult) -> Said:
    """A frame's result; neither its name, which belongs to the file, nor its time, which is no part of what it says."""
    return _judged(result) | {"unpaired": [_spot(spot) for spot in result.unpaired]}


def to_frame(said: Mapping[str, Any], name: str) -> FrameResult:
    """The frame's result, under this name. Raises ResultWrong."""
    try:
        unpaired = tuple(Unpaired(*_xy(spot), Flag(spot["flags"])) for spot in said["unpaired"])
        return FrameResult(name, **_to_judged(said), unpaired=unpaired)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ResultWrong(f"no result of a frame: {type(error).__name__} {error}") from error


def of_panel(result: PanelResult) -> Said:
    """A panel's result, but for the time it took."""
    spots = [_spot(spot) | {"x_mm": _number(spot.x_mm), "y_mm": _number(spot.y_mm)} for spot in result.unpaired]
    extent = result.extent
    seen = {"area_m2": extent.area_m2, "bounds_mm": list(extent.bounds_mm), "rim_mm": extent.rim_mm}
    more: Said = {"unpaired": spots, "panel_id": result.panel_id, "travels_mm": list(result.travels_mm), "extent": seen}
    return _judged(result) | more


def to_panel(said: Mapping[str, Any]) -> PanelResult:
    """The panel's result. Raises ResultWrong."""
    try:
        spots = (PanelSpot(*_xy(s), Flag(s["flags"]), float(s["x_mm"]), float(s["y_mm"])) for s in said["unpaired"])
        seen = said["extent"]
        extent = Extent(seen["area_m2"], tuple(seen["bounds_mm"]), seen["rim_mm"])
        return PanelResult(
            **_to_judged(said),
            unpaired=tuple(spots),
            panel_id=said["panel_id"],
            travels_mm=tuple(said["travels_mm"]),
            extent=extent,
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ResultWrong(f"no result of a panel: {type(error).__name__} {error}") from error


def same(one: FrameResult | PanelResult, other: FrameResult | PanelResult) -> bool:
    """Whether two results say the same, to the last bit; a height that is no number equals another such."""
    return type(one) is type(other) and _of_any(one) == _of_any(other)


def _of_any(result: FrameResult | PanelResult) -> Said:
    return of_frame(result) if isinstance(result, FrameResult) else of_panel(result)


def _judged(result: FrameResult | PanelResult) -> Said:
    return {
        "verdict": result.verdict.name,
        "reasons": int(result.reasons),
        "reasons_text": list(result.reasons_text),
        "defects": [_defect(defect) for defect in result.defects],
    }


def _to_judged(said: Mapping[str, Any]) -> Said:
    return {
        "verdict": Verdict[said["verdict"]],
        "reasons": Reason(said["reasons"]),
        "reasons_text": tuple(said["reasons_text"]),
        "defects": tuple(_to_defect(defect) for defect in said["defects"]),
    }


_DEFECT_NUMBERS = tuple(f.name for f in fields(Defect) if f.name not in ("direct_px", "mirror_px", "flags"))


def _defect(defect: Defect) -> Said:
    said: Said = {name: _number(getattr(defect, name)) for name in _DEFECT_NUMBERS}
    pixels = {name: [_number(v) for v in getattr(defect, name)] for name in ("direct_px", "mirror_px")}
    return said | pixels | {"flags": int(defect.flags)}


def _to_defect(said: Mapping[str, Any]) -> Defect:
    numbers: Said = {name: None if said[name] is None else float(said[name]) for name in _DEFECT_NUMBERS}
    (dx, dy), (mx, my) = said["direct_px"], said["mirror_px"]
    direct, mirror = (float(dx), float(dy)), (float(mx), float(my))
    return Defect(**numbers, direct_px=direct, mirror_px=mirror, flags=Flag(said["flags"]))


def _spot(spot: Unpaired) -> Said:
    return {"x_px": _number(spot.x_px), "y_px": _number(spot.y_px), "flags": int(spot.flags)}


def _xy(said: Mapping[str, Any]) -> tuple[float, float]:
    return float(said["x_px"]), float(said["y_px"])


def _number(value: float | None) -> float | str | None:
    """The number; as the text that ``float`` takes where JSON has no word for it."""
    return value if value is None or math.isfinite(value) else str(float(value))
