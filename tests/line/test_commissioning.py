"""The page for putting a station into service, carried out: mbpoll's commands against a running station, in order."""

from __future__ import annotations

import re
import shlex
import subprocess
from collections.abc import Callable
from typing import Any

import pytest
import yaml
from typer.testing import CliRunner

from firmware_bridge.errors import DeviceGone, NoReply
from inspector.cli.app import app
from inspector.integrator.commissioning import MBPOLL, SEQUENCE, STEPS, ByHand, Check, Look, Run, Write
from inspector.model import Defect, FrameResult, Reason, Verdict
from tests.line.test_daemon import Bench, FakeCamera, bench

__all__ = ["bench"]

SEED = Defect(12.34, -5.6, 1827.6, 9.0, (0.0, 0.0), (0.0, 0.0))
SECTIONS: dict[str, Any] = {
    "cycle": {"trigger": {"kind": "plc"}, "retry_first_s": 0.05, "retry_longest_s": 0.2},
    "plc": {"port": 0, "sequence_file": "sequence.json"},
    "statistics_file": "statistics.json",
    "recipes": "recipes",
    "recipe": 1,
}


class Engineer:
    """Who carries the page out: types its commands, and does at the fake devices what is done by hand."""

    def __init__(self, mbpoll: str, start: Callable[..., Bench], wait_until: Callable[..., Any]) -> None:
        self._mbpoll, self._start, self._wait_until = mbpoll, start, wait_until
        self._before: dict[str, float] = {}
        self.station = self._started()

    def _started(self, **sections: Any) -> Bench:
        station = self._start(**sections)
        station.says = {n: FrameResult("f", Verdict.FAIL, Reason.HEIGHT_LIMIT, defects=(SEED,)) for n in range(1, 50)}
        station.camera.permits.release(1000)
        return station

    def does(self, check: Check) -> None:
        match check:
            case Look():
                self._wait_until(lambda: self._looks(check), f"{check}; before: {self._before}")
            case Write():
                assert "Written" in self._types(check.command_line)
            case Run():
                self._runs(check)
            case ByHand():
                self._acts(check.act)

    def _looks(self, check: Look) -> bool:
        (said,) = re.findall(r"^\[\d+\]:\s+(\S+)", self._types(check.command), re.MULTILINE)
        value = int(said, 16) if said.startswith("0x") else float(said)
        if holds := check.holds(value, self._before):
            self._before[check.register] = value
        return holds

    def _types(self, command: str) -> str:
        """What mbpoll says to a command of the page."""
        assert command.startswith(MBPOLL)
        told = {"HOST": "127.0.0.1", "PORT": str(self.station.daemon.port), "mbpoll": self._mbpoll}
        told[SEQUENCE] = f"{self._before.get('sequence', 0):.0f}"
        words = [told.get(word, word) for word in shlex.split(command)]
        done = subprocess.run(words, capture_output=True, text=True, timeout=30, check=False)
        assert done.returncode == 0, f"{words}: {done.stdout} {done.stderr}"
        return done.stdout

    def _runs(self, check: Run) -> None:
        _, *words = (str(self.station.station.file) if word == "FILE" else word for word in shlex.split(check.command))
        assert CliRunner().invoke(app, words).exit_code == 0

    def _acts(self, act: str) -> None:
        match act:
            case "pull module":
                self.station.lamp.fails = NoReply("module", "no answer")
            case "put back module":
                self.station.lamp.fails = None
            case "pull camera":
                self.station.camera.script = [DeviceGone("camera", "gone")] * 10_000
            case "put back camera":
                self.station.camera.script = []
            case "restart":
                port = self.station.daemon.port
                self.station.stop()
                self.station = self._started(plc=SECTIONS["plc"] | {"port": port})
            case unknown:
                assert unknown == "", "what nobody here can do has no name"


@pytest.fixture
def engineer(
    bench: Callable[..., Bench],
    station: Any,
    peer: Callable[[str, str], str],
    wait_until: Callable[..., Any],
    monkeypatch: pytest.MonkeyPatch,
) -> Engineer:
    """At a station that is triggered by the PLC and has recipes 1 and 2; no device counts as simulated."""
    (station.folder / "recipes").mkdir()
    for number in (1, 2):
        file = station.folder / "recipes" / f"{number}.yaml"
        file.write_text(yaml.safe_dump({"id": number, "name": f"recipe {number}"}))
    monkeypatch.setattr(FakeCamera, "simulated", False)
    program = peer("mbpoll", "mbpoll")
    return Engineer(program, lambda **more: bench(**SECTIONS | more), wait_until)


def test_every_step_of_the_page_ends_as_it_says(engineer: Engineer) -> None:
    for step in STEPS:
        for check in step.checks:
            engineer.does(check)


def test_a_check_that_does_not_hold_is_seen() -> None:
    look = Look("status", among=(4,), on=4, off=8, than_before="other", rounds_to="sequence")
    assert look.holds(4, {"status": 0, "sequence": 4})
    assert not [
        (value, before)
        for value, before in (
            (5, {"status": 0, "sequence": 5}),
            (12, {"status": 0, "sequence": 12}),
            (4, {"status": 4, "sequence": 4}),
            (4, {"status": 0, "sequence": 3}),
        )
        if look.holds(value, before)
    ]
