"""`inspector calibrate` as a person or a script runs it."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from board_scene import Scene, render
from typer.testing import CliRunner

from inspector import calibration_file
from inspector.cli.app import app
from tests.support import forked

DATA = Path(__file__).parents[1] / "data"
TABLE_5_2 = DATA / "thesis" / "table_5_2.csv"
BOARD = DATA / "board" / "board.png"
GRID = ["--pitch-mm", "18.8", "--columns", "6", "--rows", "5"]


def run(*arguments: object) -> subprocess.CompletedProcess[str]:
    return forked.run("calibrate", *arguments)


def run_here(*arguments: object) -> tuple[int, str, str]:
    """Exit status, output and errors of the same in this process."""
    done = CliRunner().invoke(app, ["calibrate", *map(str, arguments)])
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
    return done.exit_code, done.stdout, done.stderr


def refused(*arguments: object) -> str:
    """What the command line says, in this process: it ended by itself, with status 1."""
    done = CliRunner().invoke(app, ["calibrate", *map(str, arguments)])
    assert isinstance(done.exception, SystemExit), done.exception
    assert done.exit_code == 1
    return done.output


@pytest.mark.parametrize(("method", "mean_px"), [("reprojection", 0.5684), ("tsai", 0.7833)])
def test_points_to_a_file_a_table_and_a_picture(tmp_path: Path, method: str, mean_px: float) -> None:
    output = tmp_path / "camera.yaml"
    status, table, errors = run_here("--points", TABLE_5_2, "--output", output, "--method", method)
    assert (status, errors) == (0, "")
    rows = [line.split() for line in table.splitlines() if re.match(r" *\d+ +\d", line)]
    assert [row[0] for row in rows] == [str(n) for n in range(1, 31)]
    assert all(len(row) == 7 for row in rows)  # point, then nominal, computed and percent error of x and of y
    assert re.search(rf"mean {mean_px}", table)
    assert re.search(r"f_mm +7\.9\d+ +0\.\d+", table)

    written = calibration_file.load(output)
    assert written.residuals is not None
    assert written.residuals.method == method
    assert written.residuals.mean_px == pytest.approx(mean_px, abs=1e-4)
    assert len(written.residuals.points) == 30
    assert written.uncertainty is not None
    assert written.view_angle_deg == pytest.approx(64.75, abs=0.1)
    assert cv2.imread(str(tmp_path / "camera.overlay.png")).shape == (960, 1280, 3)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["camera.overlay.png", "camera.yaml"]


def test_a_board_to_a_file_with_the_exact_keys(tmp_path: Path) -> None:
    output, picture = tmp_path / "camera.yaml", tmp_path / "seen.png"
    lamp = ["--alpha-deg", "25", "--azimuth-deg", "170", "--view-angle-deg", "65"]
    done = run("--board", BOARD, *GRID, "--output", output, "--overlay", picture, *lamp)
    assert (done.returncode, done.stderr) == (0, "")
    document = yaml.safe_load(output.read_text())
    camera_keys = "model width_px height_px f_mm kappa1_per_mm2 sx cx_px cy_px dx_mm dy_mm rotation translation_mm"
    assert list(document["camera"]) == camera_keys.split()
    assert document["camera"]["f_mm"] == pytest.approx(7.972616, abs=0.01)
    assert document["view_angle_deg"] == 65
    azimuth, alpha = np.radians([170, 25])
    direction = [np.sin(alpha) * np.cos(azimuth), np.sin(alpha) * np.sin(azimuth), np.cos(alpha)]
    assert document["light"] == {"direction": pytest.approx(direction)}
    assert picture.exists()


def test_a_board_of_another_sensor_takes_its_size_from_the_image(tmp_path: Path) -> None:
    image = np.pad(render(Scene()), ((60, 60), (80, 80)), mode="edge")
    cv2.imwrite(str(tmp_path / "board.png"), image)
    output = tmp_path / "camera.yaml"
    status, _, errors = run_here("--board", tmp_path / "board.png", *GRID, "--output", output)
    assert status == 0, errors
    camera = calibration_file.read(output).camera
    assert (camera.width_px, camera.height_px, camera.cx_px, camera.cy_px) == (800, 600, 400, 300)
    assert camera.f_mm == pytest.approx(Scene().f_mm, rel=0.01)


@pytest.fixture
def half_board(tmp_path: Path) -> Path:
    path = tmp_path / "half.png"
    cv2.imwrite(str(path), render(Scene(aim_px=(260, 0))))
    return path


def test_a_refusal_writes_nothing(tmp_path: Path, half_board: Path) -> None:
    done = run("--board", half_board, *GRID, "--output", tmp_path / "camera.yaml")
    assert done.returncode == 1
    assert "is cut by the image's edge" in done.stderr
    assert "Traceback" not in done.stderr
    assert sorted(p.name for p in tmp_path.iterdir()) == ["half.png"]


def edited(tmp_path: Path, old: str, new: str) -> Path:
    path = tmp_path / "points.csv"
    path.write_text(TABLE_5_2.read_text().replace(old, new))
    return path


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("zw_mm", "z", r"points\.csv:1: columns missing: zw_mm"),
        ("243.9960", "abc", r"points\.csv:2: Xf_px: 'abc'; allowed: a number"),
        (",243.9960,98.3353", "", r"points\.csv:2: Yf_px"),
        ("243.9960", "nan", "point 1 is not finite"),
        ("243.9960", "343.9960", r"point 1 agrees least, it is \d+\.\d px"),
        ("18.8,94.0,0.0", "18.8,94.0,1.0", "point 1 is off the board's plane"),
    ],
)
def test_bad_points_are_named(tmp_path: Path, old: str, new: str, message: str) -> None:
    said = refused("--points", edited(tmp_path, old, new), "--output", tmp_path / "c.yaml")
    assert re.search(message, said), said
    assert not (tmp_path / "c.yaml").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "--points"),
        (["--points", TABLE_5_2, "--board", BOARD], "exactly one"),
        (["--board", BOARD], "--pitch-mm, --columns and --rows"),
        (["--board", BOARD, *GRID, "--width-px", "800"], "640 x 480 pixels"),
        (["--board", BOARD, *GRID, "--square-mm", "20"], "--square-mm"),
        (["--board", TABLE_5_2, *GRID], "no image"),
        (["--board", "none.png", *GRID], "none.png: no such file"),
        (["--points", "none.csv"], "none.csv: cannot be read"),
        (["--points", TABLE_5_2, "--dx-mm", "0"], "--dx-mm 0: allowed: above 0"),
        (["--points", TABLE_5_2, "--alpha-deg", "90"], "--alpha-deg 90"),
        (["--points", TABLE_5_2, "--view-angle-deg", "0"], "--view-angle-deg 0"),
        (["--points", TABLE_5_2, "--overlay", "picture.nonsense"], "no picture format"),
    ],
)
def test_options_that_do_not_fit_are_refused(tmp_path: Path, arguments: list[object], message: str) -> None:
    assert message in refused(*arguments, "--output", tmp_path / "c.yaml")
    assert not (tmp_path / "c.yaml").exists()
