"""What begins a cycle. Each kind counts what it missed and what began late. Pure: the caller gives the time.

Rules. A trigger that comes while a cycle runs is missed: counted, never made up for. A cycle that begins later than
``late_after_s`` after its trigger is late: counted, and inspected.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace


@dataclass(frozen=True, slots=True)
class Debounced:
    """An input as it has stood for long enough: ``level``; how it stood at the last look, and since when at least and
    at most. ``rose``: it has just come on for good."""

    level: bool
    seen: bool
    since_s: float
    """When it was first seen so."""
    looked_s: float
    """When it was looked at last."""
    before_s: float = -math.inf
    """When it was last seen otherwise."""
    rose: bool = False


def debounce(state: Debounced, seen: bool, now_s: float, stable_s: float) -> Debounced:
    """The input after one more look. A change counts once it was seen for ``stable_s`` without a break."""
    if seen != state.seen:
        state = replace(state, seen=seen, since_s=now_s, before_s=state.looked_s)
    changed = seen != state.level and now_s - state.since_s >= stable_s
    return replace(state, level=seen if changed else state.level, looked_s=now_s, rose=changed and seen)


class Trigger:
    """A camera that sets its own pace: the next cycle begins at once. Base of the others."""

    look_s: float = math.inf
    """How often :meth:`due_s` must be asked while it waits, seconds."""

    def __init__(self, late_after_s: float, missed: int = 0, late: int = 0) -> None:
        self._late_after_s = late_after_s
        self.missed, self.late = missed, late
        self.missed_before = missed
        """:attr:`missed` as it was when the trigger of the last cycle came."""
        self.came_s: float | None = None
        """When that was, on the clock; None before the first."""
        self._resume_s = -math.inf

    def due_s(self, now_s: float) -> float:
        """When the next cycle begins, on the clock; infinite while nobody knows."""
        return self._resume_s

    def begins(self, now_s: float) -> None:
        """A cycle begins."""
        self.missed_before, self.came_s = self.missed, now_s

    def glance(self) -> None:
        """Look whether another trigger comes, in the middle of a cycle. Raises what reading raises."""

    def took(self, frame_id: int, taken_s: float) -> None:
        """The cycle's frame had this id, and came at this time."""

    def passed_over(self, frames: int) -> None:
        """The camera had taken so many frames unasked when it was asked, and waits."""

    def ended(self, now_s: float, resume_s: float) -> None:
        """A cycle has ended; with ``resume_s`` a failed device may be tried again, now if none has failed."""
        self._resume_s = resume_s

    def _came(self, trigger_s: float, now_s: float) -> None:
        self.came_s = trigger_s
        self.late += now_s - trigger_s > self._late_after_s


class Clock(Trigger):
    """Ticks of a clock, the first at ``start_s``."""

    def __init__(self, rate_hz: float, start_s: float, late_after_s: float, missed: int = 0, late: int = 0) -> None:
        super().__init__(late_after_s, missed, late)
        self._rate_hz, self._tick_s = rate_hz, start_s

    def due_s(self, now_s: float) -> float:
        """See the base."""
        return self._tick_s

    def begins(self, now_s: float) -> None:
        """See the base."""
        super().begins(now_s)
        self._came(self._tick_s, now_s)

    def ended(self, now_s: float, resume_s: float) -> None:
        """See the base. Ticks that have passed are missed."""
        missed = max(0, math.floor((now_s - self._tick_s) * self._rate_hz))
        self._tick_s += (missed + 1) / self._rate_hz
        self.missed += missed


class Asked(Trigger):
    """Somebody else says when, and counts what is missed: ``pending`` gives when the cycle was asked for, until it has
    ended; infinite if it was not."""

    def __init__(self, pending: Callable[[], float], late_after_s: float, missed: int = 0, late: int = 0) -> None:
        super().__init__(late_after_s, missed, late)
        self._pending = pending

    def due_s(self, now_s: float) -> float:
        """See the base."""
        return self._pending()

    def begins(self, now_s: float) -> None:
        """See the base."""
        super().begins(now_s)
        self._came(self._pending(), now_s)


class Calls(Trigger):
    """Single calls, by hand: ``take`` gives when they came since it was asked last."""

    def __init__(self, take: Callable[[], list[float]], late_after_s: float, missed: int = 0, late: int = 0) -> None:
        super().__init__(late_after_s, missed, late)
        self._take = take
        self._call_s: float | None = None
        self._missed_at_call = missed

    def due_s(self, now_s: float) -> float:
        """See the base. Of several calls at once the first counts, the others are missed."""
        calls = self._take()
        if self._call_s is None and calls:
            self._call_s, self._missed_at_call = calls.pop(0), self.missed
        self.missed += len(calls)
        return math.inf if self._call_s is None else self._call_s

    def begins(self, now_s: float) -> None:
        """See the base."""
        self.missed_before = self._missed_at_call
        if self._call_s is not None:
            self._came(self._call_s, now_s)

    def ended(self, now_s: float, resume_s: float) -> None:
        """See the base."""
        self.missed += len(self._take())
        self._call_s = None


class Input(Trigger):
    """A digital input, read by ``read``, that comes on and stays on for ``stable_s``.

    While a cycle runs it is read once, in the middle: if it was off then and is on after the cycle, it was missed.
    """

    def __init__(
        self,
        read: Callable[[], bool],
        stable_s: float,
        look_s: float,
        late_after_s: float,
        missed: int = 0,
        late: int = 0,
    ) -> None:
        super().__init__(late_after_s, missed, late)
        self._read, self._stable_s, self.look_s = read, stable_s, look_s
        self._state: Debounced | None = None
        self._was_off = False
        self._off_s: float | None = None
        """When the input that has come on was last seen off."""

    def due_s(self, now_s: float) -> float:
        """See the base. Raises what reading raises. An input that is on at the first look has not come on."""
        seen = self._read()
        if self._state is None:
            self.missed += seen and self._was_off
            self._was_off = False
            self._state = Debounced(seen, seen, now_s, now_s)
        self._state = debounce(self._state, seen, now_s, self._stable_s)
        if self._state.rose:
            self._off_s = self._state.before_s
        return math.inf if self._off_s is None else now_s

    def begins(self, now_s: float) -> None:
        """See the base. The input may have come on as early as just after it was last seen off."""
        super().begins(now_s)
        if self._off_s is not None:
            self.came_s = self._off_s
            self.late += now_s - self._off_s > self._stable_s + self.look_s + self._late_after_s

    def glance(self) -> None:
        """See the base."""
        self._was_off = not self._read()

    def ended(self, now_s: float, resume_s: float) -> None:
        """See the base. What the input did during the cycle begins nothing."""
        self._off_s, self._state = None, None


class Line(Trigger):
    """The camera's own input line: the camera is asked at once, and waits. What it took unasked shows in its ids. Of
    when the line rose nobody but the camera knows: a trigger counts from when its frame came."""

    _last_id: int | None = None

    def took(self, frame_id: int, taken_s: float) -> None:
        """See the base. Frames between the last one and this were nobody's."""
        if self._last_id is not None:
            self.missed += max(0, frame_id - self._last_id - 1)
        self._last_id, self.missed_before, self.came_s = frame_id, self.missed, taken_s

    def passed_over(self, frames: int) -> None:
        """See the base. Frames before the first one are not known to be of the line."""
        if self._last_id is not None:
            self.missed += frames
            self._last_id += frames
