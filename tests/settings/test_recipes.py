"""A folder of recipes: what is refused and where, which recipe is in use, and the commands that list and choose."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from firmware_bridge.contracts import CameraCapabilities
from inspector.cli.app import app
from inspector.commands.expose import _where
from inspector.recipe import AutomaticExposure, Limits, Recipe, Rectangle, Zone, content_hash
from inspector.recipe_proof import beyond_camera, misfits
from inspector.service import recipe_choice
from inspector.settings import SettingsError, configuration_hash, load, with_recipe

CONFIG = Path(__file__).parents[2] / "config"
BLACK = "id: 7\nname: black\nlamp_percent: 80\n"
WHITE = "# bright\nid: 8\nname: white\nexposure_us: 400.0\nlamp_percent: 75\n"


class Folder:
    """A settings file with recipes beside it; ``write(**sections)`` writes the settings, None takes a section out."""

    def __init__(self, path: Path) -> None:
        self.path, self.file, self.recipes = path, path / "station.yaml", path / "recipes"
        self.recipes.mkdir()
        (path / "calibration.yaml").write_text((CONFIG / "calibration" / "demo.yaml").read_text())
        self.put(black=BLACK, white=WHITE)
        self.write()

    def put(self, **recipes: str) -> None:
        for name, text in recipes.items():
            (self.recipes / f"{name}.yaml").write_text(text)

    def write(self, **sections: Any) -> Path:
        right: dict[str, Any] = {
            "calibration": "calibration.yaml",
            "camera": {"kind": "replay", "paths": ["frames"]},
            "module": {"profile": "ato-4ch", "link": {"kind": "simulated"}},
            "recipes": "recipes",
            "recipe": 7,
        }
        said = {key: value for key, value in (right | sections).items() if value is not None}
        self.file.write_text(yaml.safe_dump(said, sort_keys=False))
        return self.file

    def refused(self) -> list[str]:
        with pytest.raises(SettingsError) as raised:
            load(self.file)
        return [str(problem).replace(f"{self.path}/", "") for problem in raised.value.problems]


@pytest.fixture
def folder(tmp_path: Path) -> Folder:
    return Folder(tmp_path)


def test_the_recipe_in_use_is_chosen_by_id_or_name_and_one_alone_needs_no_choice(folder: Folder) -> None:
    assert load(folder.file).recipe.name == "black"
    assert load(folder.write(recipe="white")).recipe.id == 8
    assert {recipe.id for recipe in load(folder.file).recipes} == {7, 8}
    (folder.recipes / "black.yaml").unlink()
    assert load(folder.write(recipe=None)).recipe.id == 8


@pytest.mark.parametrize(
    ("wanted", "shown"),
    [(9, "9"), ("blue", "'blue'"), (None, "None"), (True, "True"), ({"id": 7}, "{'id': 7}"), (7.5, "7.5")],
)
def test_a_choice_that_is_none_of_them_is_refused_with_those_there_are(wanted: Any, shown: str, folder: Folder) -> None:
    folder.write(recipe=wanted)
    (line,) = folder.refused()
    assert f"recipe: {shown}: no such recipe; allowed: 7 (black), 8 (white)" in line


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("grey", "id: 7\nname: grey", "recipes/grey.yaml:1: recipes[1].id: 7: already given at recipes/black.yaml:1"),
        ("grey", "id: 9\nname: black", "recipes/grey.yaml:2: recipes[1].name: 'black': already given at recipes/black"),
        ("grey", "id: 9", "recipes/grey.yaml:1: recipes[1].name: missing: required; allowed: name that no other"),
        ("grey", "name: grey", "recipes/grey.yaml:1: recipes[1].id: missing: required"),
        ("grey", "id: 9\nname: '12'", "recipes/grey.yaml:2: recipes[1].name: '12': a number would be taken for an id"),
        ("grey", "id: 9\nname: grey\nlimit: {}", "recipes/grey.yaml:3: recipes[1].limit: {}: unknown key (did you"),
        ("grey", "id: 9\nname: grey\nid: 10", "recipes/grey.yaml:3: recipes[1].id: given twice, first at recipes/grey"),
        ("grey", "- 7", "recipes/grey.yaml:1: recipes[1]: [7]: allowed: a mapping"),
        ("grey", "", "recipes/grey.yaml: recipes: empty; allowed: a recipe"),
        ("grey", "id: [", "recipes/grey.yaml:1:6: recipes: not YAML: "),
        ("grey", "id: 0\nname: grey", "recipes/grey.yaml:1: recipes[1].id: 0: allowed: a whole number from 1 to 65535"),
        (
            "grey",
            "id: 9\nname: grey\nlimits: {zones: [{name: f, x_min_mm: 9e3, x_max_mm: 9100, y_min_mm: 0, y_max_mm: 1}]}",
            "recipes/grey.yaml:3: recipes[1].limits.zones[0]: 'f': x 9000 to 9100, y 0 to 1 mm is off the panel",
        ),
        (
            "grey",
            "id: 9\nname: grey\nlimits:\n  zones:\n    - {name: a, x_min_mm: 5, x_max_mm: 4, y_min_mm: 0, y_max_mm: 1}",
            "recipes/grey.yaml:5: recipes[1].limits.zones[0]: ",
        ),
    ],
)
def test_each_problem_names_the_file_the_line_and_what_is_allowed(
    name: str, text: str, expected: str, folder: Folder
) -> None:
    folder.put(**{name: text})
    found = folder.refused()
    assert any(line.startswith(expected) for line in found), found


def test_all_problems_of_all_files_are_told_at_once(folder: Folder) -> None:
    folder.put(grey="id: 7\nname: grey\nlamp_percent: 101", blue="id: [", red="colour: red")
    found = folder.refused()
    for file in ("recipes/grey.yaml:1", "recipes/grey.yaml:3", "recipes/blue.yaml:1", "recipes/red.yaml:1"):
        assert any(line.startswith(file) for line in found), (file, found)


def test_a_folder_that_is_not_there_or_empty_is_refused_and_other_files_are_left_alone(folder: Folder) -> None:
    folder.write(recipes="nowhere")
    assert "nowhere: recipes: cannot be read" in folder.refused()[0]
    (folder.path / "empty").mkdir()
    folder.write(recipes="empty")
    assert "empty: recipes: no recipe in it" in folder.refused()[0]
    for name in (".white.yaml.part.yaml", "notes.txt", "white.yaml~"):
        (folder.recipes / name).write_text("neither: one")
    assert len(load(folder.write()).recipes) == 2


def test_a_lamp_curve_must_reach_every_recipes_level(folder: Folder) -> None:
    folder.write(lamp={"curve": [[0, 0], [78, 5]]})
    (line,) = folder.refused()
    assert line.startswith("recipes/black.yaml:3: recipes[0].lamp_percent: 80.0: lamp.curve does not reach it")
    assert line.endswith("0 to 78")


def test_a_recipe_is_taken_by_id_or_name_and_an_unknown_one_leaves_the_settings_alone(folder: Folder) -> None:
    settings = load(folder.file)
    other = with_recipe(settings, 8)
    assert (other.recipe.name, settings.recipe.name) == ("white", "black")
    assert with_recipe(other, "black") == settings
    assert configuration_hash(other) != configuration_hash(settings)
    with pytest.raises(SettingsError, match=r"recipe: 9: no such recipe; allowed: 7 \(black\), 8 \(white\)"):
        with_recipe(settings, 9)


def test_the_camera_must_be_able_to_expose_as_a_recipe_says() -> None:
    camera = CameraCapabilities(50.0, 2000.0, 1.0, 640, 480)
    assert not list(beyond_camera(Recipe(exposure_us=2000.0), camera))
    ((place, value, allowed),) = beyond_camera(Recipe(exposure_us=2001.0), camera)
    assert (place, value, allowed) == (("exposure_us",), 2001.0, "the camera takes 50 to 2000 us")
    ranges = AutomaticExposure(min_us=10.0, max_us=40.0)
    found = {place for place, _, _ in beyond_camera(Recipe(exposure_us=20.0, automatic_exposure=ranges), camera)}
    assert found == {("exposure_us",), ("automatic_exposure",)}


PLACE = st.floats(-100, 100, allow_nan=False)


@given(PLACE, PLACE, st.floats(0.1, 50), st.floats(0.1, 50))
def test_a_zone_is_refused_if_no_point_of_it_is_on_the_panel(x: float, y: float, width: float, height: float) -> None:
    panel = Rectangle(x_min_mm=0, x_max_mm=40, y_min_mm=0, y_max_mm=30)
    zone = Zone(name="z", x_min_mm=x, x_max_mm=x + width, y_min_mm=y, y_max_mm=y + height)
    nearest = min(max(0.0, x), x + width), min(max(0.0, y), y + height)  # of the zone to the panel's corner at 0, 0
    meets = nearest[0] <= 40 and nearest[1] <= 30 and x + width >= 0 and y + height >= 0
    assert list(misfits(Recipe(limits=Limits(zones=(zone,))), (0, 100), panel)) == [] or not meets
    assert not list(misfits(Recipe(limits=Limits(zones=(zone,))), (0, 100), None))


def test_the_hash_follows_the_content_not_how_it_is_written(folder: Folder) -> None:
    first = content_hash(load(folder.file).recipe)
    folder.put(black="# again\nname: black\nlamp_percent: 80.0\nid: 7\nexposure_us: 1e3\n")
    assert content_hash(load(folder.file).recipe) == first
    folder.put(black=BLACK.replace("80", "81"))
    assert content_hash(load(folder.file).recipe) != first


def test_the_plcs_choice_holds_over_a_restart_until_the_settings_choose_again(folder: Folder) -> None:
    kept = {"recipe_choice_file": "choice.json"}
    settings = load(folder.write(**kept))
    assert settings.recipe_choice_file == folder.path / "choice.json"
    assert recipe_choice.resumed(settings).recipe.id == 7
    recipe_choice.keep(folder.path / "choice.json", 8, 7)
    assert recipe_choice.resumed(load(folder.file)).recipe.id == 8
    folder.put(grey="id: 9\nname: grey")
    assert recipe_choice.resumed(load(folder.write(recipe="grey", **kept))).recipe.id == 9


@pytest.mark.parametrize("said", ["", "[]", "{}", '{"recipe_id": "x", "settings_recipe_id": 7}', "\xff"])
def test_a_damaged_choice_is_said_and_the_settings_hold(
    said: str, folder: Folder, caplog: pytest.LogCaptureFixture
) -> None:
    (folder.path / "choice.json").write_bytes(said.encode("latin-1"))
    settings = load(folder.write(recipe_choice_file="choice.json"))
    assert recipe_choice.resumed(settings).recipe.id == 7
    assert [record.levelno for record in caplog.records] == [logging.ERROR]
    recipe_choice.keep(folder.path / "choice.json", 99, 7)
    assert recipe_choice.resumed(settings).recipe.id == 7
    assert "recipe 99 is no longer there" in caplog.text


@pytest.fixture
def run(folder: Folder) -> Callable[..., Any]:
    """``run(command, ...)``: `inspector recipe` with the folder's settings."""
    return lambda command, *words: CliRunner().invoke(app, ["recipe", command, "--config", str(folder.file), *words])


