"""`inspector inspect`: what it prints, what it says of bad frames, and how it ends."""

from __future__ import annotations

import csv
import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from inspector.commands import inspect_files
from inspector.imagefile import read
from tests.support import forked

pytestmark = pytest.mark.xdist_group("inspect")
COMMAND = [sys.executable, "-m", "inspector", "inspect"]
DEFECT_KEYS = {"x_mm", "y_mm", "height_um", "height_sigma_um", "direct_px", "mirror_px", "flags"}


def run(*arguments: object, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    return forked.run("inspect", *arguments, cwd=cwd)


@pytest.fixture(scope="module")
def calibration(frames_folder: Path) -> Path:
    return frames_folder / "calibration.yaml"


@pytest.fixture(scope="module")
def good(frames_folder: Path) -> list[Path]:
    return sorted(frames_folder.glob("*.png"))


@pytest.fixture(scope="module")
def results(good: list[Path], calibration: Path) -> dict[str, Any]:
    """What one run over all good frames printed, by frame."""
    done = run(*good, "--calibration", calibration)
    assert done.stderr == ""
    assert done.returncode == 0
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert [line["frame"] for line in lines] == [str(path) for path in good]
    return {Path(line["frame"]).stem: line for line in lines}


def test_each_line_has_the_keys_that_other_programs_read(results: dict[str, Any]) -> None:
    for result in results.values():
        assert list(result) == ["frame", "verdict", "reasons", "defects", "unpaired", "elapsed_us"]
        assert result["elapsed_us"] > 0
        assert all(isinstance(reason, str) for reason in result["reasons"])
        assert all(set(defect) == DEFECT_KEYS for defect in result["defects"])
        assert all({"x_px", "y_px"} <= set(spot) for spot in result["unpaired"])


def test_seeds_are_found_where_they_are_and_measured(results: dict[str, Any], frames_folder: Path) -> None:
    truth = json.loads((frames_folder / "truth.json").read_text())
    for frame, seeds in truth.items():
        assert len(results[frame]["defects"]) == len(seeds), frame
        for seed in seeds:
            found = min(results[frame]["defects"], key=lambda d: math.dist(d["direct_px"], seed["direct_px"]))
            assert math.dist(found["mirror_px"], seed["mirror_px"]) < 0.5
            assert found["height_um"] == pytest.approx(seed["height_um"], rel=0.01)
            assert (found["x_mm"], found["y_mm"]) == pytest.approx((seed["x_mm"], seed["y_mm"]), abs=0.1)


def test_a_panel_with_high_seeds_fails_with_a_reason_and_a_clean_one_passes(results: dict[str, Any]) -> None:
    assert results["one_seed"]["verdict"] == "FAIL"
    assert "higher than 500 um" in results["one_seed"]["reasons"][0]
    assert (results["clean"]["verdict"], results["clean"]["reasons"]) == ("PASS", [])


@pytest.fixture(scope="module")
def bad(tmp_path_factory: pytest.TempPathFactory, good: list[Path]) -> Path:
    """A folder with one frame of each kind that cannot be inspected."""
    folder, frame = tmp_path_factory.mktemp("bad"), read(good[0])
    (folder / "cut.png").write_bytes(good[0].read_bytes()[:5000])
    for name, image in {
        "colour": np.dstack([frame] * 3),
        "small": frame[:, :-1],
        "black": np.zeros_like(frame),
        "white": np.full_like(frame, 255),
    }.items():
        cv2.imwrite(str(folder / f"{name}.png"), image)
    return folder


def test_a_bad_frame_gets_its_own_message_and_the_rest_go_on(bad: Path, good: list[Path], calibration: Path) -> None:
    words = {
        "missing": "no such file",
        "cut": "cut short",
        "colour": "colour",
        "small": "639 x 480",
        "black": "black",
        "white": "lit",
    }
    done = run(*(bad / f"{name}.png" for name in words), good[0], "--calibration", calibration)
    assert done.returncode == 1
    *refused, last = map(json.loads, done.stdout.splitlines())
    assert last["verdict"] != "NOT_INSPECTED"
    messages = done.stderr.splitlines()
    for result, message, (name, word) in zip(refused, messages, words.items(), strict=True):
        assert (result["verdict"], result["defects"], result["unpaired"]) == ("NOT_INSPECTED", [], [])
        assert result["frame"] == str(bad / f"{name}.png")
        assert word in result["reasons"][0]
        assert message == f"inspector: {result['frame']}: {result['reasons'][0]}"


def test_without_a_usable_calibration_nothing_is_inspected(good: list[Path], tmp_path: Path) -> None:
    done = run(good[0], "--calibration", tmp_path / "missing.yaml")
    assert (done.returncode, done.stdout) == (2, "")
    assert "missing.yaml" in done.stderr
    assert run(good[0]).returncode == 2


def test_the_frame_is_named_as_it_was_given(good: list[Path], calibration: Path) -> None:
    done = run(f"./{good[0].name}", "--calibration", calibration, cwd=good[0].parent)
    assert json.loads(done.stdout)["frame"] == f"./{good[0].name}"


def test_a_reader_that_leaves_ends_it_quietly(good: list[Path], calibration: Path) -> None:
    arguments = [*COMMAND, *map(str, good * 20), "--calibration", str(calibration)]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        assert process.stdout.readline().startswith('{"frame"')
        process.stdout.close()
        assert process.stderr.read() == ""
        assert process.wait(60) != 0


def printed(capsys: pytest.CaptureFixture[str], *frames: Path, **options: Any) -> tuple[int, list[str]]:
    """Exit status and lines of a run in this process."""
    status = inspect_files.run([str(f) for f in frames], **options)
    return status, capsys.readouterr().out.splitlines()


@pytest.mark.parametrize("name", ["a.npy", "a.tif", "a.bmp", "a.pgm"])
def test_every_file_format_gives_the_same_heights(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    good: list[Path],
    calibration: Path,
    name: str,
    results: dict[str, Any],
) -> None:
    frame = read(good[3])
    if name == "a.npy":
        np.save(tmp_path / name, frame.astype(np.uint16))
    else:
        cv2.imwrite(str(tmp_path / name), frame)
    _, (line,) = printed(capsys, tmp_path / name, calibration=calibration)
    assert json.loads(line)["defects"] == results[good[3].stem]["defects"]


def test_the_thesis_method_knows_no_uncertainty(
    capsys: pytest.CaptureFixture[str], good: list[Path], calibration: Path
) -> None:
    _, lines = printed(capsys, *good, calibration=calibration, method="thesis")
    defects = [defect for line in lines for defect in json.loads(line)["defects"]]
    assert defects
    assert all(defect["height_sigma_um"] is None for defect in defects)


def test_a_recipe_sets_limits_and_method(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], frames_folder: Path, calibration: Path
) -> None:
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text("method: thesis\nlimits: {max_height_um: 9000}\n")
    _, (line,) = printed(capsys, frames_folder / "one_seed.png", calibration=calibration, recipe=recipe)
    assert json.loads(line)["verdict"] == "PASS"
    assert json.loads(line)["defects"][0]["height_sigma_um"] is None


