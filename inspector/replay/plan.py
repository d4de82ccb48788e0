"""How sessions are shared out: in parts that follow from their indices' sizes alone, so that an interrupted run finds
the same parts again, also where sessions have grown meanwhile."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from firmware_bridge.wire.session import INDEX, SessionWrong
from inspector.sessions import Spoilt, Stretch, counted_in, find, stretches

Part = tuple[Stretch | Spoilt, ...]


@dataclass(frozen=True)
class Plan:
    """Folders of sessions, each with how many bytes of its index are read, and the parts' size in bytes."""

    sessions: tuple[tuple[str, int], ...]
    part_bytes: int

    @classmethod
    def of(cls, paths: Sequence[Path], part_bytes: int) -> Plan:
        """Of the sessions among and below these paths, as they are now."""
        return cls(tuple((str(folder), (folder / INDEX).stat().st_size) for folder in find(paths)), part_bytes)

    def parts(self) -> list[Part]:
        """The parts in their order: several short sessions, or a stretch of a long one."""
        parts: list[Part] = []
        gathered: list[Stretch | Spoilt] = []
        size = 0
        for piece in self._pieces():
            gathered.append(piece)
            size += piece.stop - piece.start if isinstance(piece, Stretch) else 0
            if size >= self.part_bytes:
                parts.append(tuple(gathered))
                gathered, size = [], 0
        return [*parts, tuple(gathered)] if gathered else parts

    def _pieces(self) -> Iterator[Stretch | Spoilt]:
        folders = [Path(folder) for folder, _ in self.sessions]
        shelves = {folder.parent for folder in folders}
        for folder, (_, size) in zip(folders, self.sessions, strict=True):
            try:
                found = stretches(folder, self.part_bytes, size)
            except SessionWrong as error:
                yield Spoilt(folder, 0, str(error))
            else:
                yield from (replace(stretch, counted_in=counted_in(folder, shelves)) for stretch in found)

    def as_json(self) -> dict[str, Any]:
        """As a state file keeps it."""
        return {"sessions": self.sessions, "part_bytes": self.part_bytes}

    @classmethod
    def of_json(cls, said: dict[str, Any]) -> Plan:
        """The plan of :meth:`as_json`. Raises KeyError, TypeError, ValueError."""
        return cls(tuple((str(folder), int(size)) for folder, size in said["sessions"]), int(said["part_bytes"]))
