"""Whether the clock is kept right: asked now and then, told once when it changes, shown to the PLC."""

from __future__ import annotations

import logging
import os
from pathlib import Path

import pytest

from inspector import clock
from inspector.model import Snapshot
from inspector.publish.registers import Status, decode, encode


class Kernel:
    """What adjtimex(2) answers."""

    def __init__(self, state: int) -> None:
        self.state = state

    def adjtimex(self, _: object) -> int:
        return self.state


@pytest.mark.parametrize(
    ("state", "stamp_age_s", "expected"),
    [
        (0, None, True),
        (clock.TIME_ERROR, 0.0, False),
        (-1, None, False),
        (-1, 60.0, True),
        (-1, clock.STAMP_LASTS_S + 60, False),
    ],
)
def test_the_kernel_is_asked_and_who_may_not_ask_it_looks_at_the_stamp(
    state: int, stamp_age_s: float | None, expected: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stamp = tmp_path / "synchronized"
    monkeypatch.setattr(clock, "STAMP", stamp)
    monkeypatch.setattr(clock.ctypes, "CDLL", lambda *_, **__: Kernel(state))
    if stamp_age_s is not None:
        stamp.touch()
        at_s = clock.time.time() - stamp_age_s
        os.utime(stamp, (at_s, at_s))
    assert clock.synchronised() is expected


def test_a_change_is_said_once_and_asked_for_once_a_minute(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    now_s, answers = [0.0], [True, False, False, True, True]
    watch = clock.ClockWatch(ask=lambda: answers.pop(0), clock=lambda: now_s[0])
    seen = []
    for now_s[0] in range(0, 300, 20):
        seen.append(watch.unsynchronised)
    assert seen == [False] * 3 + [True] * 6 + [False] * 6
    assert [record.levelname for record in caplog.records] == ["WARNING", "INFO"]


@pytest.mark.parametrize("wrong", [True, False])
def test_the_plc_is_told(wrong: bool) -> None:
    block = encode(Snapshot(clock_unsynchronised=wrong), 0.0, 0)
    words = [int.from_bytes(block[at : at + 2], "big") for at in range(0, len(block), 2)]
    assert (Status.CLOCK_UNSYNCHRONISED in Status(int(decode(words)["status"] or 0))) is wrong
