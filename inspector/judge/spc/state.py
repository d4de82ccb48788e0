"""All that the statistics remember: plain data, written to a file and read back exactly."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache
from typing import Literal

from pydantic import ConfigDict, TypeAdapter, ValidationError

from inspector.judge.spc.baseline import Learning
from inspector.judge.spc.charts import Cusum, Ewma
from inspector.judge.spc.panel import Bounds
from inspector.judge.spc.spread import Neighbours
from inspector.line_statistics import Rule


@dataclass(slots=True)
class Seen:
    """What is kept of a panel of the window. ``expected``: defects by its recipe's baseline, None without one."""

    recipe_id: int
    count: int = 0
    area_m2: float = 0.0
    expected: float | None = None
    heights_um: list[float] = field(default_factory=list)
    neighbours: Neighbours | None = None
    cell_chance: float = 0.0
    """How probable it was that a given cell is hit."""
    cells: tuple[int, ...] = ()
    bounds_mm: Bounds = (0.0, 0.0, 0.0, 0.0)


@dataclass(slots=True)
class Charts:
    """What a reset begins anew; baselines outlive it."""

    panels: int = 0
    not_inspected: int = 0
    charted: int = 0
    """Panels that entered EWMA and CUSUM."""
    ewma: Ewma = field(default_factory=Ewma)
    cusum: Cusum = field(default_factory=Cusum)
    height_group: list[float] = field(default_factory=list)
    """Standardised mean heights of the panels of the group that is not full yet."""
    height_means: list[float] = field(default_factory=list)
    """Of the latest groups, oldest first."""
    run_rule: int = 0
    alarms: dict[Rule, int] = field(default_factory=dict)
    """Rules that were broken, and for how many panels more each stands."""
    window: list[Seen] = field(default_factory=list)
    """The last inspected panels: an outage, however long, does not empty it."""
    inspected: list[bool] = field(default_factory=list)
    """Of the last panels, whether each was."""


@dataclass(slots=True)
class State:
    """Charts, and the baseline of each recipe by its id, the latest used last."""

    __pydantic_config__ = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)

    version: Literal[1] = 1
    charts: Charts = field(default_factory=Charts)
    recipes: dict[int, Learning] = field(default_factory=dict)


@cache
def _adapter() -> TypeAdapter[State]:
    """Made when a state is first written or read: a start need not wait for it."""
    return TypeAdapter(State)


def to_json(state: State) -> str:
    """The state as JSON text; :func:`from_json` gives it back exactly."""
    return _adapter().dump_json(state).decode()


def from_json(text: str) -> State:
    """Raises ValueError that names the place of what is wrong."""
    try:
        return _adapter().validate_json(text)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        place = ".".join(map(str, first["loc"]))
        raise ValueError(f"{place}: {first['msg']}" if place else first["msg"]) from error
