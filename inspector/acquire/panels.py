"""Which frames make a panel, and how far it had moved in each. Pure: the caller gives the time, on one clock.

Rules. A panel whose count, or whose length in triggers, is known ends with its last frame. A trigger that brought no
frame, missed or failed, keeps its place: the panel's later frames stay where they are, a count counts it, and the
panel has not been seen whole. A panel whose end does not come, whose start did not come, or that began while nobody
looked, is ended all the same, and says what it misses: no panel goes silently. A trigger that was missed is one of the
panel's that was under way when it is told, which is before that panel ends.

``missed`` is everywhere the number of triggers missed in all until then; for a frame, until its own trigger came.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from inspector.model import Frame, FrameResult, PanelFrame, PanelFrames
from inspector.panel_settings import ByCount, ByInput, ByLength, ByPlcMarks, LineSpeed, PanelSettings

Done = tuple[PanelFrames, ...]
"""Panels that have ended, in their order."""


NO_FRAME = "a trigger brought no frame"
READ_OUT_S = 0.25
"""A frame that is taken from now on was exposed no longer ago than this."""
ROUNDING = 1e-9
"""A length that is a whole number of steps has no step more for a last bit."""


@dataclass(slots=True)
class _Panel:
    """The panel under way. ``first`` is the number of the trigger of its first place; None before there is one."""

    panel_id: int | None
    latest_s: float
    first: int | None = None
    first_taken_s: float = 0.0
    frames: tuple[PanelFrame, ...] = ()
    missing: tuple[str, ...] = ()

    def misses(self, why: str) -> None:
        """It has not been seen whole; the same is said once."""
        if why not in self.missing:
            self.missing += (why,)


class Panels:
    """Gathers frames into panels by ``settings``, where panels have several frames."""

    def __init__(self, settings: PanelSettings, missed: int = 0) -> None:
        self._settings, self._frames = settings, settings.frames
        self._count = _places(settings)
        self._panel: _Panel | None = None
        self._trigger, self._missed = 0, missed
        self._told = missed
        self._due: int | None = None
        self._last_id: int | None = None
        self._last_trigger = 0
        self._off_since_s: float | None = None
        self._looked = False

    @property
    def under_way(self) -> bool:
        """Whether a panel has begun and not ended."""
        return self._panel is not None

    @property
    def frames_so_far(self) -> int:
        """Frames of the panel under way."""
        return len(self._panel.frames) if self._panel else 0

    @property
    def wants_frame(self) -> bool:
        """Whether a frame taken now is of a panel."""
        match self._frames:
            case ByPlcMarks():
                return self._panel is not None
            case ByInput():
                return self._panel is not None and self._off_since_s is None
        return True

    def goes_on(self, before: Panels, same_camera: bool) -> None:
        """Count places on where ``before`` has come, if frames make panels as they did; ``same_camera``: so do ids."""
        if self._count is None or self._count != before._count:
            return
        self._trigger, self._due = before._trigger, before._due
        self._missed, self._told = before._missed, before._told
        if same_camera:
            self._last_id, self._last_trigger = before._last_id, before._last_trigger

    def started(self, panel_id: int | None, now_s: float, missed: int) -> Done:
        """The PLC says that a panel begins; it ends the one before."""
        if not isinstance(self._frames, ByPlcMarks):
            return ()
        self._tell(missed)
        done = self._end() if self._panel else ()
        self._begin(panel_id, now_s)
        self._told = missed  # What was told since the PLC wrote this is of the panel that begins, too.
        return done

    def ended(self, panel_id: int | None, missed: int) -> Done:
        """The PLC says that the panel ends."""
        if not isinstance(self._frames, ByPlcMarks):
            return ()
        if self._panel is None:
            return (PanelFrames(panel_id, (), ("its end came without its start",)),)
        self._tell(missed)
        return self._end()

    def in_view(self, on: bool, now_s: float, missed: int) -> Done:
        """How the input stands that says whether a panel is in view."""
        if not isinstance(self._frames, ByInput):
            return ()
        at_first, self._looked = not self._looked, True
        if on:
            self._off_since_s = None
            if self._panel is None:
                panel = self._begin(None, now_s)
                if at_first:
                    panel.misses("it was in view already when the station began to look")
            # It may have come into view before what was missed since the last look.
            self._tell(missed)
            return ()
        self._tell(missed)
        if self._off_since_s is None:
            self._off_since_s = now_s
        over = now_s - self._off_since_s >= self._frames.debounce_s
        return self._end() if over and self._panel else ()

    def took(
        self, frame: Frame, result: FrameResult | None, missed: int, now_s: float, panel_id: int | None = None
    ) -> Done:
        """A frame was taken; ``result`` None if it was not wanted. ``panel_id`` as the PLC gave it for a panel that
        begins with this frame."""
        done = self._passed_over(missed, frame.frame_id)
        if result is None:
            return done
        if self._is_beyond(frame.taken_s):
            done += self._end()
        panel = self._panel or self._begin(panel_id, now_s)
        if panel.first is None:
            panel.first = self._trigger
        if not panel.frames:
            panel.first_taken_s = frame.taken_s
        travel_mm = self._travelled_mm(panel, frame.taken_s)
        if panel.frames and travel_mm < panel.frames[-1].travel_mm:
            panel.misses("a frame's time lies before that of the one before it")
        panel.frames += (PanelFrame(result, travel_mm),)
        panel.latest_s = now_s
        return done + self._full()

    def failed(self, why: str, missed: int, now_s: float, panel_id: int | None = None) -> Done:
        """A cycle brought no frame that could be inspected, because of ``why``; ``panel_id`` as for :meth:`took`."""
        done = self._passed_over(missed)
        if self._panel is None and self._count:
            self._begin(panel_id, now_s)
        if self._panel is None:
            return done
        self._panel.misses(f"a frame is missing: {why}")
        return done + self._full()

    def look(self, now_s: float, missed: int) -> Done:
        """No cycle runs; triggers may have been missed, and a panel may have been waited for long enough: frames are
        then counted anew."""
        self._tell(missed)
        if self._is_beyond(now_s - READ_OUT_S):
            return self._end()
        if self._panel is None or now_s - self._panel.latest_s < self._settings.timeout_s:
            return ()
        done = self.interrupted(f"neither a frame nor its end came for {self._settings.timeout_s:g} s")
        self._due = None
        return done

    def misses(self, why: str) -> None:
        """Something keeps the panel under way, if there is one, from being seen whole."""
        if self._panel is not None:
            self._panel.misses(why)

    def interrupted(self, why: str) -> Done:
        """The panel under way, if there is one, ends here. By count, its places left are those of a panel that has
        not been seen whole, and the panels that follow begin where they would have."""
        if self._panel is None:
            return ()
        self._panel.misses(why)
        return self._end()

    def _begin(self, panel_id: int | None, now_s: float) -> _Panel:
        panel = self._panel = _Panel(panel_id, now_s)
        if self._count:
            # Triggers that brought no frame count: they do not shift the panels that follow.
            panel.first = self._trigger - (0 if self._due is None else (self._trigger - self._due) % self._count)
            if panel.first < self._trigger:
                panel.misses(NO_FRAME)
        return panel

    def _end(self) -> Done:
        panel, self._panel = self._panel, None
        assert panel is not None
        if self._count and panel.first is not None:
            self._due = panel.first + self._count
        return (PanelFrames(panel.panel_id, panel.frames, panel.missing),)

    def _full(self) -> Done:
        """Ends a panel whose last place this trigger has taken."""
        panel = self._panel
        full = self._count and panel and panel.first is not None and self._trigger >= panel.first + self._count - 1
        return self._end() if full else ()

    def _passed_over(self, missed: int, frame_id: int | None = None) -> Done:
        """Numbers this cycle's trigger; those between it and the last one brought no frame, and the panel misses them.

        They are those counted, or, where each frame is one trigger's, those that the frames' numbers show. Where panels
        end without a frame, those told already were another panel's, if that one has ended.
        """
        lost = missed - self._missed
        if frame_id is not None and self._last_id is not None and self._mm_per_frame is not None:
            lost = max(lost, frame_id - self._last_id - 1 - (self._trigger - self._last_trigger))
        lost = max(lost, 0)
        untold = lost > self._told - self._missed or not isinstance(self._frames, ByInput | ByPlcMarks)
        self._missed, self._told = missed, max(self._told, missed)
        self._trigger += lost + 1
        if frame_id is not None:
            self._last_id, self._last_trigger = frame_id, self._trigger
        if self._panel is None or not lost:
            return ()
        if untold:
            self._panel.misses(NO_FRAME)
        first = self._panel.first
        return self._end() if self._count and first is not None and self._trigger >= first + self._count else ()

    def _tell(self, missed: int) -> None:
        """The panel under way, if there is one, learns what was missed since anybody was told."""
        if missed > self._told:
            self.misses(NO_FRAME)
            self._told = missed

    def _is_beyond(self, taken_s: float) -> bool:
        """Whether a frame taken then is beyond the end of the panel under way, where length and time end it."""
        panel = self._panel
        if panel is None or not panel.frames or self._count or not isinstance(self._frames, ByLength):
            return False
        return self._travelled_mm(panel, taken_s) >= self._frames.length_mm

    @property
    def _mm_per_frame(self) -> float | None:
        """How far the panel moves from trigger to trigger; None where time says it."""
        return _mm_per_frame(self._settings)

    def _travelled_mm(self, panel: _Panel, taken_s: float) -> float:
        """How far the panel has moved since its first place, or its first frame where time says it."""
        travel, per_frame = self._settings.travel, self._mm_per_frame
        if travel is not None and isinstance(travel.by, LineSpeed):
            return (taken_s - panel.first_taken_s) * travel.by.mm_per_s
        return 0.0 if per_frame is None or panel.first is None else (self._trigger - panel.first) * per_frame


def _mm_per_frame(settings: PanelSettings) -> float | None:
    travel = settings.travel
    return None if travel is None or isinstance(travel.by, LineSpeed) else travel.by.mm_per_frame


def _places(settings: PanelSettings) -> int | None:
    """How many triggers a panel takes, where that is known before it comes: so many cover its length."""
    frames, per_frame_mm = settings.frames, _mm_per_frame(settings)
    if isinstance(frames, ByCount):
        return frames.count
    if isinstance(frames, ByLength) and per_frame_mm:
        return math.ceil(frames.length_mm / per_frame_mm - ROUNDING)
    return None
