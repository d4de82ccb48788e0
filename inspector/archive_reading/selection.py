"""Which results a command is asked for: a span of times or of sequences, and a recipe."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, date, datetime, time, timedelta
from typing import Any

from inspector.change_options import Unusable

LARGEST_SEQUENCE = 0xFFFF_FFFF
A_TIME = "allowed: a sequence, or a time such as 2026-11-26T14:30, 2026-11-26T13:30Z or 2026-11-26"


@dataclass(frozen=True, slots=True)
class Selection:
    """``begins_s`` to before ``ends_s``, Unix time; sequences ``first`` to ``last``; ``recipe`` by id or name. None:
    not asked for."""

    begins_s: float | None = None
    ends_s: float | None = None
    first: int | None = None
    last: int | None = None
    recipe: str | None = None


def of(begin: str | None, end: str | None, recipe: str | None = None) -> Selection:
    """The selection that these texts say: sequences, or times, those without a zone in the machine's. A day alone
    begins as it does and ends as it does. Raises Unusable."""
    found: dict[str, Any] = {"recipe": recipe}
    for option, text, names in (("--from", begin, ("begins_s", "first")), ("--to", end, ("ends_s", "last"))):
        if text is not None and text.isascii() and text.isdigit():
            found[names[1]] = min(int(text), LARGEST_SEQUENCE)
        elif text is not None:
            found[names[0]] = _unix_s(option, text)
    return Selection(**found)


def _unix_s(option: str, text: str) -> float:
    try:
        if re.fullmatch(r"\d{4}-\d\d-\d\d", text):
            day = date.fromisoformat(text) + timedelta(days=option == "--to")
            return local_s(day, time())
        return datetime.fromisoformat(text).timestamp()
    except (ValueError, OverflowError, OSError) as error:
        raise Unusable(f"{option} {text!r}: {A_TIME}") from error


def local_s(day: date, at: time) -> float:
    """Unix time of a time of day by the machine's clock on the wall."""
    return datetime.combine(day, at).timestamp()


def shift(text: str, shifts: Mapping[str, str]) -> Selection:
    """The times of DATE/HH:MM-HH:MM, or of DATE/NAME with its name among ``shifts``, in the machine's time zone; one
    that ends no later than it begins ends on the next day. Raises Unusable."""
    day, _, name = text.partition("/")
    try:
        begin, end = (time.fromisoformat(part) for part in shifts.get(name, name).split("-"))
        begins_on = date.fromisoformat(day)
        ends_on = begins_on + timedelta(days=end <= begin)
        return Selection(local_s(begins_on, begin), local_s(ends_on, end))
    except (ValueError, OverflowError, OSError) as error:
        known = ", ".join(shifts) or "none; settings key shifts names them"
        allowed = f"allowed: DATE/HH:MM-HH:MM or DATE/NAME, such as 2026-11-26/06:00-14:00; names: {known}"
        raise Unusable(f"shift {text!r}: {allowed}") from error


def iso(unix_s: float | None) -> str | None:
    """A time as ISO 8601, UTC, to the microsecond; None where there is none, or none that a calendar has."""
    if unix_s is None:
        return None
    try:
        return datetime.fromtimestamp(unix_s, UTC).isoformat(timespec="microseconds").replace("+00:00", "Z")
    except (ValueError, OverflowError, OSError):
        return None
