"""Settings of a station: what is refused, with path, value and what is allowed, all at once; files that go with it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from typer.testing import CliRunner

from inspector.cli.app import app
from inspector.commands.settings_commands import schema
from inspector.cycle_settings import Timed
from inspector.settings import SettingsError, check, configuration_hash, load

CONFIG = Path(__file__).parents[2] / "config"

Write = Callable[..., Path]


@pytest.fixture
def write(tmp_path: Path) -> Write:
    """``write(**sections)``: a settings file with these sections changed; None takes one out."""
    (tmp_path / "frames").mkdir()
    (tmp_path / "calibration.yaml").write_text((CONFIG / "calibration" / "demo.yaml").read_text())
    right: dict[str, Any] = {
        "calibration": "calibration.yaml",
        "camera": {"kind": "replay", "paths": ["frames"]},
        "module": {"profile": "ato-4ch", "link": {"kind": "tcp", "host": "10.0.0.3", "port": 502}},
    }

    def put(**sections: Any) -> Path:
        changed = {key: value for key, value in (right | sections).items() if value is not None}
        file = tmp_path / "station.yaml"
        file.write_text(yaml.safe_dump(changed))
        return file

    return put


def refused(file: Path) -> list[str]:
    with pytest.raises(SettingsError) as raised:
        load(file)
    return [str(problem).removeprefix(str(file)) for problem in raised.value.problems]


def test_a_right_file_is_settings_with_its_paths_ready(write: Write, tmp_path: Path) -> None:
    settings = load(write(cycle={"trigger": {"kind": "timed", "rate_hz": 4.0}}))
    assert settings.calibration == tmp_path / "calibration.yaml"
    assert settings.camera.paths == (tmp_path / "frames",)
    assert settings.cycle.trigger == Timed(kind="timed", rate_hz=4.0)
    assert settings.plc.host == "127.0.0.1"
    assert check(tmp_path / "station.yaml") == settings


@pytest.mark.parametrize(
    ("sections", "expected"),
    [
        ({"plc": {"prt": 1}}, "plc.prt: 1: unknown key (did you mean port?); allowed here: host, port, unit_ids"),
        ({"plc": {"port": "5020"}}, "plc.port: '5020': allowed: a whole number from 0 to 65535"),
        ({"plc": {"port": 70000}}, "plc.port: 70000: allowed: a whole number from 0 to 65535"),
        ({"plc": {"allow": ["10.0.0.0/33"]}}, "plc.allow[0]: '10.0.0.0/33': allowed: an address or a network"),
        ({"plc": {"unit_ids": [256]}}, "plc.unit_ids[0]: 256: allowed: a whole number from 0 to 255"),
        ({"plc": {"allow_write": ["x"]}}, "plc.allow_write[0]: 'x': allowed: an address or a network"),
        ({"plc": {"serial": {"port": "x", "baud": 7}}}, "plc.serial.baud: 7: allowed: one of: 1200, 2400"),
        (
            {"plc": {"tls": {"certificate": "none.pem", "key": "none.key", "client_ca": "none.pem"}}},
            "plc.tls.certificate: 'none.pem': No such file or directory; allowed: give a file",
        ),
        (
            {"archive": {"folder": "/m/../a", "disk": "/m"}},
            "archive.disk: '/m': allowed: archive.folder or a folder above it",
        ),
        (
            {"archive": {"folder": "/mnt/a", "disk": "/mnt"}},
            "archive.disk: '/mnt': allowed: name files that are not on it",
        ),
        (
            {"archive": {"folder": "/m/a", "disk": "/m/./"}, "recipe_choice_file": "/m/r", "statistics_file": "/s"},
            "archive.disk: '/m': allowed: name files that are not on it as plc.sequence_file, recipe_choice_file",
        ),
        ({"plc": {"word_order": "big"}}, "plc.word_order: 'big': allowed: one of: high_first, low_first"),
        ({"camera": None}, "camera: missing: required; allowed: "),
        (
            {"module": {"profile": "toaster", "link": {"kind": "simulated"}}},
            "module.profile: 'toaster': no such profile",
        ),
        (
            {"module": {"profile": "ato-4ch", "link": {"kind": "usb"}}},
            "module.link: {'kind': 'usb'}: allowed: a mapping",
        ),
        ({"lamp": {"channel": 99}}, "lamp.channel: 99: allowed: 0 to 3"),
        ({"recipe": {"lamp_percent": 101}}, "recipe.lamp_percent: 101: allowed: a number from 0 to 100"),
        ({"recipe": {"limits": {"zones": [{"name": "a"}]}}}, "recipe.limits.zones[0].x_min_mm: missing: required"),
        (
            {"cycle": {"trigger": {"kind": "timed", "rate_hz": 0}}},
            "cycle.trigger.rate_hz: 0: allowed: a number above 0",
        ),
        (
            {"module": {"profile": "tm-da1p1r1", "link": {"kind": "simulated"}, "watchdog_s": 0.5}},
            "module.watchdog_s: 0.5: allowed: more than",
        ),
        (
            {"module": {"profile": "ato-4ch", "link": {"kind": "simulated"}, "power_on_v": 0.5}},
            "module.power_on_v: 0.5: ato-4ch takes its power-on value from its maker's tool only",
        ),
        (
            {"cycle": {"trigger": {"kind": "digital_input"}}},
            "cycle.trigger.channel: 0: ato-4ch has 0 digital inputs; allowed: none: choose another trigger",
        ),
        (
            {
                "cycle": {"trigger": {"kind": "digital_input", "channel": 4}},
                "module": {"profile": "adam-4024", "link": {"kind": "simulated"}},
            },
            "cycle.trigger.channel: 4: adam-4024 has 4 digital inputs; allowed: 0 to 3",
        ),
        ({"calibration": "none.yaml"}, "calibration: 'none.yaml': "),
        ({"calibration": 7}, "calibration: 7: allowed: a text"),
        ({"plc": {"host": "10.0.0.3", "port": 502}}, "plc.port: 502: already used by module.link.port"),
    ],
)
def test_each_problem_has_its_path_value_and_what_is_allowed(
    sections: dict[str, Any], expected: str, write: Write
) -> None:
    found = refused(write(**sections))
    assert any(expected in line for line in found), found


def test_all_problems_are_told_at_once(write: Write) -> None:
    found = refused(
        write(
            stattion="x",
            calibration="none.yaml",
            plc={"port": 99999},
            lamp={"channel": 4},
            recipe={"exposure_us": "long"},
            cycle={"retry_first_s": -1},
        )
    )
    for path in ("stattion", "calibration", "plc.port", "lamp.channel", "recipe.exposure_us", "cycle.retry_first_s"):
        assert any(f": {path}: " in line for line in found), (path, found)
    assert all(line.startswith(":") for line in found)


def test_a_wrong_calibration_is_told_with_its_own_lines(write: Write, tmp_path: Path) -> None:
    calibration = yaml.safe_load((tmp_path / "calibration.yaml").read_text())
    calibration["camera"]["f_mm"] = -1
    calibration["camera"]["sx"] = 0
    (tmp_path / "calibration.yaml").write_text(yaml.safe_dump(calibration))
    found = refused(write())
    assert len(found) == 2
    for line, key in zip(found, ("camera.f_mm: -1", "camera.sx: 0"), strict=True):
        assert line.startswith(":1: calibration: 'calibration.yaml': ")
        assert f"{key}: allowed: a number above 0" in line


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "0.0.0.0", "::1"])
def test_a_port_of_this_machine_is_one_port_under_any_name(host: str, write: Write) -> None:
    link = {"kind": "tcp", "host": host, "port": 5020}
    (line,) = refused(write(module={"profile": "ato-4ch", "link": link}))
    assert "plc.port" in line
    assert "module.link.port" in line


def test_a_recipe_may_have_its_own_file(write: Write, tmp_path: Path) -> None:
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text("id: 7\nlamp_percent: 60.0\n")
    assert load(write(recipe="recipe.yaml")).recipe.id == 7
    recipe.write_text("id: 7\nlamp_per: 60.0\n")
    (line,) = refused(write(recipe="recipe.yaml"))
    assert f"{recipe}:2: recipe.lamp_per: 60.0: unknown key (did you mean" in line
    (line,) = refused(write(recipe="other.yaml"))
    assert "cannot be read" in line


def test_frames_that_are_not_there_are_waited_for_by_the_service_and_told_by_the_check(write: Write) -> None:
    file = write(camera={"kind": "replay", "paths": ["frames", "gone"]})
    load(file)
    with pytest.raises(SettingsError, match=r"camera\.paths.*gone"):
        check(file)


def test_the_hash_follows_settings_and_calibration_not_their_place(write: Write, tmp_path: Path) -> None:
    file = write()
    first = configuration_hash(load(file))
    assert first == configuration_hash(load(Path(file)))
    moved = tmp_path.rename(tmp_path.with_name(f"{tmp_path.name}-moved"))
    assert configuration_hash(load(moved / file.name)) == first
    (moved / "calibration.yaml").open("a").write("# measured again\n")
    assert configuration_hash(load(moved / file.name)) != first
    moved.rename(tmp_path)
    (tmp_path / "calibration.yaml").write_text((CONFIG / "calibration" / "demo.yaml").read_text())
    assert configuration_hash(load(write(station="other"))) != first


@pytest.mark.parametrize("name", ["demo.yaml", "line.yaml"])
def test_committed_settings_pass_their_check(name: str) -> None:
    done = CliRunner().invoke(app, ["config", "check", str(CONFIG / name)])
    assert done.exit_code == 0, done.output
    assert str(CONFIG / name) in done.output


def test_check_tells_every_problem_and_fails(write: Write) -> None:
    done = CliRunner().invoke(app, ["config", "check", str(write(plc={"port": -1}, stattion="x"))])
    assert done.exit_code == 1
    assert "plc.port: -1" in done.output
    assert "refused: 2 problems" in done.output


def test_show_fills_in_what_was_left_out_and_is_itself_right(write: Write, tmp_path: Path) -> None:
    file = write(station="here")
    done = CliRunner().invoke(app, ["config", "show", str(file)])
    assert done.exit_code == 0
    again = tmp_path / "again.yaml"
    again.write_text(done.stdout)
    assert load(again) == load(file)
    assert yaml.safe_load(done.stdout)["plc"]["port"] == 5020
    assert CliRunner().invoke(app, ["config", "show", str(tmp_path / "none.yaml")]).exit_code == 1


def test_the_committed_schema_is_current() -> None:
    assert (CONFIG / "schema.json").read_text() == schema(), "run: make docs"
    printed = CliRunner().invoke(app, ["config", "schema"]).stdout
    assert json.loads(printed)["properties"]["recipe"]["anyOf"][1]["type"] == "string"
