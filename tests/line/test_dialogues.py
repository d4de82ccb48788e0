"""The integrator's dialogues, played over the wire: every value that the page shows is what a PLC reads."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from inspector import handshake
from inspector.commands.handshake_page import as_markdown
from inspector.dialogues import DIALOGUES, TRACKED, Deed, Dialogue, Inspects, Obeys, Reconnects, Writes, played
from inspector.handshake_table import TABLE, Event, Step
from inspector.model import Verdict
from inspector.publish.registers import CONTROL_ADDRESS
from inspector.service import daemon
from tests.line.conftest import Plc
from tests.line.test_daemon import Bench, bench

__all__ = ["bench"]

PAGE = Path(__file__).parents[2] / "deploy" / "plc" / "handshake.md"
PATIENT = {"kind": "replay", "paths": ["frames"], "deadline_s": 60}
"""The camera is waited for as long as a test takes, and the cycle does not count as stalled meanwhile."""


def test_the_page_is_current() -> None:
    assert PAGE.read_text() == as_markdown(), "run: make docs"


def test_the_dialogues_show_every_row_of_the_table(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: set[tuple[Step, Event]] = set()

    class Watched(dict[Any, Any]):
        def get(self, pair: Any, default: Any = None) -> Any:
            if pair in self:
                seen.add(pair)
            return super().get(pair, default)

    monkeypatch.setattr(handshake, "TABLE", Watched(TABLE))
    for dialogue in DIALOGUES:
        list(played(dialogue))
    assert {(step.name, event.name) for step, event in set(TABLE) - seen} == set()


class Stage:
    """The service at work, its camera and its commands held back until the dialogue comes to them."""

    def __init__(self, station: Bench, wait_until: Callable[..., Any], held: threading.Semaphore) -> None:
        self._station, self._wait_until, self._held = station, wait_until, held
        self._frames = 0
        self.plc = Plc(station.daemon.port)

    def does(self, deed: Deed) -> None:
        match deed:
            case Writes():
                panel_id, argument = (divmod(n, 0x10000) for n in (deed.control_panel_id, deed.command_argument))
                words = (deed.control, deed.acknowledged_sequence, *panel_id, deed.command, 0, *argument)
                assert self.plc.write(CONTROL_ADDRESS, *words) == 0
            case Inspects():
                self._frames += 1
                says = ZeroDivisionError("a bug") if deed.verdict is None else deed.verdict
                self._station.says[self._frames] = says
                self._station.camera.permits.release()
            case Obeys():
                self._held.release()
            case Reconnects():
                self.plc.close()
                self.plc = Plc(self._station.daemon.port)

    def shows(self, expected: dict[str, int], when: str) -> None:
        """Wait until the registers are as expected; if they do not come to be, show both."""
        last: dict[str, Any] = {}

        def met() -> bool:
            read = self.plc.read()
            last.update({name: read[name] for name in TRACKED})
            return last == expected

        try:
            self._wait_until(met, when)
        except pytest.fail.Exception:
            assert last == expected, when


@pytest.fixture
def stage(
    bench: Callable[..., Bench], wait_until: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[[str], Stage]]:
    """``stage(trigger)``: a service triggered so, with recipes 1 and 2."""
    held, carried_out, made = threading.Semaphore(0), daemon.carried_out, []

    def hold(*args: Any) -> Any:
        assert held.acquire(timeout=20)
        return carried_out(*args)

    monkeypatch.setattr(daemon, "carried_out", hold)

    def start(trigger: str) -> Stage:
        recipes = [{"id": 1, "name": "one"}, {"id": 2, "name": "two"}]
        station = bench(cycle={"trigger": {"kind": trigger}}, camera=PATIENT, recipe=1, recipes=recipes)
        made.append(Stage(station, wait_until, held))
        return made[-1]

    yield start
    held.release(100)
    for each in made:
        each.plc.close()


@pytest.mark.parametrize("dialogue", DIALOGUES, ids=lambda dialogue: dialogue.title)
def test_each_dialogue_is_what_a_plc_reads(dialogue: Dialogue, stage: Callable[[str], Stage]) -> None:
    station = stage(dialogue.trigger)
    for number, (deed, expected) in enumerate(played(dialogue)):
        if deed is not None:
            station.does(deed)
        station.shows(expected, f"step {number}: {deed}")


def test_a_dialogue_that_is_not_kept_to_is_seen(stage: Callable[[str], Stage]) -> None:
    """The comparison above can fail."""
    station = stage("plc")
    (_, begins), *_ = played(DIALOGUES[0])
    station.shows(begins, "the beginning")
    with pytest.raises(AssertionError, match="the end"):
        Stage.shows(_Impatient(station), begins | {"verdict": Verdict.PASS}, "the end")


class _Impatient(Stage):
    """Looks once."""

    def __init__(self, stage: Stage) -> None:
        self.plc = stage.plc
        self._wait_until = lambda met, what: met() or pytest.fail(what)
