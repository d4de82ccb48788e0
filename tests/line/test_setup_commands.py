"""`inspector doctor`, `expose` and `lamp calibrate`, over stations that are whole and stations that are not."""

from __future__ import annotations

import json
import os
import shutil
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from drawn import Drawing
from typer.testing import CliRunner

from firmware_bridge import factory
from firmware_bridge.contracts import CameraCapabilities, CameraFrame
from firmware_bridge.errors import NoReply
from firmware_bridge.simulators.module_server import ModuleServer, WireFault
from inspector import yaml_edit
from inspector.cli.app import app
from inspector.commands import bench, doctor, expose, lamp_calibrate
from inspector.commands.doctor import Finding, State, examine
from inspector.settings import load

SPOTS = np.array([[200.3, 200.4], [212.7, 201.1]])
PATCH = {"x_px": 500, "y_px": 20, "width_px": 40, "height_px": 40}


def found(config: Path, **options: Any) -> dict[str, Finding]:
    return {finding.part: finding for finding in examine(config, **options)}


def test_a_whole_station_can_run_and_its_lamp_stays_dark(station: Any, module: Callable[[], ModuleServer]) -> None:
    server = module()
    done = CliRunner().invoke(app, ["doctor", "--config", str(station.file)])
    assert done.exit_code == 0, done.output
    parts = [line.split()[1] for line in done.output.splitlines()[:-1]]
    assert parts == [
        "settings", "calibration", "permissions", "device", "module", "lamp", "lamp", "camera", "exposure", "frame",
        "PLC", "disk", "clock",
    ]  # fmt: skip
    assert "lamp         set 0 V and read back: 0.000 V" in done.output
    assert done.output.splitlines()[-1] == "the station can run"
    assert server.module.output_v(0) == 0.0


def test_settings_that_everybody_may_write_are_a_warning_with_the_remedy(station: Any) -> None:
    station.file.chmod(0o666)
    done = CliRunner().invoke(app, ["doctor", "--config", str(station.file)])
    (line,) = (line for line in done.output.splitlines() if " permissions " in line)
    assert line.startswith("warning")
    assert line.endswith(f"-> chmod o-w {station.file}")


def test_the_report_is_data_too(station: Any, module: Callable[[], ModuleServer]) -> None:
    module()
    done = CliRunner().invoke(app, ["doctor", "--config", str(station.file), "--format", "json"])
    report = json.loads(done.output)
    assert report["can_run"] is True
    assert {"part", "state", "tried", "found", "remedy"} == set(report["findings"][0])


def test_without_its_devices_each_is_named_with_what_to_do_and_the_rest_is_still_tried(station: Any) -> None:
    shutil.rmtree(station.frames)
    seen = found(station.file)
    assert seen["device file"].state is State.FAILED
    assert (seen["module"].state, seen["lamp"].state) == (State.FAILED, State.SKIPPED)
    assert "cannot open" in seen["module"].found
    assert "by-id" in seen["module"].remedy
    assert (seen["camera"].state, seen["frame"].state) == (State.FAILED, State.SKIPPED)
    assert seen["disk"].state is State.OK
    assert CliRunner().invoke(app, ["doctor", "--config", str(station.file)]).exit_code == 1


def test_the_plcs_serial_line_is_tried_where_there_is_one(station: Any) -> None:
    assert "PLC line" not in found(station.file)
    station.settings["plc"]["serial"] = {"port": str(station.folder / "none")}
    station.write()
    line = found(station.file)["PLC line"]
    assert line.state is State.FAILED
    assert "cannot open" in line.found
    near, far = os.openpty()
    try:
        station.settings["plc"]["serial"]["port"] = os.ttyname(far)
        station.write()
        assert found(station.file)["PLC line"].state is State.OK
    finally:
        os.close(near)
        os.close(far)


def test_a_silent_module_is_told_with_what_to_check(station: Any, module: Callable[[], ModuleServer]) -> None:
    module().fault = WireFault.SILENT
    finding = found(station.file)["module"]
    assert finding.state is State.FAILED
    assert "no answer" in finding.found
    assert "unit id" in finding.remedy


def test_settings_that_are_refused_are_all_named(station: Any) -> None:
    station.settings |= {"stattion": "x", "lamp": {"channel": -1}}
    station.write()
    lines = [finding for finding in examine(station.file) if finding.part == "settings"]
    assert len(lines) == 2
    assert all(line.state is State.FAILED and line.remedy for line in lines)


def test_a_port_that_is_taken_and_a_frame_of_another_shape(station: Any, module: Callable[[], ModuleServer]) -> None:
    module()
    for path in station.frames.iterdir():
        path.unlink()
    np.save(station.frames / "small.npy", np.zeros((4, 6), np.uint8))
    with socket.create_server(("127.0.0.1", 0)) as taken:
        station.settings["plc"] = {"port": taken.getsockname()[1]}
        station.write()
        seen = found(station.file)
    assert seen["PLC port"].state is State.FAILED
    assert "6 x 4 px, the calibration is for 640 x 480" in seen["frame"].found