def test_list_shows_every_recipe_and_which_is_in_use(run: Callable[..., Any], folder: Folder) -> None:
    folder.write(recipe_choice_file="choice.json")
    _, black, white = run("list").stdout.splitlines()
    assert black.split()[:2] == ["*", "7"]
    assert white.split()[0] == "8"
    assert f"{content_hash(load(folder.file).recipe):08x}" in black
    recipe_choice.keep(folder.path / "choice.json", 8, 7)
    _, black, white, why = run("list").stdout.splitlines()
    assert (black.split()[0], white.split()[0]) == ("7", "*")
    assert "chosen by the PLC" in why


def test_show_prints_a_recipe_that_reads_the_same(run: Callable[..., Any], folder: Folder) -> None:
    shown = run("show", "white")
    assert shown.exit_code == 0
    (folder.recipes / "white.yaml").write_text(shown.stdout)
    assert run("show", "8").stdout == shown.stdout
    unknown = run("show", "9")
    assert unknown.exit_code == 1
    assert "no such recipe; allowed: 7 (black), 8 (white)" in unknown.stderr


def test_check_says_each_recipe_is_right_or_all_that_is_wrong(run: Callable[..., Any], folder: Folder) -> None:
    done = run("check")
    assert done.exit_code == 0
    assert "7 (black): right" in done.stdout
    folder.put(white="id: 7\nname: black")
    done = run("check")
    assert done.exit_code == 78
    assert len(done.stderr.splitlines()) == 2


