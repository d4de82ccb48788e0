"""Something that fails and works again: said in the log once when it starts and once when it ends."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable

log = logging.getLogger(__name__)


class Outage:
    """The outages of one thing, named ``what`` in the log. What comes and goes within ``settles_s`` is one outage."""

    def __init__(self, what: str, clock: Callable[[], float] = time.monotonic, settles_s: float = 0.0) -> None:
        self._what, self._clock, self._settles_s = what, clock, settles_s
        self._last_s = 0.0
        self._since_s: float | None = None
        self._ids: dict[str, object] = {}

    @property
    def lasts(self) -> bool:
        """Whether it fails at present."""
        return self._since_s is not None

    def begins(self, complaint: object, *, traceback: bool = False, **ids: object) -> None:
        """It failed; in an outage that lasts this says nothing new. ``ids``: what the log's lines are about."""
        self._last_s = self._clock()
        if self._since_s is None:
            self._since_s = self._last_s
            self._ids = ids
            log.error("%s fails: %s", self._what, complaint, exc_info=traceback, extra=ids)

    def ends(self, *, at_once: bool = False) -> None:
        """It worked; says so if it did not before, once that has lasted, or ``at_once``."""
        if self._since_s is not None and (at_once or self._clock() >= self._last_s + self._settles_s):
            log.info("%s works again after %.1f s", self._what, self._clock() - self._since_s, extra=self._ids)
            self._since_s = None
