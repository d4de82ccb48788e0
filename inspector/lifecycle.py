"""The station's states: (state, event) -> state, as one table; names as in OPC 40100-1 (machine vision), section 8.

Differences from that document: ERROR is left by itself when the fault is gone (the line needs nobody to confirm it),
and by way of INITIALIZED, so that a recipe is prepared anew for devices that may have been changed.
"""

from __future__ import annotations

import enum

from inspector.model import State


class Event(enum.Enum):
    """What happens to a station."""

    CONFIGURED = "settings are read and the registers are served"
    PREPARED = "every device is open and the recipe is loaded"
    UNPREPARED = "new settings are being taken over"
    STARTED_SINGLE = "one inspection was asked for"
    STARTED_CONTINUOUS = "inspections were asked for until further notice"
    FINISHED = "the one inspection is done"
    STOPPED = "no more inspections were asked for"
    FAULT = "a device or the program failed"
    RECOVERED = "what failed works again"
    HALTED = "the station is going off"
    RESET = "the station is put back to its beginning"


_WORKING = (State.INITIALIZED, State.READY, State.SINGLE_EXECUTION, State.CONTINUOUS_EXECUTION)

TRANSITIONS: dict[tuple[State, Event], State] = {
    (State.PREOPERATIONAL, Event.CONFIGURED): State.INITIALIZED,
    (State.PREOPERATIONAL, Event.FAULT): State.ERROR,
    (State.PREOPERATIONAL, Event.HALTED): State.HALTED,
    (State.INITIALIZED, Event.PREPARED): State.READY,
    (State.READY, Event.UNPREPARED): State.INITIALIZED,
    (State.READY, Event.STARTED_SINGLE): State.SINGLE_EXECUTION,
    (State.READY, Event.STARTED_CONTINUOUS): State.CONTINUOUS_EXECUTION,
    (State.SINGLE_EXECUTION, Event.FINISHED): State.READY,
    (State.SINGLE_EXECUTION, Event.STOPPED): State.READY,
    (State.CONTINUOUS_EXECUTION, Event.STOPPED): State.READY,
    (State.ERROR, Event.RECOVERED): State.INITIALIZED,
    (State.ERROR, Event.HALTED): State.HALTED,
    (State.ERROR, Event.RESET): State.PREOPERATIONAL,
    (State.HALTED, Event.RESET): State.PREOPERATIONAL,
    **{(state, Event.FAULT): State.ERROR for state in _WORKING},
    **{(state, Event.HALTED): State.HALTED for state in _WORKING},
    **{(state, Event.RESET): State.PREOPERATIONAL for state in _WORKING},
}
"""Every pair that moves the station. Any other pair leaves the state as it is: the event does not concern it."""


def after(state: State, *events: Event) -> State:
    """The state after ``events``, in their order."""
    for event in events:
        state = TRANSITIONS.get((state, event), state)
    return state


def mermaid() -> str:
    """The table as a Mermaid state diagram."""
    arrows = [f"    {old.name} --> {new.name}: {event.name}" for (old, event), new in TRANSITIONS.items()]
    return "\n".join(["stateDiagram-v2", f"    [*] --> {State.PREOPERATIONAL.name}", *arrows])


def markdown() -> str:
    """The page of the manual on the station's states, made from the table."""
    events = [f"| {event.name} | {event.value} |" for event in Event]
    return "\n".join(
        [
            "# States of the station",
            "",
            "Made from `inspector/lifecycle.py` by `inspector states`; a test fails when this page is stale.",
            "Names are those of OPC 40100-1. An event that no arrow carries leaves the state as it is.",
            "",
            "```mermaid",
            mermaid(),
            "```",
            "",
            "| event | what happened |",
            "| --- | --- |",
            *events,
            "",
        ]
    )
