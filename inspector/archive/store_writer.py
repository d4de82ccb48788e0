"""Entries on their way into the store: in order, by a thread that nobody waits for longer than asked.

While the store cannot be written, entries wait in memory; it is tried again with back-off, and room is made by whoever
keeps the images. A damaged store is set aside and a new one begun: what waits goes into that.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path

from inspector.archive.claim import Claim, StoreUnavailable
from inspector.archive.entries import Entry
from inspector.archive.store import EntryRefused, Run, Store, StoreBusy, StoreDamaged, set_aside
from inspector.faults import Fault
from inspector.outage import Outage

RETRY_FIRST_S, RETRY_LONGEST_S = 0.1, 5.0
"""A store that cannot be written is tried again after so long; each further failure doubles it."""
MOST_ROWS = 100_000
"""More rows than this, some 50 MB, are not kept in memory: the service must live. The log says so."""
MOST_AT_ONCE = 1_000
"""Entries written together: what waited in an outage goes in batches."""

SLOW_S = 2.0
"""The log is told when an entry has waited so long: a disk that hangs reports nothing."""
LARGE_LOG_BYTES = 64_000_000
"""A log beside the store that has grown larger than this is told of: somebody reads and never ends."""

log = logging.getLogger(__name__)


class StoreWriter:
    """Writes into the store of ``folder``, once its ``claim`` is taken. ``make_room`` is called, in this thread, when
    the disk refuses; ``large`` is told of a log that grows."""

    def __init__(
        self,
        folder: Path,
        run: Run,
        claim: Claim,
        outage: Outage,
        large: Outage,
        make_room: Callable[[], None] = lambda: None,
    ) -> None:
        self._folder, self._run, self._claim = folder, run, claim
        self._outage, self._large, self._make_room = outage, large, make_room
        self._changed = threading.Condition()
        self._waiting: deque[Entry] = deque()
        self._put = self._written = self._lost = self._rows = 0
        self._refused: deque[int] = deque(maxlen=MOST_AT_ONCE)
        self._standing: dict[str, Entry] = {}
        self._since_s: float | None = None
        self._set_aside: Path | None = None
        self._stopping = False
        self._store: Store | None = None
        self._thread = threading.Thread(target=self._work, name="store", daemon=True)
        self._thread.start()

    @property
    def waiting(self) -> int:
        """Entries that are not on the disk yet."""
        return len(self._waiting)

    @property
    def lost(self) -> int:
        """Entries that were not kept, since too many waited."""
        return self._lost

    @property
    def standing(self) -> list[Entry]:
        """What entries refer to, put by :meth:`stands`."""
        return list(self._standing.values())

    @property
    def set_aside(self) -> Path | None:
        """Where a damaged store was put; None if it was sound."""
        return self._set_aside

    @property
    def hangs(self) -> bool:
        """Whether an entry has waited so long that something must be wrong."""
        return self.lag_s() > SLOW_S

    def lag_s(self) -> float:
        """For how long the oldest entry has waited, seconds."""
        since_s = self._since_s
        return 0.0 if since_s is None else time.monotonic() - since_s

    def put(self, entry: Entry) -> int:
        """Have this written after all that came before; its number for :meth:`wait`. Never waits."""
        rows = _rows(entry)
        with self._changed:
            if self._rows + rows > MOST_ROWS and self._waiting:
                return self._lose()
            self._waiting.append(entry)
            self._rows += rows
            self._put += 1
            if self._since_s is None:
                self._since_s = time.monotonic()
            self._changed.notify_all()
            return self._put

    def stands(self, what: str, entry: Entry) -> None:
        """As :meth:`put`, and again in a store that is begun anew: what entries after it refer to, by their kind."""
        self._standing = {**self._standing, what: entry}
        self.put(entry)

    def _lose(self) -> int:
        """Keep one entry less; the number of the next one."""
        self._lost += 1
        if self._lost == 1:
            log.error("%d entries wait for the store: what comes now is not kept", len(self._waiting))
        return self._put + 1

    def has(self, number: int) -> bool:
        """Whether the entry of this number is on the disk, and with it all before that the store did not refuse."""
        return self._written >= number and number not in self._refused

    def wait(self, number: int, timeout_s: float) -> bool:
        """Whether that is so within the time."""
        with self._changed:
            return self._changed.wait_for(lambda: self._written >= number, timeout_s) and self.has(number)

    def watch(self) -> None:
        """Tell the log, in whoever's thread this is, if the store hangs: its own thread then does, too."""
        if self.hangs:
            self._outage.begins(f"{self._folder} takes more than {SLOW_S:g} s. {Fault.STORE_DEGRADED.remedy}")

    def close(self, timeout_s: float, ended_s: float) -> list[Entry]:
        """Write what waits, if that can be done in the time, and close; the entries that are left."""
        with self._changed:
            self._stopping = True
            self._changed.notify_all()
        self._thread.join(timeout_s)
        if not self._thread.is_alive():
            if not self._waiting:
                self._outage.ends(at_once=True)
            if self._store is not None:
                self._store.close(ended_s)
            self._claim.close()
        with self._changed:
            return list(self._waiting)

    def _work(self) -> None:
        """The thread. Ends when it is asked to and nothing waits, or when what waits cannot be written."""
        retry_s = RETRY_FIRST_S
        while True:
            try:
                batch = self._next()
                if batch is None:
                    return
                self._write(batch)
                retry_s = RETRY_FIRST_S
                self._outage.ends()
                continue
            except StoreDamaged as damage:
                self._reopen_later()
                failure = self._put_aside(damage)
            except StoreBusy as error:
                failure = error
            except StoreUnavailable as error:
                self._reopen_later()
                failure = error
            except Exception as error:  # an error in the program must not end the keeping of results
                log.exception("fault %d: %s", Fault.INTERNAL, Fault.INTERNAL.meaning)
                self._reopen_later()
                failure = StoreUnavailable(f"{type(error).__name__}: {error}")
            if failure is not None:
                self._outage.begins(f"{failure}. {Fault.STORE_DEGRADED.remedy}")
            if self._pause(retry_s):
                return
            retry_s = min(2 * retry_s, RETRY_LONGEST_S)

    def _next(self) -> list[Entry] | None:
        """The entries to be written next, with the store open; None when all is done. Raises as the store."""
        self._opened()
        with self._changed:
            if not self._waiting and not self._stopping:
                self._changed.wait()
            if not self._waiting:
                return None if self._stopping else []
            return [self._waiting[i] for i in range(min(len(self._waiting), MOST_AT_ONCE))]

    def _opened(self) -> Store:
        """The store. Raises StoreUnavailable, StoreDamaged."""
        if self._store is None:
            self._claim.take()
            store = Store(self._folder, self._run)
            try:
                store.write(self._standing.values())
            except BaseException:
                store.close()
                raise
            self._store = store
        return self._store

    def _write(self, batch: list[Entry]) -> None:
        """Write, tell who waits, and tidy up when nobody does. Raises StoreUnavailable, StoreDamaged."""
        store = self._opened()
        try:
            store.write(batch)
        except EntryRefused:
            self._write_one_by_one(store, batch)
        with self._changed:
            for _ in batch:
                self._rows -= _rows(self._waiting.popleft())
            self._written += len(batch)
            self._since_s = time.monotonic() if self._waiting else None
            self._changed.notify_all()
            idle = not self._waiting
        if idle:
            self._tidy(store)

    def _tidy(self, store: Store) -> None:
        size = store.tidy()
        if size > LARGE_LOG_BYTES:
            self._large.begins("somebody reads the store without end, and it grows until the disk is full: end that")
        elif size < LARGE_LOG_BYTES // 2:
            self._large.ends()

    def _write_one_by_one(self, store: Store, batch: list[Entry]) -> None:
        """An entry that no store takes must not keep the others from it."""
        for number, entry in enumerate(batch, self._written + 1):
            try:
                store.write([entry])
            except EntryRefused as error:
                self._lost += 1
                self._refused.append(number)
                log.error(
                    "fault %d: %s: the store refuses %s (%s)", Fault.INTERNAL, Fault.INTERNAL.meaning, entry, error
                )

    def _put_aside(self, error: StoreDamaged) -> StoreUnavailable | None:
        """Begin anew beside a damaged store; what is in the way of that, None if nothing."""
        if not self._claim.holds():
            return StoreUnavailable(str(error))  # the folder is another one: its store may be sound
        try:
            moved = set_aside(self._folder, time.time())
        except StoreUnavailable as refused:
            return refused
        fault = Fault.STORE_DAMAGED
        log.error("fault %d: %s (%s); it is kept as %s. %s", fault, fault.meaning, error, moved, fault.remedy)
        self._set_aside = moved or self._folder
        return None

    def _reopen_later(self) -> None:
        if self._store is not None:
            self._store.close()
            self._store = None

    def _pause(self, retry_s: float) -> bool:
        """Make room, and wait before the next try; whether to give up instead, since the service ends."""
        self._make_room()
        with self._changed:
            return self._changed.wait_for(lambda: self._stopping, retry_s)


def _rows(entry: Entry) -> int:
    return sum(len(rows.values) for rows in entry)
