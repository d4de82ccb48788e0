"""The archive's disk full, read-only, gone, hanging: no result is missed, the PLC is told, and all is there again."""

from __future__ import annotations

import os
import resource
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest

from firmware_bridge.simulators.module_server import ModuleServer
from inspector.archive.recorder import LEAST_FREE_FILES
from inspector.publish.registers import Status
from tests.support.disk import Disk
from tests.support.lives import Life, Watcher
from tests.support.whole_archive import Images, sequences

RESULTS = 40
LIMIT_BYTES = 100_000
"""Less than the store has then, more than the log of a life, which is a file too."""

Trouble = Callable[[Disk, Path, Life], Iterator[Callable[[], None]]]
"""Makes trouble, yields what keeps it up, and ends it."""


def full(_: Disk, archive: Path, __: Life) -> Iterator[Callable[[], None]]:
    ballast = archive / "ballast"

    def fill() -> None:
        with suppress(OSError), ballast.open("ab", buffering=0) as file:
            for size in (2**20, 2**12, 1):
                with suppress(OSError):
                    while file.write(bytes(size)) == size:
                        pass

    yield fill
    ballast.unlink()


def too_large(_: Disk, __: Path, life: Life) -> Iterator[Callable[[], None]]:
    """Files may not grow: as by a quota or a limit of the unit."""
    pid = life.process.pid
    assert pid is not None
    before = resource.prlimit(pid, resource.RLIMIT_FSIZE, (LIMIT_BYTES, resource.RLIM_INFINITY))
    yield lambda: None
    resource.prlimit(pid, resource.RLIMIT_FSIZE, before)


def read_only(disk: Disk, _: Path, __: Life) -> Iterator[Callable[[], None]]:
    """As the kernel does when it finds the file system wrong; it is checked, and mounted again."""
    disk.fail()
    yield lambda: None
    disk.power_on()


def pulled(disk: Disk, _: Path, __: Life) -> Iterator[Callable[[], None]]:
    disk.pull()
    yield lambda: None
    disk.mount()


def hanging(_: Disk, archive: Path, __: Life) -> Iterator[Callable[[], None]]:
    subprocess.run(["fsfreeze", "--freeze", str(archive)], check=True, timeout=60)
    try:
        yield lambda: None
    finally:
        subprocess.run(["fsfreeze", "--unfreeze", str(archive)], check=True, timeout=60)


@pytest.mark.long
@pytest.mark.parametrize("trouble", [full, too_large, read_only, pulled, hanging])
def test_no_result_is_missed_and_all_are_kept_when_the_disk_is_back(
    trouble: Trouble,
    station: Any,
    module: Callable[[], ModuleServer],
    wait_until: Callable[..., Any],
    disk: Any,
    tmp_path: Path,
) -> None:
    module()
    archive = station.folder / "archive"
    own = disk(archive)
    station.settings["archive"] = {"folder": "archive", "frames": {"min_free_mb": 0}}
    station.settings["camera"]["rate_hz"] = 0
    station.write()
    with Life(station.file, tmp_path / "output", wait_until) as life:
        watcher = life.watched()
        life.shows(watcher, RESULTS)
        with contextmanager(trouble)(own, archive, life) as keep_up:

            def told() -> bool:
                keep_up()
                return bool(watcher.status & Status.STORE_DEGRADED) and "results' store fails" in life.log

            wait_until(told, f"STORE_DEGRADED, and the log is told; log: {life.log}", 80)
            life.shows(watcher, len(watcher.shown) + RESULTS)
        before = watcher.shown[-1]
        _until_kept(watcher, before, wait_until, life)
        life.stop()
        watcher.join()
    found = sequences(archive, tmp_path / "copy")
    assert found == list(range(1, found[-1] + 1))
    assert found[-1] >= watcher.shown[-1]
    assert Images(archive).check(every=5)
    assert life.log.count("results' store fails") == 1, life.log
    assert life.log.count("results' store works again") == 1, life.log
    assert "set aside" not in life.log
    assert "Traceback" not in life.log


@pytest.mark.long
def test_a_disk_that_is_not_mounted_at_the_start_is_waited_for(
    station: Any, module: Callable[[], ModuleServer], wait_until: Callable[..., Any], disk: Any, tmp_path: Path
) -> None:
    module()
    mounted = station.folder / "mounted"
    own = disk(mounted)
    own.pull()
    station.settings["archive"] = {"folder": "mounted/archive", "disk": "mounted", "frames": {"min_free_mb": 0}}
    station.settings["plc"]["sequence_file"] = "sequence.json"
    station.settings |= {"recipe_choice_file": "recipe.json", "statistics_file": "statistics.json"}
    station.settings["camera"]["rate_hz"] = 0
    station.write()
    with Life(station.file, tmp_path / "output", wait_until) as life:
        watcher = life.watched()
        life.shows(watcher, RESULTS)
        assert not watcher.stored
        assert "no disk is mounted there" in life.log
        assert not list(mounted.iterdir())
        own.mount()
        _until_kept(watcher, watcher.shown[-1], wait_until, life)
        life.stop()
        watcher.join()
    found = sequences(mounted / "archive", tmp_path / "copy")
    assert found == list(range(1, found[-1] + 1))


@pytest.mark.long
def test_without_inodes_the_oldest_frames_go_and_no_result_waits(
    station: Any, module: Callable[[], ModuleServer], wait_until: Callable[..., Any], disk: Any, tmp_path: Path
) -> None:
    module()
    archive = station.folder / "archive"
    disk(archive, 64, "ext4", "-N", "800")
    for number in range(os.statvfs(archive).f_favail - LEAST_FREE_FILES - 40):
        (archive / f"{number}.taken").touch()
    station.settings["archive"] = {"folder": "archive", "frames": {"min_free_mb": 0, "passing_every": 1, "last": 0}}
    station.settings["camera"]["rate_hz"] = 0
    station.write()
    with Life(station.file, tmp_path / "output", wait_until) as life:
        watcher = life.watched()
        wait_until(lambda: "frames of session" in life.log, f"a session is deleted; log: {life.log}", 100)
        after = watcher.shown[-1]
        wait_until(lambda: _newest(archive) > after, "frames are kept again", 100)
        life.stop()
        watcher.join()
    found = sequences(archive, tmp_path / "copy")
    assert found == list(range(1, found[-1] + 1))
    assert "results' store fails" not in life.log


def _newest(archive: Path) -> int:
    """The sequence of the newest frame."""
    return max((int(path.name.partition("-")[0]) for path in archive.glob("*/*/*.png")), default=0)


def _until_kept(watcher: Watcher, after: int, wait_until: Callable[..., Any], life: Life) -> None:
    def kept() -> bool:
        return not watcher.status & Status.STORE_DEGRADED and watcher.shown[-1] > after

    wait_until(kept, f"kept again; log: {life.log}", 90)
