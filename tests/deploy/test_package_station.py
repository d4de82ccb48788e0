"""A station from the package: page beside a service with secrets, frames of 12 megapixels, a backup restored."""

from __future__ import annotations

import contextlib
import json
import re
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import booted
import cv2
import pytest
import yaml
from browser import Browser
from installed import PYTHON, STATE, a_result, as_documented, install, set_up

pytestmark = [pytest.mark.long, pytest.mark.timeout(1200)]

KEY = "inspector-plc.key"
RECIPES = [
    {"id": 1, "name": "lenient", "limits": {"max_height_um": 3000}},
    {"id": 2, "name": "strict", "limits": {"max_height_um": 100}},
]
WIDTH_PX = 4096
MEMORY_MAX = 1 << 30
"""Bytes, as the unit has it."""
PANELS = 40
"""Results of large frames, one after another."""


@pytest.fixture(scope="module")
def booted_files(debian_files: Path) -> Path:
    """A clean Debian 12, in place of this machine's files."""
    return debian_files


def with_key(machine: Any) -> dict[str, str]:
    """Certificates for everybody, the key for root alone; the settings that name them."""
    etc, store = machine.root / "etc/inspector", machine.root / "etc/credstore"
    made = ["-keyout", str(store / KEY), "-out", str(etc / "plc.pem")]
    kind = ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes", "-subj", "/CN=station"]
    subprocess.run(["openssl", "req", "-x509", *kind, *made], check=True, capture_output=True, timeout=60)
    (etc / "plc.pem").chmod(0o644)
    (store / KEY).chmod(0o400)
    return {"certificate": "plc.pem", "key": f"credential:{KEY}", "client_ca": "plc.pem"}


def property_of(machine: Any, unit: str, name: str) -> str:
    return str(machine.run("systemctl", "show", f"--property={name}", "--value", unit).stdout.strip())


def test_the_page_shows_and_commands_a_station_whose_key_it_may_not_read(
    machine: Any, package: Path, peer: Callable[[str, str], str], wait_until: Callable[..., Any]
) -> None:
    peer("openssl", "openssl")
    install(machine, package)
    plc = {"port": 502, "tls": with_key(machine)}
    set_up(machine, plc=plc, recipes=RECIPES, recipe=1, archive={"folder": "/var/lib/inspector/archive"})
    a_result(machine, wait_until)
    machine.run("systemctl", "enable", "--now", "inspector-page")
    page = Browser(8080)

    def state() -> dict[str, Any]:
        found: dict[str, Any] = machine.in_network(page.state)
        return found

    wait_until(lambda: state()["verdict"]["name"] == "PASS", "the verdict on the page")
    status, told = machine.in_network(lambda: page.command("CHANGE_RECIPE", 2))
    assert status == 202
    ended = wait_until(lambda: (c := state()["command"])["outcome"] != "running" and c, "the command's end")
    assert (ended["number"], ended["outcome"]) == (told["number"], "done")
    wait_until(lambda: state()["verdict"]["name"] == "FAIL", "judged by the other recipe")
    assert "PASS" not in state()["verdict"]["name"]
    user = property_of(machine, "inspector-page", "MainPID"), property_of(machine, "inspector", "MainPID")
    assert len({machine.run("ps", "-o", "uid=", "-p", pid).stdout.strip() for pid in user}) == len(user)
    assert machine.run("inspector", "health", "--config", "/etc/inspector/line.yaml").returncode == 0
    machine.run("systemctl", "restart", "inspector-page")
    wait_until(lambda: state()["verdict"]["name"] == "FAIL", "the page that was started again")
    assert property_of(machine, "inspector-page", "NRestarts") == "0"


def with_large_frames(machine: Any, frames: Path) -> dict[str, Any]:
    """A recorded frame and its calibration, as a sensor of 12 megapixels sees the same; the settings that name them."""
    calibration = yaml.safe_load((frames / "calibration.yaml").read_text())
    camera = calibration["camera"]
    share = WIDTH_PX / camera["width_px"]
    camera |= {"width_px": WIDTH_PX, "height_px": round(camera["height_px"] * share)}
    camera |= {name: camera[name] * share for name in ("cx_px", "cy_px")}
    camera |= {name: camera[name] / share for name in ("dx_mm", "dy_mm")}
    (machine.root / "etc/inspector/calibration/large.yaml").write_text(yaml.safe_dump(calibration))
    seen = cv2.imread(str(frames / "four_seeds.png"), cv2.IMREAD_GRAYSCALE)
    image = cv2.resize(seen, (WIDTH_PX, camera["height_px"]), interpolation=cv2.INTER_CUBIC)
    cv2.imwrite(str(machine.root / "etc/inspector/large.png"), image)
    replay = {"kind": "replay", "paths": ["large.png"], "rate_hz": 4, "deadline_s": 10}
    return {"calibration": "calibration/large.yaml", "camera": replay}


