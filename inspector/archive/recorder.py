"""Frames on their way to the disk: which are kept is decided at once, the writing is done by a thread of its own.

Two shelves of sessions: ``frames``, what failed and a sample of what passed; ``last``, the last frames whatever they
say. Nobody waits for an image. When the disk cannot keep up, the queue is bounded, and frames of least worth are left
out; when it is full, the oldest sessions go.
"""

from __future__ import annotations

import errno
import logging
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from firmware_bridge.wire.session import Recorded
from inspector import heap
from inspector.archive import retention
from inspector.archive.archive_settings import KeptFrames
from inspector.archive.entries import Place
from inspector.archive.session_frames import Kept
from inspector.archive.session_writer import SessionWriter
from inspector.archive.shelf import STAMP, Shelf
from inspector.faults import Fault
from inspector.model import Image
from inspector.outage import Outage

FRAMES, LAST = "frames", "last"
"""Folders of the two shelves."""
SESSION_FRAMES, SESSION_S = 200, 3600.0
"""A session of the first shelf ends after so many frames or seconds: it is what is deleted at once."""
SESSIONS_AT_LEAST = 8
"""A session is ended when it takes one part of so many of what all may: 200 large frames are much to delete at once."""
RING_PARTS = 4
"""The last frames are in so many sessions, and one more is being written."""
QUEUE_BYTES = 48_000_000
"""Images that wait take no more memory than this."""
LEAST_FREE_MB = 20.0
"""Results are left so much of the disk, whatever the settings say."""
LEAST_FREE_FILES = 2 * SESSION_FRAMES
"""So many files can still be made, or room is made as for space."""
AT_ONCE = 16
"""Frames written together, for the sake of the disk."""
LOOK_EVERY_S = 10.0
"""Space and age are looked at so often while frames come."""

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Version:
    """The settings that a frame was inspected by: their name and text."""

    name: str
    text: str


@dataclass(frozen=True, slots=True)
class Plan:
    """Where the frames of one result are kept, and why: a session of either shelf, or of both. None: in neither."""

    kept: Kept
    frames: str | None
    last: str | None

    def place(self, file: str) -> Place:
        """Where the store says that the frame is."""
        shelf, session = (FRAMES, self.frames) if self.frames else (LAST, self.last)
        return Place(self.kept.value, f"{shelf}/{session}/{file}")


@dataclass(frozen=True, slots=True)
class _Job:
    """A frame to be written."""

    image: Image
    recorded: Recorded
    version: Version
    plan: Plan


