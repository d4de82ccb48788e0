"""New settings are on trial: those that do not bring the station to Ready are taken back, also over a restart."""

from __future__ import annotations

import json
import shutil
import signal
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from firmware_bridge.simulators.module_server import ModuleServer
from inspector.archive.store import FILE
from inspector.faults import Fault
from inspector.model import Snapshot, State
from inspector.publish.registers import Status
from inspector.service.last_good import NAME, Begun, begin
from inspector.service.settings_trial import SettingsTrial, works
from inspector.settings import Settings, SettingsError, load

CONFIG = Path(__file__).parents[2] / "config"
READY, BROKEN = Snapshot(state=State.READY), Snapshot(state=State.ERROR, fault_code=Fault.CAMERA_GONE)
WARMING = Snapshot(state=State.INITIALIZED, fault_code=Fault.LAMP_WARMING_UP)
BETWEEN = Snapshot(state=State.INITIALIZED)
AFTER_S = 30.0
DEMO = load(CONFIG / "demo.yaml")


def named(station: str) -> Settings:
    return DEMO.model_copy(update={"station": station})


class Clock:
    """A clock that the test moves."""

    def __init__(self) -> None:
        self.now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


@pytest.mark.parametrize(("shown", "expected"), [(READY, True), (WARMING, True), (BROKEN, False), (BETWEEN, False)])
def test_a_station_works_when_its_devices_do(shown: Snapshot, expected: bool) -> None:
    assert works(shown) is expected


@given(st.lists(st.sampled_from(["reload", "ready", "broken", "wait", "wait long"]), max_size=25))
def test_settings_are_taken_back_only_from_a_station_that_was_ready_and_had_its_time(events: list[str]) -> None:
    clock, number, shown = Clock(), 0, BETWEEN
    trial = SettingsTrial(CONFIG / "demo.yaml", Begun(named("0")), clock=clock)
    good: str | None = None
    on_trial_since: float | None = None
    for event in events:
        if event == "reload":
            number += 1
            if good is not None and (works(shown) or on_trial_since is not None):
                on_trial_since = clock.now_s
            trial.tries(named(str(number)), shown)
            shown = BETWEEN
        elif event.startswith("wait"):
            clock.now_s += AFTER_S if event == "wait long" else 1
        else:
            shown = READY if event == "ready" else BROKEN
            trial.saw(shown)
            if event == "ready":
                good, on_trial_since = trial.settings.station, None
        late = on_trial_since is not None and clock.now_s - on_trial_since >= AFTER_S
        assert trial.overdue is late
        if late:
            assert trial.go_back().station == trial.settings.station == good
            on_trial_since = None
            assert not trial.overdue


def test_null_leaves_new_settings_whatever_they_bring() -> None:
    clock = Clock()
    trial = SettingsTrial(CONFIG / "demo.yaml", Begun(DEMO), clock=clock)
    trial.saw(READY)
    trial.tries(DEMO.model_copy(update={"cycle": DEMO.cycle.model_copy(update={"rollback_after_s": None})}), READY)
    clock.now_s = 1e9
    assert not trial.overdue


@pytest.fixture
def copied(tmp_path: Path) -> Path:
    """A settings file with its calibration, to spoil; the state's folder is beside it."""
    shutil.copytree(CONFIG, tmp_path / "etc")
    (tmp_path / "state").mkdir()
    return tmp_path / "etc/demo.yaml"


def started(file: Path) -> tuple[Begun, SettingsTrial]:
    """As the service starts."""
    begun = begin(file, file.parents[1] / "state")
    return begun, SettingsTrial(file, begun, file.parents[1] / "state")


def kept_good(file: Path) -> SettingsTrial:
    """As a run that reached Ready leaves it."""
    _, trial = started(file)
    trial.saw(READY)
    return trial


