"""The index of a recorded session: a JSON line about the station, then one for each frame, beside the images.

Written line by line, so that a power cut can cost the last line only; a reader passes over a last line that is cut
short. What a line says besides how the frame was taken, such as what was found in it, is handed on as it is.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields

INDEX = "session.jsonl"
"""Name of the index in a session's folder."""
VERSION = 1


class SessionWrong(ValueError):
    """The index cannot be read; the text names the line and what to do."""


@dataclass(frozen=True, slots=True)
class Recorded:
    """One frame as it was taken: file beside the index, the camera's id, Unix time s, exposure us and lamp V.

    ``exposure_us`` and ``lamp_v`` as read back, None where they were not known; the others as asked for.
    """

    file: str
    frame_id: int
    taken_at_s: float
    exposure_us: float | None
    exposure_set_us: float
    lamp_v: float | None
    lamp_set_v: float
    beyond: Mapping[str, object] = field(default_factory=dict)
    """What else the line says, of no concern to a camera."""


def first_line(about: Mapping[str, object]) -> str:
    """The line about the station: its name, settings' hash and whatever else explains the frames."""
    return json.dumps({"session": VERSION, **about}, ensure_ascii=False) + "\n"


def line(recorded: Recorded) -> str:
    """One frame's line."""
    said = {name: value for name, value in asdict(recorded).items() if name != "beyond"}
    return json.dumps({**recorded.beyond, **said}, ensure_ascii=False, allow_nan=False) + "\n"


def parse(text: str) -> tuple[Recorded, ...]:
    """The frames of an index, in their order. Raises SessionWrong."""
    whole, _, _ = text.rpartition("\n")  # a last line without its end was cut short
    lines = whole.split("\n")
    heading(text)
    return tuple(recorded(number, text) for number, text in enumerate(lines[1:], 2))


def heading(text: str) -> dict[str, object]:
    """What the first line of an index says of the station. Raises SessionWrong."""
    said = _mapping(1, text.partition("\n")[0])
    if said.get("session") != VERSION:
        raise SessionWrong(f"line 1: session is {said.get('session')!r}, not {VERSION}: take a program that knows it")
    return said


_TAKEN = tuple(field.name for field in fields(Recorded) if field.name != "beyond")


def recorded(number: int, text: str) -> Recorded:
    """The frame of one line, the ``number``-th of its index. Raises SessionWrong."""
    said = _mapping(number, text)
    values = {name: said.pop(name, None) for name in _TAKEN}
    file = values["file"]
    if not isinstance(file, str) or not file or "/" in file or file in (".", ".."):
        raise SessionWrong(f"line {number}: file is {file!r}, not a name beside the index: take the line out")
    for name, value in values.items():
        may_miss = name in ("exposure_us", "lamp_v") and value is None
        if name != "file" and not may_miss and (isinstance(value, bool) or not isinstance(value, int | float)):
            raise SessionWrong(f"line {number}: {name} is {value!r}, not a number: take the line out")
    return Recorded(**values, beyond=said)  # type: ignore[arg-type]  # looked through just now


def _mapping(number: int, text: str) -> dict[str, object]:
    try:
        said = json.loads(text)
    except ValueError as error:
        raise SessionWrong(f"line {number}: {error}: take the line out") from error
    if not isinstance(said, dict):
        raise SessionWrong(f"line {number}: not a JSON object: take the line out")
    return said
