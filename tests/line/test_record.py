"""`inspector record`: frames kept with how they were taken, and shown again by the replay camera."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import pytest
from typer.testing import CliRunner, Result

from firmware_bridge.simulators.module_server import ModuleServer
from firmware_bridge.wire import session
from inspector import imagefile, settings_version
from inspector.archive import result_json
from inspector.archive.session_frames import inspected, version_file
from inspector.cli.app import app
from inspector.faults import Fault
from inspector.model import Frame, Verdict
from inspector.pipeline import Station, inspect


def recorded(station: Any, output: Path, frames: int = 3) -> Result:
    words = [
        "record",
        "--config",
        str(station.file),
        "--output",
        str(output),
        "--frames",
        str(frames),
        "--settle-s",
        "0",
    ]
    return CliRunner().invoke(app, words)


def test_frames_are_kept_as_they_were_taken(station: Any, module: Callable[[], ModuleServer], tmp_path: Path) -> None:
    server, output = module(), tmp_path / "campaign" / "monday"
    done = recorded(station, output)
    assert done.exit_code == 0, done.output
    assert server.module.output_v(0) == 0.0
    kept = session.parse((output / session.INDEX).read_text())
    assert [r.file for r in kept] == ["000001.png", "000002.png", "000003.png"]
    for r, source in zip(kept, sorted(station.frames.iterdir()), strict=False):
        assert (cv2.imread(str(output / r.file), -1) == cv2.imread(str(source), -1)).all()
        assert (r.exposure_us, r.exposure_set_us) == (1000.0, 1000.0)
        assert r.lamp_v == pytest.approx(r.lamp_set_v, abs=0.05)
    assert not list(output.glob(".*"))


def test_a_session_says_what_was_found_and_by_which_settings(
    station: Any, module: Callable[[], ModuleServer], tmp_path: Path
) -> None:
    module()
    output = tmp_path / "campaign"
    assert recorded(station, output).exit_code == 0
    for r in session.parse((output / session.INDEX).read_text()):
        found = inspected(r)
        assert found is not None
        version = settings_version.from_json((output / version_file(found.settings)).read_text())
        again = inspect(Frame(imagefile.read(output / r.file), r.file), Station(version.calibration, version.recipe))
        assert result_json.same(again, found.result)
        assert found.result.verdict is not Verdict.NOT_INSPECTED


def test_a_session_is_never_written_over(station: Any, module: Callable[[], ModuleServer], tmp_path: Path) -> None:
    module()
    assert recorded(station, tmp_path / "one").exit_code == 0
    before = (tmp_path / "one" / session.INDEX).read_bytes()
    again = recorded(station, tmp_path / "one")
    assert again.exit_code == 1
    assert "name a new folder" in again.output
    assert (tmp_path / "one" / session.INDEX).read_bytes() == before


def test_frames_of_another_exposure_are_not_judged_by_this_recipe(
    station: Any, module: Callable[[], ModuleServer], service: Callable[..., Any], tmp_path: Path
) -> None:
    """A recording says at what exposure its frames were taken; a recipe that asks for another one judges none."""
    module()
    assert recorded(station, tmp_path / "one").exit_code == 0
    station.settings["camera"]["paths"] = [str(tmp_path / "one")]
    station.settings["recipe"]["exposure_us"] = 2000
    station.write()
    running = service()
    running.until_fault(Fault.EXPOSURE_READBACK)
    assert any("took the frame at 1000 us, not 2000 us" in line for line in running.log)
    assert not any(verdict in line.split() for line in running.results for verdict in ("PASS", "FAIL"))
