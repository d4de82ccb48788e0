"""Recorded sessions read again: their frames with what was found in them and by which settings.

What is wrong with a line is said of that line, and the others are read. An index may be read in stretches that are cut
between panels, so that many may read it at a time; what they find does not depend on where it was cut.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from filecmp import cmp
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import BinaryIO

from firmware_bridge.wire import session
from firmware_bridge.wire.session import INDEX, Recorded, SessionWrong
from inspector import settings_version
from inspector.archive.recorder import FRAMES, LAST
from inspector.archive.session_frames import Inspected, Kept, inspected, version_file
from inspector.settings_version import SettingsVersion, VersionWrong

UNCOUNTED = 0
"""A line's number while nobody has to be told it."""
BLOCK_BYTES = 1 << 20
WHOLE = 1 << 62
"""More bytes than an index has."""
UNTOLD = "its line says nothing of an inspection: it can be inspected, but not again (inspector inspect)"


@dataclass(frozen=True, slots=True)
class RecordedFrame:
    """A frame of a session; ``inspected`` None: its line says nothing of an inspection."""

    folder: Path
    recorded: Recorded
    inspected: Inspected | None

    @property
    def image(self) -> Path:
        """The image's file."""
        return self.folder / self.recorded.file

    def version(self) -> SettingsVersion:
        """The settings that it was inspected by. Raises VersionWrong, also where there are none."""
        if self.inspected is None:
            raise VersionWrong(UNTOLD)
        path = self.folder / version_file(self.inspected.settings)
        try:
            state = path.stat()
            return _version(path, state.st_mtime_ns, state.st_size)
        except OSError as error:
            raise VersionWrong(f"{path}: its settings cannot be read ({error.strerror})") from error
        except ValueError as error:  # VersionWrong, and what is no UTF-8
            raise VersionWrong(f"{path}: {error}") from error


@lru_cache(maxsize=64)
def _version(path: Path, _written_ns: int, _size: int) -> SettingsVersion:
    return _same_version(path.read_text(encoding="utf-8"))


@lru_cache(maxsize=64)
def _same_version(text: str) -> SettingsVersion:
    """One object for all sessions that hold this version: what is made of it is made once."""
    return settings_version.from_json(text)


@dataclass(frozen=True, slots=True)
class Spoilt:
    """A line of an index that tells nothing, and why, with its number; or a whole session (``line`` 0)."""

    folder: Path
    line: int
    why: str


@dataclass(frozen=True, slots=True)
class Stretch:
    """A part of a session's index, bytes ``start`` to ``stop``, cut between panels.

    ``counted_in`` is a shelf whose sessions have some of its frames too: these are passed over here.
    """

    folder: Path
    start: int
    stop: int
    counted_in: Path | None = None


def find(paths: Sequence[Path]) -> list[Path]:
    """Folders of sessions among and below ``paths``, each once; those below one by name."""
    found: dict[Path, None] = {}
    for path in paths:
        for folder, below, files in os.walk(path):
            below.sort()
            if INDEX in files:
                found[Path(folder)] = None
                below.clear()
    return list(found)


def counted_in(folder: Path, shelves: Collection[Path]) -> Path | None:
    """Which of the ``shelves`` that are read has frames of this session, of an archive's last ones, too; or None."""
    if folder.parent.name != LAST:
        return None
    frames = folder.parent.with_name(FRAMES)
    return frames if frames in shelves else None


def read_session(folder: Path) -> list[RecordedFrame | Spoilt]:
    """What a session's lines say, in their order. Raises SessionWrong where it cannot be read at all, naming it."""
    whole = stretches(folder, WHOLE)
    return [item for stretch in whole for panel in read(stretch) for item in panel]


def stretches(folder: Path, size: int, up_to: int | None = None) -> list[Stretch]:
    """The index in stretches of ``size`` bytes or a little more, as far as it went at ``up_to`` bytes.

    Raises SessionWrong where it cannot be read at all, naming it.
    """
    path = folder / INDEX
    try:
        with path.open("rb") as file:
            end = os.fstat(file.fileno()).st_size if up_to is None else up_to
            session.heading(file.readline().decode("utf-8"))
            cuts = [file.tell()]
            while cuts[-1] < end:
                cuts.append(min(_next_panel(file, cuts[-1] + size) if cuts[-1] + size < end else end, end))
    except OSError as error:
        raise SessionWrong(f"{path}: cannot be read ({error.strerror})") from error
    except ValueError as error:  # SessionWrong, and what is no UTF-8
        raise SessionWrong(f"{path}: {error}") from error
    return [Stretch(folder, start, stop) for start, stop in pairwise(cuts)]


