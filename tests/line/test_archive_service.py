"""The archive of a running station: what the PLC has seen is in the store, whatever becomes of it or its disk."""

from __future__ import annotations

import json
import os
import shutil
import signal
import sqlite3
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import pytest
from typer.testing import CliRunner

from firmware_bridge.simulators.module_server import ModuleServer
from firmware_bridge.wire import session
from inspector import settings_version
from inspector.acquire.capture import Wanted
from inspector.archive import result_json, store_writer
from inspector.archive.session_frames import inspected, version_file
from inspector.archive.store import FILE
from inspector.cli.app import app
from inspector.handshake_table import Control
from inspector.metrics.table import ARCHIVE
from inspector.model import Frame, PanelFrame, PanelFrames, Snapshot
from inspector.pipeline import Station, inspect
from inspector.publish.registers import CONTROL_ADDRESS, Status
from inspector.reinspection import Reinspection
from inspector.service import ledger
from inspector.service.cycle import Turn
from inspector.service.ledger import Ledger
from inspector.settings import load
from inspector.settings_version import from_json


@pytest.fixture
def archive(station: Any) -> Path:
    station.settings["archive"] = {"folder": "archive", "frames": {"min_free_mb": 0}}
    station.settings["camera"]["rate_hz"] = 0
    station.write()
    return station.folder / "archive"


def read(archive: Path, sql: str) -> list[tuple[Any, ...]]:
    with closing(sqlite3.connect(archive / FILE)) as other:
        return other.execute(sql).fetchall()


def sequences(archive: Path) -> list[int]:
    return [row[0] for row in read(archive, "SELECT sequence FROM result ORDER BY id")]


def test_every_frame_kept_explains_its_result(
    station: Any, archive: Path, module: Callable[[], ModuleServer], service: Callable[..., Any]
) -> None:
    module()
    one = service("--panels", "40")
    assert one.ended() == 0
    assert sequences(archive) == list(range(1, 41))
    kept = read(archive, "SELECT result & 0xffffffff, image, kept FROM frame WHERE image IS NOT NULL")
    assert len(kept) == 40
    for sequence, image, why in kept:
        folder = (archive / image).parent
        line = next(r for r in session.parse((folder / session.INDEX).read_text()) if r.file == Path(image).name)
        said = inspected(line)
        assert said is not None
        assert (said.sequence, said.kept) == (sequence, why)
        version = from_json((folder / version_file(said.settings)).read_text())
        frame = Frame(cv2.imread(str(archive / image), cv2.IMREAD_UNCHANGED), line.file)
        assert result_json.same(inspect(frame, Station(version.calibration, version.recipe)), said.result)
        rows = read(archive, f"SELECT height_um FROM defect WHERE result & 0xffffffff = {sequence} ORDER BY number")
        assert [h for (h,) in rows] == [d.height_um for d in said.result.defects]
    assert read(archive, "SELECT name FROM settings_version") == [(said.settings,)]


