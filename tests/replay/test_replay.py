"""`inspector replay`: recorded frames are found as they were, and what would change is told, whatever interrupts it."""

from __future__ import annotations

import json
import math
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import panel_frames
import pytest
import recorded_sessions
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner, Result

from firmware_bridge.wire import session
from inspector import imagefile
from inspector.change_options import Asked
from inspector.cli.app import app
from inspector.replay import command, workers
from inspector.replay.command import Output
from inspector.replay.plan import Plan
from inspector.replay.tally import Tally

pytestmark = pytest.mark.xdist_group("recorded")
DEMO = recorded_sessions.CONFIG / "calibration" / "demo.yaml"
SEVERAL = {
    "frames": {"kind": "count", "count": panel_frames.FRAMES},
    "travel": {"by": {"kind": "pitch", "mm_per_frame": panel_frames.STEP_MM}, "direction_deg": 90},
}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of two sessions: single frames, and one panel of three frames."""
    folder = tmp_path_factory.mktemp("recorded")
    single = recorded_sessions.Recording(folder / "frames" / "one")
    version = recorded_sessions.version(folder)
    for image in recorded_sessions.images():
        single.panel(version, [image])
    several = recorded_sessions.Recording(folder / "frames" / "two")
    images = [imagefile.read(file) for file in panel_frames.write(folder)]
    travels_mm = [n * panel_frames.STEP_MM for n in range(len(images))]
    several.panel(recorded_sessions.version(folder, "several", panel=SEVERAL), images, travels_mm)
    return folder / "frames"


FRAMES = len(recorded_sessions.FRAMES) + panel_frames.FRAMES


@pytest.fixture
def copied(recorded: Path, tmp_path: Path) -> Path:
    """The same, to be spoilt."""
    return Path(shutil.copytree(recorded, tmp_path / "frames"))


def replayed(*words: object) -> Result:
    return CliRunner().invoke(app, ["replay", "--jobs", "1", *map(str, words)])


def as_json(*words: object) -> tuple[int, dict[str, Any]]:
    done = replayed(*words, "--format", "json")
    return done.exit_code, json.loads(done.stdout)


def test_by_their_own_settings_all_is_the_same_to_the_last_bit(recorded: Path) -> None:
    status, said = as_json(recorded)
    assert status == 0
    assert (said["frames"], said["frames_same"], said["panels"], said["panels_same"]) == (FRAMES, FRAMES, 1, 1)
    assert not said["differences"] + said["not_compared"]
    assert f"{FRAMES} frames compared: {FRAMES} the same to the last bit, 0 differ" in replayed(recorded).stdout


def test_a_height_that_differs_in_its_last_bit_is_found(copied: Path) -> None:
    index = copied / "one" / session.INDEX
    height = re.search(r'"height_um": ([0-9.]+)', index.read_text())
    assert height
    other = repr(math.nextafter(float(height[1]), math.inf))
    index.write_text(index.read_text().replace(height[0], f'"height_um": {other}', 1))
    status, said = as_json(copied)
    assert status == 1
    assert [Path(d["where"]).name for d in said["differences"]] == ["000001.png"]
    assert (said["frames"], said["frames_same"]) == (FRAMES, FRAMES - 1)


def test_a_stricter_recipe_tells_which_verdicts_flip_and_why(recorded: Path, tmp_path: Path) -> None:
    recipe = tmp_path / "strict.yaml"
    recipe.write_text("limits: {max_height_um: 400}\n")
    status, said = as_json(recorded, "--recipe", recipe)
    assert status == 0
    flipped = [d for d in said["differences"] if (d["then"], d["now"]) == ("PASS", "FAIL")]
    assert {(Path(d["where"]).name, d["panel_id"]) for d in flipped if d["what"] == "frame"} >= {("000001.png", 71)}
    assert [d["panel_id"] for d in said["differences"] if d["what"] == "panel"] == [71]
    assert all("higher than 400 um" in d["why_now"] for d in flipped)
    assert said["heights"]["largest_um"] == 0.0
    table = replayed(recorded, "--recipe", recipe).stdout
    assert re.search(r"one/000001\.png  panel 71  PASS -> FAIL: .*higher than 400 um", table)


def test_heights_move_by_what_the_calibration_says(recorded: Path, tmp_path: Path) -> None:
    calibration, plot = tmp_path / "other.yaml", tmp_path / "plot.svg"
    calibration.write_text(yaml.safe_dump(yaml.safe_load(DEMO.read_text()) | {"height_gain": 1.25}))
    status, said = as_json(recorded, "--calibration", calibration, "--plot", plot)
    moved = said["heights"]
    assert status == 0
    assert (moved["gained"], moved["lost"]) == (0, 0)
    then = [
        found["height_um"]
        for index in sorted(recorded.rglob(session.INDEX))
        for line in index.read_text().splitlines()[1:]
        for found in json.loads(line)["result"]["defects"]
    ]
    assert moved["matched"] == len(then)
    assert moved["mean_um"] == pytest.approx(0.25 * sum(then) / len(then))
    assert moved["largest_um"] == pytest.approx(0.25 * max(then))
    assert plot.read_text().count("<circle") == 2 * len(then)


def test_other_settings_and_another_method_are_used(recorded: Path, tmp_path: Path) -> None:
    recorded_sessions.version(tmp_path, "dim", recipe={"detection": {"threshold_dn": 254.5}})
    _, said = as_json(recorded / "one", "--config", tmp_path / "dim.yaml")
    assert said["heights"]["lost"] > 0
    _, said = as_json(recorded / "one", "--method", "thesis")
    assert said["heights"]["matched"] > 0
    assert abs(said["heights"]["mean_um"]) > 1


def spoil(folder: Path) -> None:
    """Whatever may become of sessions on a disk: an image damaged, one missing, a settings file missing and one of
    another program, lines that are nonsense and cut short, a session of another version."""
    image = folder / "one" / "000001.png"
    image.write_bytes(image.read_bytes()[:-40])
    (folder / "one" / "000002.png").unlink()
    index = folder / "one" / session.INDEX
    lines = index.read_text().splitlines()
    index.write_text("\n".join([*lines[:3], "{nonsense", *lines[3:], lines[-1][:100]]))
    for file in (folder / "two").glob("settings-*.json"):
        said = json.loads(file.read_text())
        said["settings"]["recipe"]["of_another_program"] = 1
        file.write_text(json.dumps(said))
    (folder / "three").mkdir()
    (folder / "three" / session.INDEX).write_text('{"session": 99}\n')


def test_what_is_damaged_is_named_and_the_rest_goes_on(copied: Path) -> None:
    spoil(copied)
    status, said = as_json(copied)
    assert status == 1
    assert (said["frames"], said["frames_same"]) == (2, 2)
    whys = "\n".join(f"{n['where']}: {n['why']}" for n in said["not_compared"])
    for told in (
        r"one/000001\.png: .*damaged or cut short",
        r"one/000002\.png: .*no such file",
        r"one: line 4: ",
        r"one: line 7: cut short",
        r"two/000003\.png: .*of_another_program",
        r"two/000003\.png: its panel cannot be judged again",
        r"three: .*session is 99, not 1",
    ):
        assert re.search(told, whys, re.DOTALL), told
    assert len(said["not_compared"]) == 9
    table = replayed(copied).stdout
    assert all(re.escape(n["where"]) and n["where"] in table and n["why"] in table for n in said["not_compared"])


def test_a_settings_file_that_is_gone_is_named(copied: Path) -> None:
    for file in copied.rglob("settings-*.json"):
        file.unlink()
    done = replayed(copied)
    assert done.exit_code == 2
    assert done.stdout.count("settings cannot be read") == 2
    assert "no frame could be compared" in done.stderr


@pytest.mark.parametrize("words", [["--recipe", "no.yaml"], ["--calibration", "no.yaml"], ["--config", "no.yaml"]])
def test_what_cannot_be_used_is_said(recorded: Path, words: list[str]) -> None:
    done = replayed(recorded, *words)
    assert done.exit_code == 2
    assert "no.yaml" in done.stderr


def test_a_folder_without_sessions_is_said(tmp_path: Path) -> None:
    done = replayed(tmp_path)
    assert done.exit_code == 2
    assert str(tmp_path) in done.stderr


def run(folder: Path, output: Path, jobs: int, asked: Asked, part_bytes: int) -> bytes:
    command.run([folder], asked, Output("json", output), jobs, part_bytes)
    return output.read_bytes()


@pytest.fixture(scope="module")
def spoilt(recorded: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("spoilt")
    shutil.copytree(recorded, folder / "whole")
    spoil(Path(shutil.copytree(recorded, folder / "spoilt")))
    return folder


def test_two_processes_say_what_one_says(spoilt: Path, tmp_path: Path) -> None:
    asked = Asked(method="thesis")
    one = run(spoilt, tmp_path / "one.json", 1, asked, 1 << 30)
    assert run(spoilt, tmp_path / "two.json", 2, asked, 1) == one
    assert json.loads(one)["frames"] == FRAMES + 2


WHOLES: dict[Path, dict[Asked, bytes]] = {}
"""What runs that nothing interrupted said."""


class Interrupted(Exception):
    """As by Ctrl-C."""


@settings(max_examples=8, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_an_interrupted_run_ends_as_one_that_was_not(spoilt: Path, tmp_path_factory: Any, data: st.DataObject) -> None:
    folder, wholes = tmp_path_factory.mktemp("resume"), WHOLES.setdefault(spoilt, {})
    asked = Asked(method=data.draw(st.sampled_from([None, "thesis"])))
    if asked not in wholes:
        wholes[asked] = run(spoilt, folder / "whole.json", 1, asked, 1)
    calls, output = [0], folder / "again.json"
    parts = len(Plan.of([spoilt], 1).parts())
    after = data.draw(st.integers(0, parts - 1), "parts before it")

    def at_times(*words: Any, **more: Any) -> Tally:
        calls[0] += 1
        if calls[0] == after + 1:
            raise Interrupted
        return examine(*words, **more)

    examine: Callable[..., Tally] = command.examine
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(command, "examine", at_times)
        with pytest.raises(Interrupted):
            run(spoilt, output, 1, asked, 1)
        state = output.with_name("again.json.state")
        lost = data.draw(st.integers(0, len(state.read_bytes())), "bytes lost")
        state.write_bytes(state.read_bytes()[: len(state.read_bytes()) - lost])
        assert not output.exists()
        assert run(spoilt, output, 1, asked, 1) == wholes[asked]
    again = calls[0] - after - 1
    assert again == parts - after if not lost else parts - after <= again <= parts
    assert not state.exists()


def test_a_session_is_replayed_by_its_name_alone(recorded: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(recorded)
    for name in ("one", "."):
        status, said = as_json(name)
        assert (status, said["frames"], said["differences"]) == (
            0,
            {"one": FRAMES - panel_frames.FRAMES}.get(name, FRAMES),
            [],
        )


def test_the_state_of_another_replay_is_not_used(recorded: Path, tmp_path: Path) -> None:
    state = tmp_path / "state"
    for content in ("nonsense\n", json.dumps({"replay": 1, "of": "another", "plan": {}}) + "\n"):
        state.write_text(content)
        done = replayed(recorded, "--state", state)
        assert done.exit_code == 2
        assert str(state) in done.stderr
        assert state.read_text() == content


def test_a_killed_process_costs_what_it_was_at_once_more(tmp_path: Path) -> None:
    tasks = [(n, tmp_path / str(n)) for n in range(4)]
    assert dict(workers.share(recorded_sessions.dies_once, tasks, 2)) == {n: 2 for n, _ in tasks}


def test_a_frame_that_crashes_its_process_is_told_by_name(recorded: Path, tmp_path: Path) -> None:
    for name in ("before", "crashes"):
        shutil.copytree(recorded / "one", tmp_path / name)
    program, crashing = (
        Path(sys.executable).with_name("inspector"),
        Path(recorded_sessions.__file__).parent / "crashing",
    )
    command = [program, "replay", tmp_path, "--jobs", "2", "--format", "json"]
    env = os.environ | {"PYTHONPATH": str(crashing)}
    done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=100)
    assert done.returncode == 1, done.stderr
    said = json.loads(done.stdout)
    assert said["frames"] == said["frames_same"] == 2 * len(recorded_sessions.FRAMES) - 1
    (told,) = said["not_compared"]
    assert told["where"] == str(tmp_path / "crashes" / "000002.png")
    assert "SIGSEGV" in told["why"]


def test_processes_that_die_each_time_are_given_up(tmp_path: Path) -> None:
    with pytest.raises(workers.WorkersDied):
        list(workers.share(recorded_sessions.dies, [(0, tmp_path), (1, tmp_path)], 2))


SHARES = """
import sys
from pathlib import Path
import recorded_sessions
from inspector.replay import workers

if __name__ == "__main__":
    list(workers.share(recorded_sessions.stays, [(0, Path(sys.argv[1])), (1, Path(sys.argv[1]))], 2))
"""


def test_processes_end_with_the_one_that_shares_the_work_out(tmp_path: Path, wait_until: Callable[..., Any]) -> None:
    script = tmp_path / "shares.py"
    script.write_text(SHARES)
    support = str(Path(recorded_sessions.__file__).parent)
    sharing = subprocess.Popen([sys.executable, script, tmp_path], env=os.environ | {"PYTHONPATH": support})
    try:
        wait_until(lambda: len(list(tmp_path.glob("*.pid"))) == 2, "two processes at work")
    finally:
        sharing.kill()
        sharing.wait()
    for file in tmp_path.glob("*.pid"):
        state = Path("/proc") / file.stem / "stat"
        wait_until(lambda state=state: not state.exists() or ") Z " in state.read_text(), f"process {file.stem} ends")


def test_a_device_is_never_replaced_by_a_report(recorded: Path) -> None:
    done = replayed(recorded, "--output", "/dev/full", "--state", recorded.parent / "state")
    assert done.exit_code == 2
    assert "/dev/full" in done.stderr
    assert not Path("/dev/full").is_file()
