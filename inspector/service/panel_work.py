"""Panels of several frames at work: frames, the PLC's marks and the input come in, panels' results go out."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace

from firmware_bridge.errors import BridgeError
from inspector.acquire.panels import NO_FRAME, Done, Panels
from inspector.handshake import Order
from inspector.handshake_table import Action
from inspector.model import PanelFrames, PanelResult, Reason, Verdict
from inspector.outage import Outage
from inspector.panel_settings import ByInput
from inspector.service.cycle import Turn
from inspector.settings import Settings
from inspector.stages import Judging, judging_of


class PanelWork:
    """The panels of one station. ``read_input`` reads a digital input by channel. ``missed`` is everywhere the number
    of triggers missed in all until then, unless it says otherwise."""

    def __init__(
        self,
        settings: Settings,
        judge: Judging,
        read_input: Callable[[int], bool],
        missed: int,
        clock: Callable[[], float],
    ) -> None:
        self._judge, self._read_input, self._clock = judge, read_input, clock
        self._panels = Panels(settings.panel, missed)
        self._input = settings.panel.frames if isinstance(settings.panel.frames, ByInput) else None
        self._read_s = -math.inf
        self._marks: deque[Order] = deque()
        self._missed_otherwise: int | None = None
        self._done: list[PanelFrames] = []
        self._program = Outage("judging of panels", clock)

    @classmethod
    def of(cls, settings: Settings, read_input: Callable[[int], bool], missed: int) -> PanelWork | None:
        """The panels of a station, or None where each frame is one. Raises CalibrationError."""
        if not settings.panel.several:
            return None
        return cls(settings, judging_of(settings), read_input, missed, time.monotonic)

    @property
    def look_s(self) -> float:
        """How often :meth:`look` must be called while the station waits, seconds."""
        return self._input.poll_s if self._input else math.inf

    @property
    def frames_so_far(self) -> int:
        """Frames of the panel under way."""
        return self._panels.frames_so_far

    @property
    def under_way(self) -> bool:
        """Whether a panel has begun and not ended."""
        return self._panels.under_way

    def wants_frame(self) -> bool:
        """Whether the frame just taken is of a panel."""
        return self._panels.wants_frame

    def after(self, before: PanelWork | None, same_camera: bool) -> PanelWork:
        """These panels, their frames counted on where ``before`` has come, if they make panels as they did."""
        if before is not None:
            self._panels.goes_on(before._panels, same_camera)
            self._marks = before._marks
        return self

    def mark(self, marks: list[Order], before_s: float, missed_otherwise: int) -> None:
        """Starts and ends from the PLC; those after ``before_s``, when a TRIGGER that waits came or a frame was taken,
        come after that frame.

        ``missed_otherwise``: triggers missed in all until now that were none of the PLC's; those since the last call
        came before the marks or after them, so that no panel of theirs has been seen whole.
        """
        doubt = self._missed_otherwise is not None and missed_otherwise > self._missed_otherwise
        self._missed_otherwise = missed_otherwise
        self._marks += marks
        while self._marks and self._marks[0].asked_s <= before_s:
            order = self._marks.popleft()
            panel_id, missed = order.panel_id or None, order.missed + missed_otherwise
            if order.action is Action.START_PANEL:
                self._keep(self._panels.started(panel_id, self._clock(), missed))
                if doubt:
                    self._panels.misses(NO_FRAME)
            else:
                self._keep(self._panels.ended(panel_id, missed))
            if order.mark_refused_after:
                self._panels.misses("the PLC's next mark was refused: too many waited")

    def unread(self, why: str) -> None:
        """Something that says what the panel's frames are could not be read: the panel under way, if there is one, does
        not pass."""
        self._panels.misses(why)

    def glance(self, missed: int) -> None:
        """In the middle of a cycle, right after the exposure: see whether a panel is in view."""
        if self._input is None:
            return
        self._read_s = self._clock()
        try:
            on = self._read_input(self._input.channel) is (self._input.active == "on")
        except BridgeError as error:
            self.unread(f"whether it was in view could not be read: {error}")
            return
        self._keep(self._panels.in_view(on, self._clock(), missed))

    def look(self, missed: int) -> None:
        """While the station waits: see whether a panel is in view, or has been waited for long enough."""
        if self._clock() >= self._read_s + self.look_s:
            self.glance(missed)
        self._keep(self._panels.look(self._clock(), missed))

    def took(self, turn: Turn, missed: int, panel_id: int) -> None:
        """A cycle is done. ``missed``: until its trigger came; ``panel_id`` as the PLC gave it, 0: it gave none."""
        now_s = self._clock()
        if turn.frame is not None:
            self._keep(self._panels.took(turn.frame, turn.result, missed, now_s, panel_id or None))
        else:
            self._keep(self._panels.failed("; ".join(turn.why), missed, now_s, panel_id or None))

    def interrupted(self, why: str) -> None:
        """The panel under way, if there is one, ends here."""
        self._keep(self._panels.interrupted(why))

    def results(self) -> list[PanelResult]:
        """The panels that are done since this was asked last, judged."""
        done, self._done = self._done, []
        return [self._judged(gathered) for gathered in done]

    def _judged(self, gathered: PanelFrames) -> PanelResult:
        """The panel's result; an error in the program is one too, and no PASS."""
        try:
            result = replace(self._judge(gathered), gathered=gathered)
        except Exception as error:
            what = f"{type(error).__name__}: {error}"
            self._program.begins(what, traceback=True)
            reasons, travels = (
                Reason.PANEL_INCOMPLETE | Reason.DEVICE_FAULT,
                tuple(f.travel_mm for f in gathered.frames),
            )
            result = PanelResult(
                Verdict.NOT_INSPECTED, reasons, (what,), panel_id=gathered.panel_id, travels_mm=travels
            )
            return replace(result, gathered=gathered)
        self._program.ends()
        return result

    def _keep(self, done: Done) -> None:
        self._done += done