def test_an_archive_is_replayed_as_it_was_each_frame_once(
    station: Any, archive: Path, module: Callable[[], ModuleServer], service: Callable[..., Any]
) -> None:
    """Panels of two frames, with a reference patch; the sample's frames are among the last ones too."""
    station.settings["archive"]["frames"] |= {"passing_every": 2, "last": 24}
    station.settings["light"] = {
        "patch": {"x_px": 8, "y_px": 8, "width_px": 48, "height_px": 48},
        "target_dn": 8,
        "tolerance": 0.9,
    }
    station.settings["panel"] = {
        "frames": {"kind": "count", "count": 2},
        "travel": {"by": {"kind": "pitch", "mm_per_frame": 5}, "direction_deg": 90},
    }
    station.write()
    module()
    assert service("--panels", "24").ended() == 0
    shelves = [{path.name for path in (archive / shelf).glob("*/*.png")} for shelf in ("frames", "last")]
    assert shelves[0] & shelves[1]
    done = CliRunner().invoke(app, ["replay", str(archive), "--jobs", "1", "--format", "json"])
    said = json.loads(done.stdout)
    frames = len(shelves[0] | shelves[1])
    assert (said["frames"], said["frames_same"], said["panels"]) == (frames, frames, frames // 2)
    assert (said["panels_same"], said["differences"], said["not_compared"]) == (frames // 2, [], [])
    assert done.exit_code == 0


def test_without_its_disk_the_line_goes_on_and_nothing_is_lost(
    station: Any, archive: Path, module: Callable[[], ModuleServer], service: Callable[..., Any]
) -> None:
    module()
    one = service()
    one.until(lambda r: r["sequence"] > 3 and not r["status"] & Status.STORE_DEGRADED, "stored results")
    # The folder goes, and a file takes its place: nothing can be opened there, not even by root.
    archive.rename(station.folder / "elsewhere")
    archive.write_text("no folder")
    lost = one.until(lambda r: r["status"] & Status.STORE_DEGRADED, "STORE_DEGRADED")
    later = one.until(lambda r: r["sequence"] > lost["sequence"] + 20 and r["verdict"], "inspection goes on")
    assert later["status"] & Status.STORE_DEGRADED
    assert later["store_waiting"] >= 20
    archive.unlink()
    shutil.move(station.folder / "elsewhere", archive)
    back = one.until(
        lambda r: r["sequence"] > later["sequence"] and not r["status"] & Status.STORE_DEGRADED, "it is back"
    )
    one.send(signal.SIGTERM)
    assert one.ended() == 0
    found = sequences(archive)
    assert found == list(range(1, found[-1] + 1))
    assert found[-1] >= back["sequence"]
    assert sum("results' store fails" in line for line in one.log) == 1
    assert sum("results' store works again" in line for line in one.log) == 1
    faults = read(archive, "SELECT code, ended_s >= began_s FROM fault WHERE code = 601")
    assert (601, 1) in faults


def test_what_waits_for_a_disk_goes_to_the_one_that_the_settings_name_instead(
    station: Any, archive: Path, module: Callable[[], ModuleServer], service: Callable[..., Any]
) -> None:
    module()
    one = service()
    one.until(lambda r: r["sequence"] > 3 and not r["status"] & Status.STORE_DEGRADED, "stored results")
    before, after = station.folder / "elsewhere", station.folder / "another"
    archive.rename(before)
    archive.write_text("no folder")
    one.until(lambda r: r["store_waiting"] >= 20, "results that wait")
    station.settings["archive"]["folder"] = after.name
    station.write()
    one.send(signal.SIGHUP)
    one.until(lambda _: (after / FILE).exists(), "the other archive")
    one.until(lambda r: r["verdict"] and not r["status"] & Status.STORE_DEGRADED, "stored results")
    one.send(signal.SIGTERM)
    assert one.ended() == 0
    found = sequences(before) + sequences(after)
    assert found == list(range(1, found[-1] + 1))
    versions = "SELECT count(*) FROM result WHERE settings NOT IN (SELECT name FROM settings_version)"
    assert read(after, versions) == [(0,)]


def test_results_survive_a_kill_though_their_log_was_deleted(
    station: Any, archive: Path, module: Callable[[], ModuleServer], service: Callable[..., Any]
) -> None:
    module()
    one = service()
    begun = one.until(lambda r: r["sequence"] > 3 and not r["status"] & Status.STORE_DEGRADED, "stored results")
    (archive / f"{FILE}-wal").unlink()
    later = begun["sequence"] + 20
    seen = one.until(lambda r: r["sequence"] > later and not r["status"] & Status.STORE_DEGRADED, "later ones")
    one.send(signal.SIGKILL)
    one.ended()
    assert set(range(1, seen["sequence"] + 1)) <= set(sequences(archive))


def test_frames_of_any_file_name_are_kept(
    station: Any, archive: Path, module: Callable[[], ModuleServer], service: Callable[..., Any]
) -> None:
    """A name of another encoding than UTF-8, from a disk of another system."""
    for frame in station.frames.iterdir():
        os.rename(frame, os.fsencode(station.frames / "a") + b"\xe4.png")
    module()
    assert service("--panels", "3").ended() == 0
    assert read(archive, "SELECT sequence, name LIKE '%a\\xe4.png' FROM frame, result ON id = result") == [
        (n, 1) for n in (1, 2, 3)
    ]


def test_a_damaged_store_is_set_aside_and_the_plc_is_told_until_it_clears(
    station: Any, archive: Path, module: Callable[[], ModuleServer], service: Callable[..., Any]
) -> None:
    module()
    archive.mkdir()
    (archive / FILE).write_bytes(b"this was a store once" * 1000)
    one = service()
    told = one.until(lambda r: r["status"] & Status.STORE_DAMAGED and r["verdict"], "STORE_DAMAGED")
    assert told["fault_code"] == 0
    assert one.plc().write(CONTROL_ADDRESS, Control.CLEAR_FAULT) == 0
    one.until(lambda r: not r["status"] & Status.STORE_DAMAGED, "cleared")
    one.send(signal.SIGTERM)
    assert one.ended() == 0
    (aside,) = archive.glob("results.set-aside-*.sqlite")
    assert aside.read_bytes() == b"this was a store once" * 1000
    assert sequences(archive)
    assert read(archive, "SELECT what FROM action") == [("CLEAR_FAULT",)]


def test_the_archive_offers_what_the_table_of_metrics_names(station: Any, archive: Path) -> None:
    ledger = Ledger()
    assert ledger.gauges() == {}
    ledger.take_over(load(station.file))
    assert set(ledger.gauges()) == {metric.name for metric in ARCHIVE}
    ledger.close()


def test_a_store_that_cannot_be_opened_is_told_before_there_is_a_result(
    station: Any, archive: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(store_writer, "SLOW_S", 0.0)
    archive.write_text("in the way")
    ledger = Ledger()
    ledger.take_over(load(station.file))
    assert ledger.shown(Snapshot()).store_degraded
    ledger.close()


def test_what_waited_for_a_disk_that_was_misnamed_is_kept_when_that_is_corrected(station: Any, archive: Path) -> None:
    station.settings["plc"]["sequence_file"] = "sequence.json"
    station.settings |= {"recipe_choice_file": "recipe.json", "statistics_file": "statistics.json"}
    station.settings["archive"]["disk"] = str(archive)
    misnamed = load(station.write())
    del station.settings["archive"]["disk"]
    corrected = load(station.write())
    ledger = Ledger()
    ledger.take_over(misnamed)
    ledger.acted("PLC", "before")
    ledger.burnt(1.0)
    ledger.take_over(corrected)
    ledger.acted("PLC", "after")
    ledger.close()
    assert read(archive, "SELECT what FROM action ORDER BY at_s") == [("before",), ("after",)]
    assert read(archive, "SELECT burnt_hours FROM lamp") == [(1.0,)]


def test_a_panel_of_several_frames_is_kept_as_one(
    station: Any, archive: Path, module: Callable[[], ModuleServer], service: Callable[..., Any]
) -> None:
    module()
    station.settings["panel"] = {
        "frames": {"kind": "count", "count": 3},
        "travel": {"by": {"kind": "pitch", "mm_per_frame": 5}},
    }
    station.write()
    assert service("--panels", "6").ended() == 0
    assert read(archive, "SELECT result & 0xffffffff, count(*), max(travel_mm) FROM frame GROUP BY result") == [
        (n, 3, 10.0) for n in range(1, 7)
    ]
    for index in archive.glob(f"*/*/{session.INDEX}"):
        said = [inspected(recorded) for recorded in session.parse(index.read_text())]
        places = [(one.number, one.panel is not None) for one in said if one]
        assert places == [(0, False), (1, False), (2, True)] * (len(said) // 3)


def test_a_panel_larger_than_memory_may_hold_has_a_row_for_each_frame(
    station: Any, archive: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ledger, "HELD_BYTES", 2 * 640 * 480)
    one, found_by = Ledger(), load(station.file)
    one.take_over(found_by)
    reinspection, parts = Reinspection(settings_version.of(found_by)), list[PanelFrame]()
    for number, file in enumerate(sorted(station.frames.iterdir())[:3]):
        image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        found = replace(reinspection.frame(image, file.name), highlights=None)
        frame = Frame(image, file.name, number, 1000.0, 4.0, 10.0 + number)
        one.took(Turn(Snapshot(), frame=frame, result=found, wanted=Wanted(1000.0, 4.0, 0.1, 0.1)))
        parts.append(PanelFrame(found, 5.0 * number))
    panel = replace(reinspection.panel(parts, 7, ()), gathered=PanelFrames(7, tuple(parts)))
    one.kept(Snapshot(sequence=1, panel_id=7, verdict=panel.verdict), (), panel)
    one.close()
    assert read(archive, "SELECT frame_count, number, image IS NOT NULL FROM frame JOIN result ON result = id") == [
        (3, 0, 1),
        (3, 1, 1),
        (3, 2, 0),
    ]
    done = CliRunner().invoke(app, ["replay", str(archive), "--format", "json"])
    said = json.loads(done.stdout)
    assert (said["frames"], said["frames_same"], said["panels"], said["differences"]) == (2, 2, 0, [])
