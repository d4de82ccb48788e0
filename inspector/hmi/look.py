"""What the page knows of the station at one moment, and whether that can be relied on. Pure."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import Any

from inspector.hmi.commands import Asked
from inspector.hmi.history import Seen

STILL_S = 3.0
"""The heartbeat must change within two seconds; a look may come late by one."""

Words = dict[str, Any]
"""Registers by name, decoded."""


class Link(enum.Enum):
    """How the page stands with the station; nothing is shown of a panel but by :attr:`UP`."""

    CONNECTING = "connecting"
    """It answers, or may, but its heartbeat was not yet seen to move."""
    UP = "up"
    STILL = "still"
    """It answers, and its heartbeat stands still; or a look takes too long."""
    DOWN = "down"


@dataclass(frozen=True, slots=True)
class Look:
    """What the page knows at one moment; never changed, always replaced. ``block`` None: nothing was read yet, or the
    station does not answer."""

    block: Words | None = None
    defects: tuple[Words, ...] = ()
    listed_for: tuple[Any, ...] = ()
    """Of which result the defects are."""
    statistics: Words | None = None
    why: str = ""
    """Why the station does not answer; empty while it does, and before the first try."""
    reached_s: float = 0.0
    """Since when the station answers; monotonic time, as the others."""
    read_s: float = 0.0
    heartbeat_s: float | None = None
    """When the heartbeat was seen to change last; None: not since the station answers."""
    seen: tuple[Seen, ...] = ()
    asked: Asked | None = None
    """The command under way, or the last one."""

    def link(self, now_s: float) -> Link:
        """Whether what was read can be relied on."""
        if self.block is None:
            return Link.DOWN if self.why else Link.CONNECTING
        if now_s - min(self.reached_s if self.heartbeat_s is None else self.heartbeat_s, self.read_s) > STILL_S:
            return Link.STILL
        return Link.CONNECTING if self.heartbeat_s is None else Link.UP
