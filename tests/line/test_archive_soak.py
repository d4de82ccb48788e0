"""Frames flat out, with the archive on: nothing grows, and the same frame always has the same result."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from threading import Event
from typing import Any

import cv2
import pytest
import yaml

from firmware_bridge.simulators.module_server import ModuleServer
from firmware_bridge.simulators.module_state import SimulatedModule
from firmware_bridge.wire.profiles import PROFILES
from inspector.archive.store import FILE
from tests.line.conftest import PROFILE, Plc, Station, simulated_module
from tests.support.lives import Life

SOAK_FRAMES = int(os.environ.get("SOAK_FRAMES", "4000"))
WARM_FRAMES = 8_000
"""Until then caches fill: the store's pages, the log beside it, what statistics remember."""
LOOKS = 20
GROWTH_BYTES = 2**20


@pytest.fixture(params=["serial", "quick"])
def flat_out(request: pytest.FixtureRequest, station: Station) -> Iterator[Station]:
    """A station that waits for nothing but its module. The quick one does so by TCP, without silences between requests,
    and sees the middle of each frame only, where one seed is too high: twice as many frames in a time, and more."""
    if request.param == "quick":
        server = ModuleServer(SimulatedModule(PROFILES[PROFILE], lambda: 0.0), 1, tcp=True).start()
        host, port = server.address.split(":")
        station.settings["module"]["link"] = {"kind": "tcp", "host": host, "port": int(port)}
        _see_the_middle_only(station)
    else:
        server = simulated_module(station)
    station.settings["camera"]["rate_hz"] = 0
    yield station
    server.stop()


def _see_the_middle_only(station: Station) -> None:
    for path in station.frames.iterdir():
        cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[120:360, 160:480])
    calibration = yaml.safe_load(Path(station.settings["calibration"]).read_text())
    calibration["camera"] |= {"width_px": 320, "height_px": 240, "cx_px": 160.0, "cy_px": 120.0}
    station.settings["calibration"] = str(station.folder / "calibration.yaml")
    (station.folder / "calibration.yaml").write_text(yaml.safe_dump(calibration))
    station.settings["recipe"]["limits"]["max_height_um"] = 1700


@pytest.mark.long
@pytest.mark.timeout(300 + (WARM_FRAMES + SOAK_FRAMES) // 4)
def test_nothing_grows_and_each_pass_finds_the_same(
    flat_out: Station, wait_until: Callable[..., Any], tmp_path: Path
) -> None:
    flat_out.settings["archive"] = {"folder": "archive", "frames": {"min_free_mb": 0, "last": 0, "most_mb": 20}}
    flat_out.write()
    with Life(flat_out.file, tmp_path / "output", wait_until) as life:
        looks = list(_looks(life, wait_until))
        life.stop()
    resident, files, threads = zip(*looks, strict=True)
    assert max(resident[1:]) < resident[0] + GROWTH_BYTES, looks
    assert max(threads) == min(threads), looks
    assert max(files) <= min(files) + 4, looks  # an image, its folder, an index and a log that are open at the moment
    with closing(sqlite3.connect(flat_out.folder / "archive" / FILE)) as store:
        found = store.execute(
            "SELECT count(*), count(DISTINCT f.name), count(DISTINCT f.name || r.verdict || ' ' || r.reasons || ' ' ||"
            " r.reasons_text || ' ' || r.defect_count || ' ' || coalesce(r.largest_height_um, '-'))"
            " FROM result r JOIN frame f ON f.result = r.id"
        ).fetchone()
    assert found[0] >= SOAK_FRAMES
    assert found[1] == found[2] == len(list(flat_out.frames.iterdir()))


def _looks(life: Life, wait_until: Callable[..., Any]) -> Iterator[tuple[int, int, int]]:
    process = Path(f"/proc/{life.process.pid}")
    with closing(Plc(life.port)) as plc:
        for number in range(LOOKS + 1):
            frames = WARM_FRAMES + SOAK_FRAMES * number // LOOKS
            _until(plc, frames, wait_until)
            found = _look(process)
            print(f"{frames} frames: {found[0] / 2**20:.2f} MiB, {found[1]} files, {found[2]} threads", flush=True)
            yield found


def _until(plc: Plc, frames: int, wait_until: Callable[..., Any]) -> None:
    """Wait for so many results, for as long as they come."""
    while (now := plc.read()["sequence_u32"]) < frames:
        wait_until(lambda now=now: plc.read()["sequence_u32"] > now, f"a result after {now}", 60)
        Event().wait(min(1.0, (frames - now) / 1000))  # not asked of it all the time


def _look(process: Path) -> tuple[int, int, int]:
    """Resident bytes, open files and threads."""
    resident = int((process / "statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    return resident, len(list((process / "fd").iterdir())), len(list((process / "task").iterdir()))
