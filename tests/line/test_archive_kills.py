"""The service killed at any moment, again and again: what the PLC was shown as kept is there, and all is whole."""

from __future__ import annotations

import os
import random
import time
from collections.abc import Callable
from pathlib import Path
from threading import Event
from typing import Any

import pytest

from firmware_bridge.simulators.module_server import ModuleServer
from inspector.handshake_table import Control
from tests.support.lives import Life
from tests.support.plc_program import PlcProgram
from tests.support.whole_archive import Images, sequences

KILLS = int(os.environ.get("KILLS", "2"))
LOOK_EVERY = 25


@pytest.fixture
def archive(station: Any) -> Path:
    kept = {"min_free_mb": 0, "passing_every": 2, "most_mb": 40}
    station.settings["archive"] = {"folder": "archive", "frames": kept}
    station.settings["camera"]["rate_hz"] = 0
    station.write()
    return Path(station.folder / "archive")


@pytest.mark.timeout(60 + 20 * KILLS)
def test_what_the_plc_was_shown_as_kept_outlives_a_kill_at_any_moment(
    station: Any,
    archive: Path,
    module: Callable[[], ModuleServer],
    wait_until: Callable[..., Any],
    tmp_path: Path,
) -> None:
    module()
    chance, images, kept, last = random.Random(), Images(archive), set[int](), 0
    polls, served_s = 0, list[float]()
    for kill in range(1, KILLS + 1):
        # A PLC that only looks, or one that takes each result, of those that are held for it.
        program = PlcProgram(keep=Control.BUFFER_RESULTS, last_taken=last) if kill % 2 else None
        begun_s = time.monotonic()
        with Life(station.file, tmp_path / "output", wait_until) as life:
            if chance.random() < 0.15:  # while it starts, before anybody can ask it
                Event().wait(chance.random())
                watcher = None
            else:
                watcher = life.watched(program)
                served_s.append(time.monotonic() - begun_s)
                life.shows(watcher, chance.randrange(40))
                Event().wait(chance.random() * 0.02)
        if watcher is not None:
            watcher.join()
            seen = [watcher.first or 0, *watcher.shown]
            assert seen == sorted(set(seen)), "the sequence went back within a life"
            assert seen[0] >= last, "the sequence went back over a kill"
            kept |= watcher.stored
            last, polls = seen[-1], polls + watcher.polls
        if kill % LOOK_EVERY == 0 or kill == KILLS:
            _look(archive, tmp_path, kept, images)
            print(f"{kill} kills, {len(kept)} results shown as kept", flush=True)
    print(f"\n{KILLS} kills, {polls} polls, {len(kept)} results shown as kept, {images.inspected} inspected again;")
    print(f"first answer after {max(served_s, default=0):.2f} s at most")
    with Life(station.file, tmp_path / "output", wait_until) as life:
        watcher = life.watched()
        wait_until(lambda: watcher.stored, f"a result kept, with no lock in the way; log: {life.log}")
    watcher.join()
    assert "set aside" not in life.log


def _look(archive: Path, folder: Path, kept: set[int], images: Images) -> None:
    found = sequences(archive, folder / "copy")
    assert found == sorted(set(found))
    assert kept <= set(found), f"shown as kept and not in the store: {sorted(kept - set(found))}"
    images.check()
