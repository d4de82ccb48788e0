"""The table of states: every pair, the states' meaning for verdicts, and the manual's page."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest

from inspector.lifecycle import TRANSITIONS, Event, after, markdown
from inspector.model import State

PAGE = Path(__file__).parents[2] / "deploy" / "plc" / "states.md"


@pytest.mark.parametrize(("state", "event"), list(itertools.product(State, Event)))
def test_every_pair_has_a_defined_end(state: State, event: Event) -> None:
    assert after(state, event) is TRANSITIONS.get((state, event), state)


def test_no_arrow_leads_nowhere_and_every_event_and_state_is_used() -> None:
    assert not [pair for pair, new in TRANSITIONS.items() if pair[0] is new]
    assert {event for _, event in TRANSITIONS} == set(Event)
    assert set(TRANSITIONS.values()) == set(State)


@pytest.mark.parametrize("state", list(State))
def test_a_fault_stops_whatever_runs_and_a_halt_ends_everything(state: State) -> None:
    assert after(state, Event.FAULT) in (State.ERROR, State.HALTED)
    assert after(state, Event.HALTED) is State.HALTED
    assert after(state, Event.RESET) is State.PREOPERATIONAL


def test_a_station_starts_fails_and_comes_back() -> None:
    running = after(State.PREOPERATIONAL, Event.CONFIGURED, Event.PREPARED, Event.STARTED_CONTINUOUS)
    assert running is State.CONTINUOUS_EXECUTION
    assert after(running, Event.PREPARED, Event.STARTED_CONTINUOUS) is running
    failed = after(running, Event.FAULT)
    assert after(failed, Event.PREPARED, Event.STARTED_CONTINUOUS) is State.ERROR
    assert after(failed, Event.RECOVERED, Event.PREPARED, Event.STARTED_CONTINUOUS) is running


def test_one_inspection_ends_ready() -> None:
    assert after(State.READY, Event.STARTED_SINGLE, Event.FINISHED) is State.READY


def test_the_page_is_current() -> None:
    assert PAGE.read_text() == markdown(), "run: make docs"
