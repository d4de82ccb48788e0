"""What came out of a replay: counted, with everything that is not as it was by name. Pure; parts add up in order."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field, fields
from typing import Any

from inspector.model import FrameResult, PanelResult
from inspector.replay.comparison import Compared, Seed, same, seeds
from inspector.sessions import RecordedFrame

Said = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Difference:
    """A frame, or a panel of several by its last frame, of which something else is found now."""

    where: str
    """Path of the image."""
    what: str
    """frame or panel."""
    panel_id: int | None
    sequence: int | None
    then: str
    """Verdict."""
    now: str
    why_then: str
    why_now: str

    @property
    def flipped(self) -> bool:
        """Whether the verdict is another one."""
        return self.then != self.now


@dataclass(frozen=True, slots=True)
class NotCompared:
    """A frame, line, session or panel that could not be compared, and why."""

    where: str
    why: str


@dataclass(frozen=True, slots=True)
class SeedsOf:
    """Heights of a frame's seeds then and now, um; None: it was not found; NaN: it had no height."""

    where: str
    heights_um: list[tuple[float | None, float | None]]


@dataclass
class Tally:
    """Frames and panels of several frames that were compared, how many of them say the same to the last bit, and
    the rest by name. ``seeds`` are those of frames that differ, or of all."""

    frames: int = 0
    frames_same: int = 0
    panels: int = 0
    panels_same: int = 0
    differences: list[Difference] = field(default_factory=list)
    not_compared: list[NotCompared] = field(default_factory=list)
    seeds: list[SeedsOf] = field(default_factory=list)

    @property
    def identical(self) -> bool:
        """Whether everything was compared and is as it was."""
        return not (self.differences or self.not_compared)

    def add(self, after: Tally) -> None:
        """Count on by what came after this."""
        for f in fields(self):
            setattr(self, f.name, getattr(self, f.name) + getattr(after, f.name))

    def as_json(self) -> Said:
        """As a line of a state file."""
        return asdict(self)

    @classmethod
    def of_json(cls, said: Said) -> Tally:
        """The tally of :meth:`as_json`. Raises TypeError, KeyError."""
        lists = {
            "differences": [Difference(**d) for d in said["differences"]],
            "not_compared": [NotCompared(**n) for n in said["not_compared"]],
            "seeds": [SeedsOf(s["where"], [(a, b) for a, b in s["heights_um"]]) for s in said["seeds"]],
        }
        return cls(**{**said, **lists})


def tally(found: Iterable[Compared], every_seed: bool) -> Tally:
    """What these came to; ``every_seed``: also of frames that are as they were."""
    counted = Tally()
    for one in found:
        _frame(counted, one, every_seed)
        if one.panel_why:
            counted.not_compared.append(NotCompared(one.where, one.panel_why))
        elif one.panel is not None and one.panel_then is not None:
            counted.panels += 1
            counted.panels_same += _judged(counted, one, one.panel_then, one.panel, "panel")
    return counted


def _frame(counted: Tally, one: Compared, every_seed: bool) -> None:
    if one.now is None or one.then is None:
        counted.not_compared.append(NotCompared(one.where, one.why))
        return
    counted.frames += 1
    alike = _judged(counted, one, one.then, one.now, "frame")
    counted.frames_same += alike
    if every_seed or not alike:
        heights = [_heights_um(seed) for seed in seeds(one.then.defects, one.now.defects)]
        if heights:
            counted.seeds.append(SeedsOf(one.where, heights))


def _judged(
    counted: Tally, one: Compared, then: FrameResult | PanelResult, now: FrameResult | PanelResult, what: str
) -> bool:
    """Whether the two are the same; if not it is told."""
    if same(then, now):
        return True
    assert isinstance(one.item, RecordedFrame)
    assert one.item.inspected
    said, texts = one.item.inspected, ["; ".join(result.reasons_text) for result in (then, now)]
    names = then.verdict.name, now.verdict.name
    counted.differences.append(Difference(one.where, what, said.panel_id, said.sequence, *names, *texts))
    return False


def _heights_um(seed: Seed) -> tuple[float | None, float | None]:
    then, now = seed
    return then.height_um if then else None, now.height_um if now else None


@dataclass(frozen=True, slots=True)
class Heights:
    """How heights moved, um, now less then, of seeds that were found both times; None where there is no such seed."""

    matched: int
    gained: int
    lost: int
    without_number: int
    """Seeds found both times that have no finite height."""
    mean_um: float | None
    sd_um: float | None
    """Standard deviation."""
    largest_um: float | None
    largest_in: str | None
    """Path of the image that shows it."""


def heights(counted: Tally) -> Heights:
    """How the heights of the tally's seeds moved."""
    pairs = [(of.where, then, now) for of in counted.seeds for then, now in of.heights_um]
    both = [(where, now - then) for where, then, now in pairs if then is not None and now is not None]
    moved = [(where, um) for where, um in both if math.isfinite(um)]
    gained, lost = sum(then is None for _, then, _ in pairs), sum(now is None for _, _, now in pairs)
    if not moved:
        return Heights(len(both), gained, lost, len(both), None, None, None, None)
    mean_um = math.fsum(um for _, um in moved) / len(moved)
    sd_um = math.sqrt(math.fsum((um - mean_um) ** 2 for _, um in moved) / len(moved))
    where, largest_um = max(moved, key=lambda one: abs(one[1]))
    return Heights(len(both), gained, lost, len(both) - len(moved), mean_um, sd_um, largest_um, where)