def test_frames_of_12_megapixels_are_inspected_and_kept_in_the_memory_that_the_unit_allows(
    machine: Any, package: Path, frames_folder: Path, wait_until: Callable[..., Any]
) -> None:
    install(machine, package)
    frames = {"failing": True, "passing_every": 1, "last": 10, "most_mb": 500}
    archive = {"folder": "/var/lib/inspector/archive", "frames": frames}
    set_up(machine, archive=archive, **with_large_frames(machine, frames_folder))
    wait_until(lambda: a_result(machine, wait_until) > PANELS, "results", 300)
    assert property_of(machine, "inspector", "NRestarts") == "0"
    assert property_of(machine, "inspector", "MemoryMax") == str(MEMORY_MAX)
    images = list((machine.root / STATE / "archive").rglob("*.png"))
    assert images
    status = machine.run("cat", f"/proc/{property_of(machine, 'inspector', 'MainPID')}/status").stdout
    (peak_kib,) = re.findall(r"VmHWM:\s+(\d+) kB", status)
    print(f"\n{len(images)} images; resident at most {int(peak_kib) / 1024:.0f} MiB")
    assert int(peak_kib) * 1024 < MEMORY_MAX / 2


ARCHIVE = "/var/lib/inspector/archive"
SAVED = "srv/backup"
ROWS = """
import hashlib, json, sqlite3, sys
store = sqlite3.connect(f"file:{sys.argv[1]}?mode=ro", uri=True)
digest = hashlib.sha256()
for table, key in (("result", "id"), ("frame", "result"), ("defect", "result")):
    for row in store.execute(f"SELECT * FROM {table} WHERE {key} >> 32 = 1 ORDER BY 1, 2"):
        digest.update(repr(row).encode())
last = "SELECT max(sequence), count(*) FROM result WHERE id >> 32 = 1"
first_since = "SELECT min(sequence) FROM result WHERE id >> 32 > 1"
print(json.dumps([*store.execute(last).fetchone(), digest.hexdigest(), *store.execute(first_since).fetchone()]))
"""


@pytest.fixture
def successor(booted_files: Path, tmp_path: Path) -> Iterator[Any]:
    """Another machine that has come up; nothing is installed."""
    folder = tmp_path / "successor"
    folder.mkdir()
    with contextlib.closing(booted.Booted(folder, booted_files)) as machine:
        machine.boot()
        yield machine


def kept(machine: Any, store: str) -> list[Any]:
    """Of the first run in a store: its last sequence, results, and a digest of all rows; then the next run's first."""
    found: list[Any] = json.loads(machine.run(PYTHON, "-I", "-c", ROWS, store).stdout)
    return found


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_a_backup_of_a_running_station_is_restored_on_another_computer_as_the_manual_prints_it(
    machine: Any, successor: Any, package: Path, wait_until: Callable[..., Any]
) -> None:
    install(machine, package)
    etc = machine.root / "etc/inspector"
    with (etc / "calibration/demo.yaml").open("a") as calibration:
        calibration.write("# of this station\n")
    (etc / "recipes/own.yaml").write_text("# of this station\n")
    set_up(machine, archive={"folder": ARCHIVE})
    before = a_result(machine, wait_until)
    as_documented(machine, "Back up while the station runs", "backup.md")
    settings = contents(etc)
    shutil.copytree(machine.root / SAVED, successor.root / SAVED)
    machine.cut_power()

    install(successor, package)
    for step in ("2. Stop the service", "3. Put the store", "4. Start"):
        as_documented(successor, step, "backup.md")
    assert contents(successor.root / "etc/inspector") == settings
    a_result(successor, wait_until, after=before)
    last, count, digest, _ = kept(successor, f"/{SAVED}/results.sqlite")
    assert before <= last == count
    *restored, first_since = kept(successor, f"{ARCHIVE}/results.sqlite")
    assert restored == [last, count, digest]
    assert first_since > last
    archive = successor.root / STATE / "archive"
    assert not list(archive.glob("*set-aside*"))
    owners = {path.lstat().st_uid for path in (archive, *archive.rglob("*"))}
    assert owners == {(successor.root / STATE).stat().st_uid}
    assert successor.run("systemctl", "is-enabled", "inspector").stdout.strip() == "enabled"