class Recorder:
    """Keeps frames below ``folder`` while it is ``ours``. ``about`` is what each session says of the station."""

    def __init__(
        self,
        folder: Path,
        settings: KeptFrames,
        about: Mapping[str, object],
        outage: Outage,
        ours: Callable[[], bool] = lambda: True,
    ) -> None:
        self.settings = settings
        self._ours, self._cleaned = ours, False
        self._folder, self._about, self._outage = folder, about, outage
        self._shelves = {name: Shelf(folder / name) for name in (FRAMES, LAST)}
        self._sessions = {FRAMES: _Rotating(SESSION_FRAMES, SESSION_S), LAST: _Rotating(0, float("inf"))}
        self._passed = 0
        self._changed, self._tidying = threading.Condition(), threading.Lock()
        self._jobs: deque[_Job] = deque()
        self._bytes = self._left_out = 0
        self._stopping = False
        self._writers: dict[str, SessionWriter] = {}
        self._looked_s = float("-inf")
        self._thread = threading.Thread(target=self._work, name="frames", daemon=True)
        self._thread.start()

    @property
    def waiting_bytes(self) -> int:
        """Size of the images that wait."""
        return self._bytes

    @property
    def left_out(self) -> int:
        """Frames that were to be kept and were not: the disk was full or too slow."""
        return self._left_out

    def plan(self, passed: bool, frames: int, at_s: float) -> Plan | None:
        """Whether and where this result's frames are to be kept; ``at_s`` is Unix time. Does not touch the disk."""
        settings = self.settings
        self._passed += passed
        last = self._sessions[LAST].next(frames, at_s, -(-settings.last // RING_PARTS)) if settings.last else None
        if not passed and settings.failing:
            return Plan(Kept.FAILING, self._sessions[FRAMES].next(frames, at_s), last)
        if passed and settings.passing_every and self._passed % settings.passing_every == 0:
            return Plan(Kept.SAMPLE, self._sessions[FRAMES].next(frames, at_s), last)
        return Plan(Kept.LAST, None, last) if last else None

    def put(self, plan: Plan, version: Version, frames: Sequence[tuple[Image, Recorded]]) -> None:
        """Have frames written as planned. Never waits; of too many, those of least worth are left out."""
        with self._changed:
            for image, recorded in frames:
                self._jobs.append(_Job(image, recorded, version, plan))
                self._bytes += image.nbytes
            while self._bytes > QUEUE_BYTES and self._jobs:
                self._leave_out()
            self._changed.notify_all()

    def make_room(self) -> None:
        """Delete the oldest sessions, of whichever shelf, until the disk has room again. In any thread."""
        if not self._ours() or not self._tidying.acquire(blocking=False):
            return  # whoever does it already does it for both
        try:
            for name in (FRAMES, LAST):
                self._tidy(name)
            if self._free_bytes() < self._least_free_bytes:
                for session in self._sessions.values():
                    session.end()
        except OSError:
            pass  # the next try to write says it
        finally:
            self._tidying.release()

    def close(self, timeout_s: float) -> int:
        """Write what waits, if that can be done in the time; how many frames are left out."""
        with self._changed:
            self._stopping = True
            self._changed.notify_all()
        self._thread.join(timeout_s)
        return len(self._jobs)

    def _leave_out(self) -> None:
        """Drop one frame of the least worth, the oldest of these."""
        worths = [_WORTH[job.plan.kept] for job in self._jobs]
        index = worths.index(min(worths))
        self._bytes -= self._jobs[index].image.nbytes
        del self._jobs[index]
        self._lose(1, "the disk is too slow")

    def _lose(self, frames: int, why: object) -> None:
        with self._changed:
            self._left_out += frames
        self._outage.begins(f"{why}: frames are left out, results are not")

    def _work(self) -> None:
        self._clean()
        while (jobs := self._next()) is not None:
            if time.monotonic() > self._looked_s + LOOK_EVERY_S:
                self._looked_s = time.monotonic()
                self.make_room()
                heap.give_back()  # of rows and files that waited while the disk was slow
            try:
                if jobs:
                    self._write(jobs)
            except OSError as error:
                self._fails(jobs, f"{error.filename or self._folder}: {error.strerror}")
            except Exception as error:  # an error in the program must not end the keeping of frames
                log.exception("fault %d: %s", Fault.INTERNAL, Fault.INTERNAL.meaning)
                self._fails(jobs, f"{type(error).__name__}: {error}")
            else:
                if jobs and not self._jobs:
                    self._outage.ends()
            with self._changed:
                self._bytes -= sum(job.image.nbytes for job in jobs)

    def _clean(self) -> None:
        """Once, before the first frame is written: take away what a crash left half done."""
        if not self._cleaned and self._ours():
            self._cleaned = True
            with suppress(OSError):
                for shelf in self._shelves.values():
                    shelf.clean()

    def _fails(self, jobs: Sequence[_Job], why: str) -> None:
        self._lose(len(jobs), why)
        self._writers.clear()
        for session in self._sessions.values():
            session.end()
        self.make_room()

    def _next(self) -> list[_Job] | None:
        """The frames to be written next, of one plan, if any have come meanwhile; None when all is done."""
        with self._changed:
            self._changed.wait_for(lambda: bool(self._jobs) or self._stopping, 6 * LOOK_EVERY_S)
            if not self._jobs:
                return None if self._stopping else []
            plan, jobs = self._jobs[0].plan, list[_Job]()
            while self._jobs and self._jobs[0].plan == plan and len(jobs) < AT_ONCE:
                jobs.append(self._jobs.popleft())
            return jobs

    def _write(self, jobs: Sequence[_Job]) -> None:
        """Into the session of the first shelf, and linked into the other; or into that one only. Raises OSError."""
        if not self._ours():
            raise OSError(errno.ENODEV, "is not this station's, or its disk is gone", str(self._folder))
        self._clean()
        plan, frames = jobs[0].plan, [(job.image, job.recorded) for job in jobs]
        if self._free_bytes() < self._least_free_bytes:
            least_mb = self._least_free_bytes / retention.BYTES_PER_MB
            raise OSError(errno.ENOSPC, f"less than {least_mb:g} MB free", str(self._folder))
        writers = [self._writer(s, name) for s, name in ((FRAMES, plan.frames), (LAST, plan.last)) if name]
        for writer in writers:
            for job in jobs:
                writer.version(job.version.name, job.version.text)
        writers[0].keep(frames)
        for ring in writers[1:]:
            ring.share(writers[0], frames)

    def _writer(self, shelf: str, session: str) -> SessionWriter:
        """The session of that name, begun if it is new. Raises OSError."""
        writer = self._writers.get(shelf)
        if writer is None or writer.folder.name != session:
            writer = self._writers[shelf] = SessionWriter(
                self._shelves[shelf].folder / session, self._about, go_on=True
            )
        return writer

    def _free_bytes(self) -> float:
        """Free space; none where files can no longer be made, however much there is."""
        disk = os.statvfs(self._folder)
        short = disk.f_files > 0 and disk.f_favail < LEAST_FREE_FILES
        return 0.0 if short else disk.f_bavail * disk.f_frsize

    @property
    def _least_free_bytes(self) -> float:
        return max(self.settings.min_free_mb, LEAST_FREE_MB) * retention.BYTES_PER_MB

    def _busy(self, name: str) -> set[str]:
        """The sessions that are written into: the one that frames are planned for, and one that those before are of."""
        planned, writer = self._sessions[name].name, self._writers.get(name)
        return {session for session in (planned, writer and writer.folder.name) if session}

    def _tidy(self, name: str) -> None:
        """Delete what is to go from a shelf by age, number, size and free space. Raises OSError."""
        shelf, busy, now_s = self._shelves[name], self._busy(name), time.time()
        if name == LAST:
            for session in retention.past_the_last(shelf.held(busy, now_s), self.settings.last):
                shelf.delete(session)
        most_bytes, writing_bytes = self.settings.most_mb * retention.BYTES_PER_MB, sum(map(shelf.size_bytes, busy))
        if writing_bytes > most_bytes / SESSIONS_AT_LEAST:
            self._sessions[name].end()
        left_mb = (most_bytes - writing_bytes) / retention.BYTES_PER_MB
        limits = retention.Limits(self.settings.days, left_mb, self._least_free_bytes)
        for session in retention.overdue(shelf.held(busy, now_s), limits, now_s, self._free_bytes()):
            log.info("frames of session %s/%s are deleted: their time or their space is over", name, session)
            shelf.delete(session)


_WORTH = {Kept.LAST: 0, Kept.SAMPLE: 1, Kept.FAILING: 2}


class _Rotating:
    """Names of sessions, one after the other: a new one after so many frames or seconds, or when one is ended."""

    def __init__(self, most_frames: int, most_s: float) -> None:
        self.name: str | None = None
        self._most_frames, self._most_s = most_frames, most_s
        self._frames, self._begun_s = 0, 0.0

    def next(self, frames: int, at_s: float, most_frames: int | None = None) -> str:
        """The session for these frames of one result."""
        most = self._most_frames if most_frames is None else most_frames
        over = self._frames and self._frames + frames > most
        name = self.name
        if name is None or over or not 0 <= at_s - self._begun_s < self._most_s:
            stamp = time.strftime(STAMP, time.gmtime(at_s))
            name = self.name = f"{stamp}-{time.monotonic_ns():020d}"
            self._begun_s, self._frames = at_s, 0
        self._frames += frames
        return name

    def end(self) -> None:
        """The next frames go into a new session; in any thread."""
        self.name = None