def test_an_old_calibration_a_full_disk_and_a_clock_never_set(
    station: Any, module: Callable[[], ModuleServer], monkeypatch: pytest.MonkeyPatch
) -> None:
    module()
    calibration = shutil.copy(station.settings["calibration"], station.folder)
    os.utime(calibration, (1e9, 1e9))
    station.settings["calibration"] = calibration
    station.write()
    monkeypatch.setattr(doctor.shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(10**9, 10**9, 10**6))
    monkeypatch.setattr(doctor.time, "time", lambda: 1.1e9)
    seen = found(station.file)
    assert "days old" in seen["calibration"].found
    assert (seen["calibration"].state, seen["disk"].state) == (State.WARNING, State.FAILED)
    assert "never set" in seen["clock"].found


def test_an_archive_that_cannot_be_written_or_has_no_room(station: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    assert "archive" not in found(station.file)
    station.settings["archive"] = {"folder": "kept/here", "frames": {"min_free_mb": 0}}
    station.write()
    assert found(station.file)["archive"].state is State.OK
    assert not (station.folder / "kept").exists()
    monkeypatch.setattr(doctor.shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(10**9, 10**9, 10**6))
    station.settings["archive"]["disk"] = "kept"
    station.settings["plc"]["sequence_file"] = "sequence.json"
    station.settings |= {"recipe_choice_file": "recipe.json", "statistics_file": "statistics.json"}
    station.write()
    assert "no disk is mounted" in found(station.file)["archive"].found
    del station.settings["archive"]["disk"]
    station.settings["archive"]["frames"]["min_free_mb"] = 2
    station.write()
    assert found(station.file)["archive"].state is State.WARNING
    (station.folder / "kept").write_text("no folder")
    seen = found(station.file)["archive"]
    assert seen.state is State.FAILED
    assert str(os.getuid()) in seen.remedy


def test_a_port_without_permission_names_the_user(station: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    station.serial.touch()
    monkeypatch.setattr(doctor.os, "access", lambda *_: False)
    finding = found(station.file)["device file"]
    assert finding.state is State.FAILED
    assert str(os.getuid()) in finding.remedy


class Scene:
    """Lamp and camera before a panel with two spots and a white patch. The lamp's light is the square of its level."""

    simulated = False

    def __init__(self, peak_dn: float = 4000.0) -> None:
        self.peak_dn, self.volts, self.exposure_us, self.taken = peak_dn, 0.0, 0.0, 0
        self.closed = 0
        self.levels: list[float] = []
        self.refuses: NoReply | None = None

    def open(self) -> None:
        if self.refuses:
            raise self.refuses

    def close(self) -> None:
        self.volts = 0.0
        self.closed += 1

    def keep_alive(self) -> None: ...

    def burnt_hours(self) -> float:
        return 0.0

    def set_volts(self, volts: float) -> float:
        self.levels.append(volts)
        self.volts = volts
        return volts

    def read_volts(self) -> float:
        return self.volts

    def capabilities(self) -> CameraCapabilities:
        return CameraCapabilities(1.0, 1e6, 1.0, 640, 480)

    def set_exposure_us(self, exposure_us: float) -> float:
        self.exposure_us = exposure_us
        return exposure_us

    def grab(self) -> CameraFrame:
        self.taken += 1
        light = (self.volts / 5) ** 2 * self.exposure_us / 1000
        drawing = Drawing(panel_dn=2.0 * light)
        image = drawing.draw(SPOTS, np.array([1.0, 0.6]) * self.peak_dn * light)
        image[20:60, 500:540] = min(3 + 200 * light, 255)
        return CameraFrame(image, self.taken, f"{self.taken}", self.exposure_us, 0.0, 0.0)

    def build(self, *_: Any) -> factory.Devices:
        return factory.Devices(self, self)


@pytest.fixture
def live(station: Any) -> Any:
    """A station whose camera is said to be no recording; commands are given a scene in its place."""
    station.settings["camera"] = {"kind": "genicam", "camera": "127.0.0.1"}
    station.settings["light"] = {"patch": PATCH, "target_dn": 100}
    station.settings["recipe"] = {"exposure_us": 1000, "lamp_percent": 100.0}
    station.write()
    return station


def test_expose_steps_to_the_level_prints_it_and_writes_nothing(live: Any, capsys: pytest.CaptureFixture[str]) -> None:
    scene, before = Scene(), live.file.read_text()
    assert expose.run(live.file, frames=1, settle_s=0.0, write=False, build=scene.build) == 0
    printed = capsys.readouterr().out
    rows = [line.split() for line in printed.splitlines() if line[:4].strip().isdigit()]
    assert len(rows) > 3
    assert rows[0][4] == "2"
    assert rows[-1][4] == "0"
    assert 85 <= float(rows[-1][5]) <= 95
    assert "lamp_percent: 75" in printed
    assert live.file.read_text() == before
    assert (scene.volts, scene.closed > 0) == (0.0, True)


def test_expose_writes_the_recipe_when_asked_and_keeps_the_rest(live: Any) -> None:
    live.file.write_text(live.file.read_text() + "# the end\n")
    assert expose.run(live.file, frames=2, settle_s=0.0, write=True, build=Scene().build) == 0
    assert live.file.read_text().endswith("# the end\n")
    recipe = load(live.file).recipe
    assert recipe.lamp_percent == 75.0
    assert recipe.exposure_us < 1000


def test_expose_says_what_is_in_the_way(live: Any, capsys: pytest.CaptureFixture[str]) -> None:
    live.settings["recipe"]["automatic_exposure"] = {"min_us": 500, "max_us": 2000}
    live.write()

    def said(peak_dn: float) -> str:
        assert expose.run(live.file, frames=1, settle_s=0.0, write=True, build=Scene(peak_dn).build) == 1
        return capsys.readouterr().err

    assert "close the lens" in said(1e5)
    assert "open the lens" in said(50.0)
    assert "no spots" in said(0.0)


def test_expose_of_a_recording_is_not_possible(station: Any, capsys: pytest.CaptureFixture[str]) -> None:
    assert expose.run(station.file, frames=1, settle_s=0.0, write=True, build=Scene().build) == 1
    assert "a recording is shown" in capsys.readouterr().err


def test_a_device_that_fails_and_settings_that_are_refused_have_their_statuses(live: Any) -> None:
    scene = Scene()
    scene.refuses = NoReply("module", "silent")
    assert expose.run(live.file, frames=1, settle_s=0.0, write=False, build=scene.build) == bench.EXIT_UNAVAILABLE
    live.file.write_text("nothing: right\n")
    status = expose.run(live.file, frames=1, settle_s=0.0, write=False, build=scene.build)
    assert status == bench.EXIT_SETTINGS_REFUSED


def calibrated(station: Any, scene: Scene, output: Path | None = None, *, steps: int = 10, yes: bool = True) -> int:
    return lamp_calibrate.run(station.file, output, steps=steps, frames=1, settle_s=0.0, yes=yes, build=scene.build)


def test_the_lamps_curve_is_measured_written_and_used(live: Any, capsys: pytest.CaptureFixture[str]) -> None:
    scene = Scene()
    assert calibrated(live, scene) == 0
    assert f"set in {live.file}" in capsys.readouterr().out
    live.settings["lamp"] = {"curve": "lamp-curve.yaml"}
    live.write()
    lamp = load(live.file).lamp
    assert [lamp.volts(percent) for percent in (0, 25, 81, 100)] == pytest.approx([0, 2.5, 4.5, 5], abs=0.02)
    assert max(scene.levels) == 5.0
    assert scene.volts == 0.0
    assert calibrated(live, scene) == 0
    assert "set in" not in capsys.readouterr().out


def test_nothing_moves_before_the_answer(live: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene()
    monkeypatch.setattr(lamp_calibrate.typer, "confirm", lambda _: False)
    assert calibrated(live, scene, yes=False) == 1
    assert scene.levels == []
    assert not (live.folder / "lamp-curve.yaml").exists()


def test_a_clipped_reference_and_a_lamp_that_does_nothing_give_no_curve(
    live: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    live.settings["recipe"]["exposure_us"] = 2000
    live.write()
    assert calibrated(live, Scene()) == 1
    assert "clipped" in capsys.readouterr().err
    live.settings["recipe"]["exposure_us"] = 1
    live.write()
    assert calibrated(live, Scene()) == 1
    assert "no curve was written" in capsys.readouterr().err
    assert not (live.folder / "lamp-curve.yaml").exists()


@pytest.mark.parametrize(
    ("text", "place", "after"),
    [
        ("recipe:\n  exposure_us: 5 # old\n  id: 1\n", ("recipe",), "recipe:\n  exposure_us: 7 # old\n  id: 1\n"),
        ("recipe:\n    id: 1\n", ("recipe",), "recipe:\n    exposure_us: 7\n    id: 1\n"),
        ("# top\nid: 1\n", (), "# top\nexposure_us: 7\nid: 1\n"),
        ("recipe: {exposure_us: 5, id: 1}\n", ("recipe",), "recipe: {exposure_us: 7, id: 1}\n"),
    ],
)
def test_a_value_is_changed_where_it_stands(text: str, place: tuple[str, ...], after: str) -> None:
    assert yaml_edit.changed(text, place, "exposure_us", "7") == after
    assert yaml.safe_load(after)


@pytest.mark.parametrize("text", ["recipe: {id: 1}\n", "recipe:\n", "other: 1\n", "recipe:\n  exposure_us: [1]\n"])
def test_what_cannot_be_changed_is_said(text: str) -> None:
    with pytest.raises(yaml_edit.CannotEdit, match=r"write recipe\.exposure_us: 7 by hand"):
        yaml_edit.changed(text, ("recipe",), "exposure_us", "7")
