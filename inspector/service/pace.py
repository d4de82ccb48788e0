"""What begins a cycle, by the settings."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

from inspector.acquire.trigger import Asked, Calls, Clock, Input, Line, Trigger
from inspector.cycle_settings import ByHand, ByPlc, CycleSettings, DigitalInput, HardwareLine, Timed


@dataclass(frozen=True, slots=True)
class Sources:
    """Where triggers come from: the module's inputs, calls by hand, the PLC's TRIGGER (infinite: there is none)."""

    read_input: Callable[[int], bool]
    take_calls: Callable[[], list[float]]
    plc_trigger_s: Callable[[], float]


def trigger_of(cycle: CycleSettings, sources: Sources, online: bool, missed: int = 0, late: int = 0) -> Trigger:
    """The trigger that the settings choose, its counts going on; offline only the PLC's, which asks for itself."""
    late_s, choice = cycle.late_after_s, cycle.trigger
    if isinstance(choice, ByPlc):
        return Asked(sources.plc_trigger_s, late_s, missed, late)
    if not online:
        return Asked(lambda: math.inf, late_s, missed, late)
    match choice:
        case Timed():
            return Clock(choice.rate_hz, time.monotonic(), late_s, missed, late)
        case DigitalInput():
            wanted = choice.active == "on"
            return Input(
                lambda: sources.read_input(choice.channel) is wanted,
                choice.debounce_s,
                choice.poll_s,
                late_s,
                missed,
                late,
            )
        case HardwareLine():
            return Line(late_s, missed, late)
        case ByHand():
            sources.take_calls()  # what came before was not for it
            return Calls(sources.take_calls, late_s, missed, late)
        case _:
            return Trigger(late_s, missed, late)


def one_by_one(cycle: CycleSettings) -> bool:
    """Whether each inspection is asked for, rather than many until further notice."""
    return isinstance(cycle.trigger, ByHand | ByPlc)


def by_plc(cycle: CycleSettings) -> bool:
    """Whether the PLC's TRIGGER begins a cycle."""
    return isinstance(cycle.trigger, ByPlc)
