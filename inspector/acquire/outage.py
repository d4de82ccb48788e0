"""Something that fails and works again: said in the log once when it starts and once when it ends."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable

log = logging.getLogger(__name__)


class Outage:
    """The outages of one thing, named ``what`` in the log."""

    def __init__(self, what: str, clock: Callable[[], float] = time.monotonic) -> None:
        self._what, self._clock = what, clock
        self._since_s: float | None = None
        self._ids: dict[str, object] = {}

    @property
    def lasts(self) -> bool:
        """Whether it fails at present."""
        return self._since_s is not None

    def begins(self, complaint: object, *, traceback: bool = False, **ids: object) -> None:
        """It failed; in an outage that lasts this says nothing new. ``ids``: what the log's lines are about."""
        if self._since_s is None:
            self._since_s = self._clock()
            self._ids = ids
            log.error("%s fails: %s", self._what, complaint, exc_info=traceback, extra=ids)

    def ends(self) -> None:
        """It worked; says so if it did not before."""
        if self._since_s is not None:
            log.info("%s works again after %.1f s", self._what, self._clock() - self._since_s, extra=self._ids)
            self._since_s = None
