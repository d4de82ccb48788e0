"""Power cut at any moment: what no fsync brought to the disk is gone, and what the PLC was shown as kept is there."""

from __future__ import annotations

import os
import random
from collections.abc import Callable
from pathlib import Path
from threading import Event
from typing import Any

import pytest

from firmware_bridge.simulators.module_server import ModuleServer
from tests.support.lives import Life
from tests.support.whole_archive import Images, sequences

CUTS = int(os.environ.get("CUTS", "5"))
FILE_SYSTEM = os.environ.get("FILE_SYSTEM", "ext4")
LEAST_MB = {"ext4": 64, "xfs": 320}


@pytest.mark.long
@pytest.mark.timeout(60 + 30 * CUTS)
def test_what_the_plc_was_shown_as_kept_outlives_a_power_cut_at_any_moment(
    station: Any, module: Callable[[], ModuleServer], wait_until: Callable[..., Any], disk: Any, tmp_path: Path
) -> None:
    module()
    archive = station.folder / "archive"
    own = disk(archive, LEAST_MB[FILE_SYSTEM], FILE_SYSTEM)
    station.settings["archive"] = {"folder": "archive", "frames": {"min_free_mb": 0, "passing_every": 2, "most_mb": 20}}
    station.settings["camera"]["rate_hz"] = 0
    station.write()
    chance, kept, last, images, lines = random.Random(), set[int](), 0, 0, 0
    for cut in range(1, CUTS + 1):
        with Life(station.file, tmp_path / "output", wait_until) as life:
            watcher = life.watched()
            life.shows(watcher, chance.randrange(25))
            Event().wait(chance.random() * 0.05)
            kept |= watcher.stored  # whom the power is cut shows nothing afterwards
            own.cut_power()
            life.kill()
            watcher.join()
        own.power_on()
        assert (watcher.first or 0) >= last, "the sequence went back"
        last = max(kept, default=0)
        found = sequences(archive, tmp_path / "copy")
        assert found == sorted(set(found))
        assert kept <= set(found), f"shown as kept and not on the disk: {sorted(kept - set(found))}"
        looked = Images(archive)
        images, lines = images + looked.check(every=5), lines + looked.inspected
        print(
            f"{cut} cuts on {FILE_SYSTEM}, {len(kept)} results shown as kept, {images} images, {lines} proved",
            flush=True,
        )
    assert "set aside" not in life.log