def test_a_calibration_that_was_replaced_is_taken_back_with_the_settings(copied: Path) -> None:
    calibration = copied.parent / "calibration/demo.yaml"
    was = calibration.read_text()
    trial = kept_good(copied)
    calibration.write_text(was.replace("width_px: 640", "width_px: 1280"))
    assert calibration.read_text() != was
    trial.tries(load(copied), READY)
    assert trial.go_back().calibration.read_text() == was
    # Over a restart: the file is right in itself, and still the one that was taken back.
    begun, again = started(copied)
    assert begun.refused
    assert begun.settings.calibration.read_text() == was
    again.saw(READY)
    assert started(copied)[0].refused
    again.tries(load(copied), READY)
    again.saw(READY)
    assert not started(copied)[0].refused


def test_a_refused_file_begins_with_the_last_good_settings_and_is_named(
    copied: Path, caplog: pytest.LogCaptureFixture
) -> None:
    good = kept_good(copied).settings
    copied.write_text(copied.read_text().replace("rate_hz: 4", "rate_hz: -4"))
    begun, _ = started(copied)
    assert (begun.settings, begun.refused) == (good, True)
    assert "camera.rate_hz: -4" in caplog.text
    assert "fault 503" in caplog.text


@pytest.mark.parametrize("spoil", ["missing", "garbage", "of another file", "of another program"])
def test_without_a_usable_copy_a_refused_file_is_refused(copied: Path, spoil: str) -> None:
    kept_good(copied)
    kept = copied.parents[1] / "state" / NAME
    said = json.loads(kept.read_text())
    match spoil:
        case "missing":
            kept.unlink()
        case "garbage":
            kept.write_bytes(b"\xff{")
        case "of another file":
            kept.write_text(json.dumps(said | {"file": "/elsewhere.yaml"}))
        case _:
            del said["good"]["settings"]["calibration"]
            kept.write_text(json.dumps(said))
    copied.write_text("{")
    with pytest.raises(SettingsError):
        started(copied)


def test_over_the_wire_settings_that_fail_are_taken_back_and_a_restart_keeps_the_good_ones(
    station: Any, module: Callable[[], ModuleServer], service: Callable[..., Any], tmp_path: Path
) -> None:
    def refused(registers: dict[str, Any]) -> bool:
        return Status.SETTINGS_REFUSED in Status(int(registers["status"]))

    module()
    (tmp_path / "state").mkdir()
    state = {"STATE_DIRECTORY": str(tmp_path / "state")}
    station.settings["cycle"]["rollback_after_s"] = 1
    station.settings["archive"] = {"folder": "archive", "frames": {"min_free_mb": 0}}
    station.write()
    running = service(**state)
    before = running.until_inspecting()
    spoilt = yaml.safe_load(station.file.read_text())
    spoilt["module"]["link"]["port"] = str(tmp_path / "no such port")
    station.file.write_text(yaml.safe_dump(spoilt))
    running.send(signal.SIGHUP)
    on_trial = running.until(lambda r: r["fault_code"] == Fault.MODULE_GONE, "the new settings on trial")
    assert not refused(on_trial)
    back = running.until(lambda r: r["verdict"] and refused(r), "the old ones again")
    assert back["configuration_hash"] == before["configuration_hash"]
    assert any("the last good ones are in force again" in line for line in running.log)
    running.send(signal.SIGKILL)
    running.ended()
    with closing(sqlite3.connect(station.folder / "archive" / FILE)) as store:
        done = store.execute("SELECT what, detail FROM action WHERE who = 'settings' ORDER BY at_s").fetchall()
    assert [what for what, _ in done] == ["taken over", "last good again", "refused"]
    assert done[1][1] == f"{before['configuration_hash']:08x}"
    again = service(**state)
    shown = again.until_inspecting()
    assert refused(shown)
    assert shown["configuration_hash"] == before["configuration_hash"]
    station.write()
    again.send(signal.SIGHUP)
    again.until(lambda r: r["verdict"] and not refused(r), "a good file")
