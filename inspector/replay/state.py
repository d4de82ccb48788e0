"""How far a replay has come, in a file: a line about the replay, then one for each part that is done."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from importlib.metadata import version as release
from pathlib import Path
from typing import Any

from inspector.replay.plan import Plan
from inspector.replay.tally import Tally

VERSION = 1


class OfAnother(Exception):
    """The file is of another replay, or no state of one; the message says what to do."""


def program_release() -> str:
    """The release of this program, as the machine it is asked on has it."""
    return release("seed-inspector")


def program(paths: Sequence[Path], *of: object) -> str:
    """Tells runs apart: by this program's release, what is read, and whatever else decides what comes out."""
    told = [program_release(), [str(path.resolve()) for path in paths], *of]
    return hashlib.sha256(repr(told).encode()).hexdigest()


class State:
    """The file at ``path``, made if it is not there; ``of`` tells replays apart. Raises OfAnother, OSError."""

    def __init__(self, path: Path, of: str, plan: Plan) -> None:
        self.path, self.plan = path, plan
        self.done: dict[int, Tally] = {}
        whole = path.read_bytes().rpartition(b"\n")[0] if path.exists() else b""
        if whole:
            self._read(whole.split(b"\n"), of)
        self._file = path.open("wb")
        self._write({"replay": VERSION, "of": of, "plan": self.plan.as_json()})
        for number, counted in self.done.items():
            self.add(number, counted)

    def add(self, number: int, counted: Tally) -> None:
        """A part is done. Raises OSError."""
        self._write({"part": number, "tally": counted.as_json()})

    def _write(self, said: dict[str, Any]) -> None:
        self._file.write(json.dumps(said).encode() + b"\n")
        self._file.flush()

    def _read(self, lines: list[bytes], of: str) -> None:
        try:
            heading = json.loads(lines[0])
            if (heading["replay"], heading["of"]) != (VERSION, of):
                raise OfAnother(f"{self.path} is of another replay: remove it, or name another file (--state)")
            self.plan = Plan.of_json(heading["plan"])
        except (ValueError, KeyError, TypeError) as error:
            raise OfAnother(
                f"{self.path} is no state of a replay: remove it, or name another file (--state)"
            ) from error
        for line in lines[1:]:
            try:
                said = json.loads(line)
                self.done[int(said["part"])] = Tally.of_json(said["tally"])
            except (ValueError, KeyError, TypeError):
                break  # a power cut in mid-line: what follows is done again

    def close(self) -> None:
        """Leave the file for the next run."""
        self._file.close()

    def remove(self) -> None:
        """The replay is complete."""
        self._file.close()
        self.path.unlink(missing_ok=True)
