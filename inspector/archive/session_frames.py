"""What a session's line says of a frame besides how it was taken: of which result it is, and what was found in it."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import Any

from firmware_bridge.wire.session import Recorded, SessionWrong
from inspector.archive import result_json
from inspector.model import FrameResult, PanelResult


class Kept(enum.StrEnum):
    """Why a frame was kept."""

    FAILING = "failing"
    """Its panel is no PASS."""
    SAMPLE = "sample"
    """One of so many that passed."""
    LAST = "last"
    """One of the last ones, whatever they say."""
    CAMPAIGN = "campaign"
    """`inspector record` was asked for it."""


@dataclass(frozen=True, slots=True)
class Inspected:
    """A recorded frame's place in the results. ``settings`` names the version by which it was inspected, the file
    ``settings-<settings>.json`` beside the index."""

    settings: str
    kept: Kept
    result: FrameResult
    sequence: int | None = None
    """The result that it is of; None: it was inspected for nobody, in a campaign."""
    panel_id: int | None = None
    number: int = 0
    """Which of its panel's frames it is, from 0."""
    travel_mm: float = 0.0
    """How far the panel had moved since its first frame."""
    panel: PanelResult | None = None
    """With a panel's last frame, where panels have several: what they say together."""
    missing: tuple[str, ...] = ()
    """With a panel's last frame: what kept it from having been seen whole."""
    frames: int = 1
    """How many frames the panel has."""

    def as_dict(self) -> dict[str, Any]:
        """As the line says it."""
        said: dict[str, Any] = {
            "settings": self.settings,
            "kept": self.kept.value,
            "sequence": self.sequence,
            "panel_id": self.panel_id,
            "number": self.number,
            "frames": self.frames,
            "travel_mm": self.travel_mm,
            "result": result_json.of_frame(self.result),
        }
        if self.panel is not None:
            said |= {"panel": result_json.of_panel(self.panel), "missing": list(self.missing)}
        return said


def inspected(recorded: Recorded) -> Inspected | None:
    """What the line of a frame says of its inspection; None if it says nothing. Raises SessionWrong."""
    said: dict[str, Any] = dict(recorded.beyond)
    if "result" not in said:
        return None
    try:
        return Inspected(
            settings=str(said["settings"]),
            kept=Kept(said["kept"]),
            result=result_json.to_frame(said["result"], recorded.file),
            sequence=_whole(said["sequence"]),
            panel_id=_whole(said["panel_id"]),
            number=int(said["number"]),
            travel_mm=float(said["travel_mm"]),
            panel=result_json.to_panel(said["panel"]) if "panel" in said else None,
            missing=tuple(said.get("missing", ())),
            frames=int(said["frames"]),
        )
    except (KeyError, ValueError, TypeError) as error:
        raise SessionWrong(f"{recorded.file}: {type(error).__name__} {error}: take its line out") from error


def _whole(said: Any) -> int | None:
    return None if said is None else int(said)


def version_file(settings: str) -> str:
    """Name of the file beside the index that holds this version of the settings."""
    return f"settings-{settings}.json"