def test_use_writes_the_choice_keeps_comments_and_overrules_the_plcs(run: Callable[..., Any], folder: Folder) -> None:
    folder.write(recipe="black", recipe_choice_file="choice.json")
    folder.file.write_text("# line 2\n" + folder.file.read_text())
    recipe_choice.keep(folder.path / "choice.json", 8, 7)
    done = run("use", "7")
    assert done.exit_code == 0
    assert "systemctl reload" in done.stdout
    assert folder.file.read_text().startswith("# line 2\n")
    assert recipe_choice.resumed(load(folder.file)).recipe.id == 7
    assert not (folder.path / "choice.json").exists()
    assert run("use", "white").exit_code == 0
    assert load(folder.file).recipe.id == 8
    assert run("use", "blue").exit_code == 1
    assert load(folder.file).recipe.id == 8


def test_use_without_a_folder_says_what_is_missing(run: Callable[..., Any], folder: Folder) -> None:
    folder.write(recipes=None, recipe={"id": 3})
    done = run("use", "3")
    assert done.exit_code == 1
    assert "name a folder" in done.stderr


def test_settings_as_shown_are_right_again(folder: Folder, tmp_path: Path) -> None:
    shown = CliRunner().invoke(app, ["config", "show", str(folder.write(recipe="white"))])
    again = tmp_path / "again.yaml"
    again.write_text(shown.stdout)
    assert load(again) == load(folder.file)
    assert json.loads(json.dumps(yaml.safe_load(shown.stdout)["recipe"])) == 8


def test_the_level_found_for_a_recipe_goes_into_its_own_file(folder: Folder) -> None:
    assert _where(folder.file, 8) == (folder.recipes / "white.yaml", ())
    folder.write(recipes=None, recipe={"id": 3})
    assert _where(folder.file, 3) == (folder.file, ("recipe",))