def test_a_wrong_recipe_is_refused_with_its_place(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], good: list[Path], calibration: Path
) -> None:
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text("limits:\n  max_heigth_um: 9000\n")
    assert inspect_files.run([str(good[0])], calibration, recipe) == 2
    assert "limits.max_heigth_um" in capsys.readouterr().err


def test_csv_has_a_row_for_each_defect_and_for_each_frame_without(
    capsys: pytest.CaptureFixture[str], good: list[Path], bad: Path, calibration: Path, results: dict[str, Any]
) -> None:
    status, lines = printed(capsys, *good, bad / "black.png", calibration=calibration, output_format="csv")
    rows = list(csv.DictReader(lines))
    assert status == 1
    assert len(rows) == 1 + sum(max(1, len(r["defects"])) for r in results.values())
    heights = {float(row["height_um"]) for row in rows if row["height_um"]}
    assert heights == {d["height_um"] for r in results.values() for d in r["defects"]}
    assert {row["verdict"] for row in rows} == {"PASS", "FAIL", "NOT_INSPECTED"}


def test_the_table_shows_verdicts_heights_and_reasons(
    capsys: pytest.CaptureFixture[str], frames_folder: Path, calibration: Path, results: dict[str, Any]
) -> None:
    _, lines = printed(capsys, frames_folder / "one_seed.png", calibration=calibration, output_format="table")
    assert lines[0].split()[:2] == ["verdict", "x_mm"]
    assert lines[1].startswith("FAIL")
    assert f"{results['one_seed']['defects'][0]['height_um']:.2f}" in lines[1]
    assert lines[2].strip() == results["one_seed"]["reasons"][0]


def test_overlays_are_drawn_for_every_readable_frame_and_never_over_each_other(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], good: list[Path], bad: Path, calibration: Path
) -> None:
    np.save(tmp_path / "clean.npy", read(good[0]).astype(np.uint16) * 16)
    frames = [good[0], tmp_path / "clean.npy", bad / "small.png", bad / "white.png", bad / "cut.png"]
    printed(capsys, *frames, calibration=calibration, overlay=tmp_path / "pictures")
    pictures = {path.name: cv2.imread(str(path)) for path in (tmp_path / "pictures").iterdir()}
    assert set(pictures) == {"clean.png", "clean-2.png", "small.png", "white.png"}
    assert all(picture.ndim == 3 and picture.shape[1] >= 1278 for picture in pictures.values())


def test_an_overlay_folder_that_cannot_be_made_is_refused_before_anything_is_done(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], good: list[Path], calibration: Path
) -> None:
    (tmp_path / "file").touch()
    assert printed(capsys, good[0], calibration=calibration, overlay=tmp_path / "file")[0] == 2


def test_an_error_in_the_program_costs_one_frame_only(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, good: list[Path], calibration: Path
) -> None:
    real = inspect_files.pipeline.inspect

    def trips_once(frame: Any, station: Any) -> Any:
        if frame.name == str(good[0]):
            raise IndexError("7")
        return real(frame, station)

    monkeypatch.setattr(inspect_files.pipeline, "inspect", trips_once)
    status, (first, second) = printed(capsys, good[0], good[1], calibration=calibration)
    assert status == 1
    assert json.loads(first)["verdict"] == "NOT_INSPECTED"
    assert json.loads(second)["verdict"] == "FAIL"