def read(stretch: Stretch) -> Iterator[list[RecordedFrame | Spoilt]]:
    """What the lines say, those of one panel together, without panels that are counted elsewhere. Raises OSError."""
    elsewhere = _images(stretch.counted_in) if stretch.counted_in else {}
    for panel in _panels(stretch):
        if not all(_is_among(item, elsewhere) for item in panel):
            yield panel


def _images(shelf: Path) -> dict[str, list[Path]]:
    """The images in a shelf's sessions by their names. Raises OSError."""
    found: dict[str, list[Path]] = {}
    for folder in shelf.iterdir():
        with suppress(FileNotFoundError, NotADirectoryError):  # deleted meanwhile, or no session
            for name in os.listdir(folder):
                found.setdefault(name, []).append(folder / name)
    return found


def _is_among(item: RecordedFrame | Spoilt, images: Mapping[str, Sequence[Path]]) -> bool:
    """Whether the frame's image is one of these, linked or copied; one that was kept as one of the last only is not."""
    if not isinstance(item, RecordedFrame) or item.inspected is None or item.inspected.kept is Kept.LAST:
        return False
    with suppress(OSError):
        return any(cmp(item.image, other) for other in images.get(item.recorded.file, ()))
    return False


def _panels(stretch: Stretch) -> Iterator[list[RecordedFrame | Spoilt]]:
    panel: list[RecordedFrame | Spoilt] = []
    with (stretch.folder / INDEX).open("rb") as file:
        file.seek(stretch.start)
        lines = file.read(stretch.stop - stretch.start).split(b"\n")
        before = _Before(file, stretch.start)
    for n, line in enumerate(lines):
        if n == len(lines) - 1 and not line:
            break
        item = _item(stretch.folder, line, n, before, whole=n < len(lines) - 1)
        if panel and not _same_panel(_taken(panel[-1]), _taken(item)):
            yield panel
            panel = []
        panel.append(item)
    if panel:
        yield panel


class _Before:
    """How many lines an index has before ``start``: counted only where a line must be named."""

    def __init__(self, file: BinaryIO, start: int) -> None:
        self._name, self._start = file.name, start
        self._lines: int | None = None

    def lines(self) -> int:
        if self._lines is None:
            with open(self._name, "rb") as file:
                blocks = iter(lambda: file.read(min(BLOCK_BYTES, self._start - file.tell())), b"")
                self._lines = sum(block.count(b"\n") for block in blocks)
        return self._lines


def _item(folder: Path, line: bytes, n: int, before: _Before, whole: bool) -> RecordedFrame | Spoilt:
    """What the line says, the ``n``-th after those ``before`` it."""
    if not whole:
        number = before.lines() + n + 1
        return Spoilt(folder, number, f"line {number}: cut short, as by a power cut: its frame is not told")
    try:
        recorded = session.recorded(UNCOUNTED, line.decode("utf-8"))
        return RecordedFrame(folder, recorded, inspected(recorded))
    except ValueError as error:  # SessionWrong, and what is no UTF-8
        number = before.lines() + n + 1
        why = str(error).removeprefix(f"line {UNCOUNTED}: ")
        return Spoilt(folder, number, f"line {number}: {why}")


def _taken(item: RecordedFrame | Spoilt) -> Recorded | None:
    return item.recorded if isinstance(item, RecordedFrame) else None


def _same_panel(one: Recorded | None, after: Recorded | None) -> bool:
    """Whether the second of two lines goes on with the first one's panel; no line that cannot be read does."""
    if one is None or after is None or one.beyond.get("sequence") is None:
        return False
    alike = all(one.beyond.get(key) == after.beyond.get(key) for key in ("sequence", "panel_id", "frames"))
    return alike and _number(after) > _number(one)


def _number(recorded: Recorded) -> int:
    number = recorded.beyond.get("number")
    return number if isinstance(number, int) else -1


def _next_panel(file: BinaryIO, after: int) -> int:
    """Where a panel begins, ``after`` so many bytes and a line or two."""
    file.seek(after)
    file.readline()
    last = _readable(file.readline())
    while True:
        at = file.tell()
        line = file.readline()
        this = _readable(line)
        if not line or not _same_panel(last, this):
            return at
        last = this


def _readable(line: bytes) -> Recorded | None:
    try:
        return session.recorded(UNCOUNTED, line.decode("utf-8"))
    except ValueError:
        return None
