"""`inspector calibrate --heights`: samples of rendered seeds whose measured heights are made 3 % larger than true."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner, Result

from inspector import calibration_file
from inspector.cli.app import app

HEAD = "note,height_mm,frame,x_mm,y_mm"
TRUE_GAIN = 1.03


@pytest.fixture
def rows(frames_folder: Path) -> list[str]:
    """A line for each rendered seed, its position read off to half a millimetre."""
    truth = json.loads((frames_folder / "truth.json").read_text())
    return [
        f"ok,{seed['height_um'] / 1000 * TRUE_GAIN:.4f},{name}.png,{seed['x_mm'] + 0.5:.1f},{seed['y_mm'] - 0.4:.1f}"
        for name in ("one_seed", "large_seed", "four_seeds")
        for seed in truth[name]
    ]


@pytest.fixture
def calibrate(frames_folder: Path, tmp_path: Path) -> Callable[..., Result]:
    """``calibrate(rows, *options)``: run the command on a CSV file beside links to the frames."""
    for frame in frames_folder.glob("*.png"):
        (tmp_path / frame.name).symlink_to(frame)

    def run(rows: list[str], *options: str) -> Result:
        samples = tmp_path / "samples.csv"
        samples.write_text("\n".join([HEAD, *rows]) + "\n")
        command = ["calibrate", "--heights", str(samples), "--calibration", str(frames_folder / "calibration.yaml")]
        return CliRunner().invoke(app, [*command, "--output", str(tmp_path / "out.yaml"), *options])

    return run


def test_the_gain_is_found_and_all_else_is_kept(
    rows: list[str], calibrate: Callable[..., Result], frames_folder: Path, tmp_path: Path
) -> None:
    done = calibrate(rows)
    assert done.exit_code == 0, done.output
    assert "height_gain 1.03" in done.output
    written, before = tmp_path / "out.yaml", frames_folder / "calibration.yaml"
    assert calibration_file.read(written).height_gain == pytest.approx(TRUE_GAIN, abs=2e-3)
    kept, original = (yaml.safe_load(p.read_text()) for p in (written, before))
    assert {key: kept[key] for key in original} == original


def test_a_gain_already_there_does_not_count(rows: list[str], calibrate: Callable[..., Result], tmp_path: Path) -> None:
    calibrate(rows)
    first = calibration_file.read(tmp_path / "out.yaml").height_gain
    (tmp_path / "first.yaml").write_bytes((tmp_path / "out.yaml").read_bytes())
    done = calibrate(rows, "--calibration", str(tmp_path / "first.yaml"))
    assert calibration_file.read(tmp_path / "out.yaml").height_gain == first
    assert f"was {first:.4f}" in done.output


def test_residuals_and_uncertainty_of_the_camera_are_kept(
    rows: list[str], calibrate: Callable[..., Result], frames_folder: Path, tmp_path: Path
) -> None:
    document = yaml.safe_load((frames_folder / "calibration.yaml").read_text())
    document["light"] = {"alpha_deg": 30.0}
    document["uncertainty"] = {"parameters": ["f_mm"], "covariance": [[1e-4]]}
    point = {"world_mm": [0.0, 0.0, 0.0], "seen_px": [1.0, 2.0], "residual_px": [0.1, 0.0]}
    document["residuals"] = {"method": "tsai", "mean_px": 0.1, "rms_px": 0.1, "largest_px": 0.1, "points": [point]}
    (tmp_path / "in.yaml").write_text(yaml.safe_dump(document))
    assert calibrate(rows, "--calibration", str(tmp_path / "in.yaml")).exit_code == 0
    kept = yaml.safe_load((tmp_path / "out.yaml").read_text())
    assert {key: kept[key] for key in document} == document


def test_every_sample_without_a_defect_is_named(
    rows: list[str], calibrate: Callable[..., Result], tmp_path: Path
) -> None:
    wrong = ["x,2,clean.png,50,50", "x,2,missing.png,50,50", "x,2,one_seed.png,1,2", rows[0]]
    done = calibrate([*rows, *wrong])
    assert done.exit_code == 1
    assert not (tmp_path / "out.yaml").exists()
    line = len(rows) + 2
    for n, reason in enumerate(
        ("clean.png: no defect", "missing.png: not inspected: no such file", "no defect within 2 mm", "line 2; correct")
    ):
        assert f"samples.csv:{line + n}: " in done.output
        assert reason in done.output


def test_cells_that_are_no_numbers_are_named(calibrate: Callable[..., Result]) -> None:
    done = calibrate(["x,two,one_seed.png,1,2", "x,2,one_seed.png,,2", "x,2"])
    assert done.exit_code == 1
    for where in ("samples.csv:2: height_mm: 'two'", "samples.csv:3: x_mm: ''", "samples.csv:4: y_mm: None"):
        assert where in done.output


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (["--tolerance-mm", "0"], "--tolerance-mm 0: allowed: above 0"),
        (["--tolerance-mm", "0.1"], "no defect within 0.1 mm"),
        (["--points", "p.csv"], "exactly one of --points FILE.csv, --board IMAGE and --heights FILE.csv"),
        (["--calibration", "missing.yaml"], "missing.yaml"),
    ],
)
def test_options_that_do_not_fit_are_refused(
    rows: list[str], calibrate: Callable[..., Result], options: list[str], reason: str
) -> None:
    done = calibrate(rows, *options)
    assert done.exit_code == 1
    assert reason in done.output


def test_heights_need_a_calibration(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["calibrate", "--heights", "h.csv", "--output", str(tmp_path / "o.yaml")])
    assert done.exit_code == 1
    assert "--calibration" in done.output
