"""Recorded frames inspected again, beside what was found in them then.

What cannot be compared says why; one frame that is missing or trips the program never costs the others theirs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from firmware_bridge.wire.session import INDEX
from inspector import imagefile, sessions
from inspector.archive import result_json
from inspector.model import Defect, FrameResult, PanelFrame, PanelResult
from inspector.reinspection import Change, Reinspection
from inspector.replay.apart import apart
from inspector.sessions import RecordedFrame, Spoilt, Stretch
from inspector.settings_version import SettingsVersion, VersionWrong

Made = TypeVar("Made")

WITHIN_S = 60.0
"""A frame or panel takes a second at most."""
SAME_SPOT_PX = 3.0
"""Two results of one image mean the same seed where both its spots are within this of each other, pixels."""
PANEL_INCOMPLETE = "its panel cannot be judged again: not all of its frames are here, or not all can be inspected"


@dataclass(frozen=True, slots=True)
class Compared:
    """A recorded frame with what is found in it now; or a line or session that cannot be read."""

    item: RecordedFrame | Spoilt
    now: FrameResult | None = None
    """None: it could not be inspected again."""
    why: str = ""
    """Why it could not."""
    panel: PanelResult | None = None
    """With the last frame of a panel of several: what they say together now."""
    panel_why: str = ""
    """With the last frame of a panel that was judged: why it could not be again."""

    @property
    def then(self) -> FrameResult | None:
        """What was found in the frame when it was recorded."""
        return self.item.inspected.result if isinstance(self.item, RecordedFrame) and self.item.inspected else None

    @property
    def panel_then(self) -> PanelResult | None:
        """With the last frame of a panel of several: what they said together."""
        return self.item.inspected.panel if isinstance(self.item, RecordedFrame) and self.item.inspected else None

    @property
    def where(self) -> str:
        """Path of the image, or of the session."""
        return str(self.item.image if isinstance(self.item, RecordedFrame) else self.item.folder)


class Comparing:
    """Inspects recorded frames again, by their own settings with a change; what that takes is made once.

    ``careful``: each frame and panel in a process of its own, so that one that crashes it is told by name.
    """

    def __init__(self, change: Change, careful: bool = False) -> None:
        self._change, self._careful = change, careful
        self._made: dict[int, tuple[SettingsVersion, Reinspection]] = {}
        self._latest: tuple[tuple[Path, str], Reinspection] | None = None

    def all(self, parts: Sequence[Stretch | Spoilt]) -> Iterator[Compared]:
        """Every frame and every spoilt line of these parts of sessions, in their order."""
        for part in parts:
            if isinstance(part, Spoilt):
                yield Compared(part, why=part.why)
                continue
            try:
                for panel in sessions.read(part):
                    yield from self._panel(panel)
            except OSError as error:
                why = f"{part.folder / INDEX}: cannot be read ({error.strerror})"
                yield Compared(Spoilt(part.folder, 0, why), why=why)

    def _panel(self, panel: Sequence[RecordedFrame | Spoilt]) -> list[Compared]:
        """The frames of one panel; with the last one, what they say together, if they did."""
        found = [self._item(item) for item in panel]
        last = found[-1]
        if last.panel_then is None:
            return found
        return [*found[:-1], self._judged(found, last)]

    def _item(self, item: RecordedFrame | Spoilt) -> Compared:
        if isinstance(item, Spoilt):
            return Compared(item, why=item.why)
        try:
            again = self._again(item)
            now = self._done(lambda: again.frame(imagefile.read(item.image), item.recorded.file))
            return Compared(item, replace(now, highlights=None))  # no part of what is compared, and most of its size
        except (VersionWrong, imagefile.FrameUnreadable) as error:
            return Compared(item, why=str(error))
        except Exception as error:
            return Compared(item, why=_program(error))

    def _done(self, work: Callable[[], Made]) -> Made:
        """What ``work`` makes, or raises."""
        if not self._careful:
            return work()
        made = apart(lambda: _tried(work), WITHIN_S)
        if isinstance(made, Exception):
            raise made
        return made

    def _again(self, frame: RecordedFrame) -> Reinspection:
        """What inspects this frame. Raises VersionWrong."""
        of = frame.folder, frame.inspected.settings if frame.inspected else ""
        if self._latest is None or self._latest[0] != of:
            self._latest = of, self._made_of(frame.version())
        return self._latest[1]

    def _made_of(self, recorded: SettingsVersion) -> Reinspection:
        if id(recorded) not in self._made:
            again = Reinspection(self._change.applied(recorded))
            again.station, again.version.light  # noqa: B018  # what is wrong with the version is said before an image is read
            self._made[id(recorded)] = recorded, again
        return self._made[id(recorded)][1]

    def _judged(self, found: Sequence[Compared], last: Compared) -> Compared:
        """The last frame with its panel judged again, if all of its frames are there."""
        assert isinstance(last.item, RecordedFrame)
        assert last.item.inspected
        assert last.item.inspected.panel
        inspected, then = last.item.inspected, last.item.inspected.panel
        frames = [
            PanelFrame(one.now, one.item.inspected.travel_mm)
            for one in found
            if one.now and isinstance(one.item, RecordedFrame) and one.item.inspected
        ]
        if len(frames) != inspected.frames:
            return replace(last, panel_why=PANEL_INCOMPLETE)
        try:
            again = self._again(last.item)
            # Its own number, which may be None, where the line has the one that the PLC was shown.
            panel = self._done(lambda: again.panel(frames, then.panel_id, inspected.missing))
            return replace(last, panel=panel)
        except Exception as error:
            return replace(last, panel_why=_program(error))


def _tried(work: Callable[[], Made]) -> Made | Exception:
    try:
        return work()
    except Exception as error:
        return error


def _program(error: Exception) -> str:
    return f"an error in the program ({type(error).__name__}: {error}); send us the frame and this output"


def same(then: FrameResult | PanelResult, now: FrameResult | PanelResult) -> bool:
    """Whether two results say the same, to the last bit."""
    return then == now or result_json.same(then, now)


Seed = tuple[Defect | None, Defect | None]
"""A seed as it was found then and now; None: it was not."""


def seeds(then: Sequence[Defect], now: Sequence[Defect]) -> list[Seed]:
    """Which seed of one result is which of another's of the same image: by where their spots are, the nearest first.
    In the order of the first, then those that only the second has."""
    if [d.direct_px for d in then] == [d.direct_px for d in now] and len(now) < 2:
        return list(zip(then, now, strict=True))
    partner = _partners(then, now)
    taken = set(partner.values())
    gained: list[Seed] = [(None, defect) for n, defect in enumerate(now) if n not in taken]
    return [(defect, now[partner[n]] if n in partner else None) for n, defect in enumerate(then)] + gained


def _partners(then: Sequence[Defect], now: Sequence[Defect]) -> dict[int, int]:
    if not then or not now:
        return {}
    before, after = (np.array([(*d.direct_px, *d.mirror_px) for d in some]) for some in (then, now))
    apart = before[:, None] - after[None]
    furthest_px = np.maximum(np.hypot(apart[..., 0], apart[..., 1]), np.hypot(apart[..., 2], apart[..., 3]))
    near = zip(*np.nonzero(furthest_px <= SAME_SPOT_PX), strict=True)
    found: dict[int, int] = {}
    used: set[int] = set()
    for _, i, j in sorted((float(furthest_px[i, j]), int(i), int(j)) for i, j in near):
        if i not in found and j not in used:
            found[i] = j
            used.add(j)
    return found
