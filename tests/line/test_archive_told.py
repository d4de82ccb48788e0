"""`inspector explain` and `inspector report`: what they tell is what was recorded, and what is gone is said to be."""

from __future__ import annotations

import json
import math
import re
import shutil
import sqlite3
from contextlib import closing
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from inspector.archive.session_frames import inspected
from inspector.cli.app import app
from inspector.sessions import RecordedFrame, read_session
from tests.support import forked

pytestmark = pytest.mark.xdist_group("kept")


def run(*options: object) -> Any:
    """The command's outcome."""
    return CliRunner().invoke(app, list(map(str, options)))


def stored(archive: Path, sql: str) -> list[tuple[Any, ...]]:
    with closing(sqlite3.connect(archive / "results.sqlite")) as store:
        return store.execute(sql).fetchall()


@pytest.fixture
def archive(kept: Any, tmp_path: Path) -> Path:
    """A copy of the archive, to be changed."""
    return Path(shutil.copytree(kept[0].folder / "archive", tmp_path / "archive"))


class Page(HTMLParser):
    """An HTML file: its words, its images, and whatever it would fetch."""

    def __init__(self, file: Path) -> None:
        super().__init__()
        self.words, self.images, self.fetched, self.open = "", 0, list[str](), list[str]()
        self.feed(file.read_text())
        self.close()
        assert not self.open
        assert "@import" not in file.read_text()
        assert "url(" not in file.read_text()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in ("img", "meta", "rect", "path", "circle", "polygon", "br"):
            self.open.append(tag)
        self.images += tag == "img"
        for name, value in attrs:
            if name in ("src", "href", "xlink:href", "srcset", "data", "action") and not (value or "").startswith(
                "data:"
            ):
                self.fetched.append(f"{tag} {name}={value}")
        self.fetched += [tag] if tag in ("link", "script", "iframe") else []

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag in self.open[-1:]:
            self.open.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words += data


def test_every_step_explained_gives_the_result_recorded(kept: Any) -> None:
    station, _ = kept
    archive = station.folder / "archive"
    verdicts = dict(stored(archive, "SELECT sequence, verdict FROM result ORDER BY id LIMIT 3"))
    assert set(verdicts.values()) == {0, 1, 2}
    for sequence in verdicts:
        done = run("explain", sequence, "--config", station.file, "--format", "json")
        assert (done.exit_code, done.stderr) == (0, "")
        said = json.loads(done.stdout)
        assert said["same"] is True
        rows = stored(
            archive, f"SELECT height_um, height_sigma_um, x_mm FROM defect WHERE result = {said['result']['id']}"
        )
        seeds = [seed for frame in said["frames"] for seed in frame.get("seeds", [])]
        assert [(s["exact_height_um"], s["exact_sigma_um"], s["x_mm"]) for s in seeds] == rows
        assert [tuple(s["defect"][key] for key in ("height_um", "height_sigma_um", "x_mm")) for s in seeds] == rows
        for seed in seeds:
            squares = math.hypot(seed["spots_sigma_um"], seed["calibration_sigma_um"] or 0.0)
            assert squares == pytest.approx(seed["exact_sigma_um"], rel=1e-12)
            for side in ("direct", "mirror"):
                assert seed[side]["xy_px"] == seed["defect"][f"{side}_px"]
                assert seed[side]["expected_px"] == pytest.approx(seed[side]["xy_px"], abs=0.1)
        fails = [finding for finding in said["judgement"]["findings"] if finding["fails"]]
        assert bool(fails) is (verdicts[sequence] == 2)


def test_each_highlight_and_each_couple_says_what_became_of_it(kept: Any) -> None:
    done = run("explain", "3", kept[0].folder / "archive", "--format", "json", "--frame", "0")
    (frame,) = json.loads(done.stdout)["frames"]
    pairs = [couple for couple in frame["couples"] if couple["pair"] is not None]
    assert len(pairs) == len(frame["seeds"]) > 1
    serving = [spot["number"] for spot in frame["highlights"] if not spot["serves"].startswith("alone")]
    assert sorted(end for couple in pairs for end in (couple["direct"], couple["mirror"])) == serving
    assert all(couple["log_odds"] > 2 for couple in pairs)
    residuals = {couple["pair"]: couple["residual_sigma"] for couple in pairs}
    assert all(residuals[seed["pair"]] == seed["defect"]["residual_sigma"] for seed in frame["seeds"])
    assert frame["background_dn"] < frame["threshold_dn"]


def test_a_frame_that_is_another_than_recorded_is_found_out(archive: Path) -> None:
    ((image,),) = stored(archive, "SELECT image FROM frame WHERE result & 0xffffffff = 3")
    (archive / image).write_bytes(cv2.imencode(".png", np.full((480, 640), 20, np.uint8))[1].tobytes())
    done = run("explain", "3", archive)
    assert done.exit_code == 1
    assert "DIFFERS" in done.stdout


def test_without_its_frame_a_result_is_explained_by_its_rows(archive: Path, tmp_path: Path) -> None:
    for shelf in ("frames", "last"):
        shutil.rmtree(archive / shelf)
    done = run("explain", "3", archive)
    assert done.exit_code == 0
    assert "Nothing could be recomputed" in done.stdout
    assert "it is gone" in done.stdout
    heights = stored(archive, "SELECT height_um FROM defect WHERE result & 0xffffffff = 3")
    assert all(f"{height:.1f}" in done.stdout for (height,) in heights)
    assert "over" in done.stdout
    assert run("report", "result:3", archive, "--output", tmp_path / "out.html").exit_code == 0
    page = Page(tmp_path / "out.html")
    assert "it is gone" in page.words
    assert page.images == 0


def test_the_report_on_a_panel_has_all_in_one_file(kept: Any, tmp_path: Path) -> None:
    station, _ = kept
    ((panel, number),) = stored(station.folder / "archive", "SELECT panel_id, id FROM result WHERE sequence = 3")
    subject = panel or f"result:{number}"
    assert run("report", subject, "--config", station.file, "--output", tmp_path / "out.html").exit_code == 0
    page = Page(tmp_path / "out.html")
    assert page.fetched == []
    assert page.images == 1
    seeds = stored(station.folder / "archive", f"SELECT height_um, height_sigma_um FROM defect WHERE result = {number}")
    assert len(seeds) > 1
    for height, sigma in seeds:
        assert f"{height:.1f}" in page.words
        assert f"{sigma:.1f}" in page.words
    assert "black gloss" in page.words


def test_the_report_on_a_shift_counts_what_the_store_does(kept: Any, tmp_path: Path) -> None:
    station, _ = kept
    archive, out = station.folder / "archive", tmp_path / "out.html"
    ((day,),) = stored(archive, "SELECT date(min(at_s), 'unixepoch', 'localtime') FROM result")
    assert run("report", f"{day}/round the clock", "--config", station.file, "--output", out).exit_code == 0
    page = Page(out)
    assert page.fetched == []
    total = stored(archive, "SELECT count(*) FROM result")[0][0]
    for verdict, name in ((1, "PASS"), (2, "FAIL"), (0, "NOT_INSPECTED")):
        ((count,),) = stored(archive, f"SELECT count(*) FROM result WHERE verdict = {verdict}")
        assert f"{name}{count} ({count / total:.1%})" in page.words
    ((failed,),) = stored(archive, "SELECT count(*) FROM result WHERE verdict = 2")
    assert page.images == min(failed, 24)
    assert "settings" in page.words.lower()
    assert run("report", "2001-01-01/06:00-14:00", archive, "--output", out).exit_code == 0
    assert "No result was kept in it." in Page(out).words


def one_panel(station: Any, archive: Path, frame: str, **own: Any) -> None:
    """A panel inspected by settings of its ``own`` from a recorded frame, into an archive."""
    settings = station.settings | own
    settings["archive"] = {"folder": str(archive), "frames": {"min_free_mb": 0}}
    settings["camera"] = settings["camera"] | {"paths": [str(station.frames / frame)]}
    file = station.folder / f"{archive.parent.name}.yaml"
    file.write_text(json.dumps(settings))
    forked.run("run", "--config", file, "--panels", "1").check_returncode()


def test_sightings_of_several_frames_are_told_with_their_panel(
    kept: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    panel = {"frames": {"kind": "count", "count": 2}, "travel": {"by": {"kind": "pitch", "mm_per_frame": 0.01}}}
    one_panel(kept[0], tmp_path / "archive", "F000.png", panel=panel)
    done = run("explain", "1", tmp_path / "archive", "--format", "json")
    said = json.loads(done.stdout)
    assert (done.exit_code, said["same"], said["panel"]["same"]) == (0, True, True)
    assert [len(seed["sightings"]) for seed in said["panel"]["seeds"]] == [2] * len(said["stored_seeds"])
    told = [seed["seed"]["height_um"] for seed in said["panel"]["seeds"]]
    assert told == [seed["height_um"] for seed in said["stored_seeds"]]
    assert "frame 1" in run("explain", "1", tmp_path / "archive").stdout
    monkeypatch.chdir(tmp_path)
    assert run("report", "result:1", "archive").exit_code == 0
    assert Page(tmp_path / "report-result-1.html").images == 2


CHAIN = re.compile(
    r"alpha (.+), beta (.+) deg: X = (.+) \(5\.1\), EA = X cos beta = (.+) \(4\.4\),"
    r" CA = EA / cos\(2 beta - 90\) = (.+) \(4\.1\), h = CA sin\(90 - beta\) = (.+) \(4\.2\),"
    r" a = (.+) mm \(4\.5\), x gain: (.+) um"
)


def test_a_height_by_the_thesis_is_told_with_its_equations(kept: Any, tmp_path: Path) -> None:
    recipe = kept[0].settings["recipe"] | {"method": "thesis"}
    one_panel(kept[0], tmp_path / "archive", "F000.png", recipe=recipe)
    heights = [height for (height,) in stored(tmp_path / "archive", "SELECT height_um FROM defect ORDER BY number")]
    done = run("explain", "1", tmp_path / "archive")
    assert done.exit_code == 0
    assert "to the last bit" in done.stdout
    assert done.stdout.count("the result is by the method thesis") == len(heights) > 1
    chains = [tuple(map(float, values)) for values in CHAIN.findall(done.stdout)]
    for (alpha, beta, x, ea, ca, h, a, told), height in zip(chains, heights, strict=True):
        beta_rad, middle = math.radians(beta), math.radians((beta - alpha) / 2)
        assert ea == pytest.approx(x * math.cos(beta_rad), rel=1e-4)
        assert ca == pytest.approx(ea / math.sin(2 * beta_rad), rel=1e-4)
        assert h == pytest.approx(ca * math.cos(beta_rad), rel=1e-4)
        assert a == pytest.approx(h / ((1 + math.cos(middle)) / 2), rel=1e-4)
        assert (told, a) == (pytest.approx(height, abs=0.06), pytest.approx(height / 1000, rel=1e-4))


@pytest.mark.parametrize(("options", "says"), [
    (["explain", "99999"], "no result 99999"),
    (["explain", "two"], "allowed: its sequence"),
    (["explain", "1", "--frame", "7"], "--frame 7"),
    (["report", "yesterday"], "result:1041"),
    (["report", "99999"], "no panel 99999"),
    (["report", "9" * 30], "a panel's id"),
    (["report", "2026-11-26/late"], "round the clock"),
    (["report", "noon..2026-11-26"], "allowed: a sequence, or a time"),
    (["report", "result:1", "--output", "no/such/folder/out.html"], "not written"),
])  # fmt: skip
def test_what_cannot_be_told_is_refused_with_a_remedy(
    kept: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: list[str], says: str
) -> None:
    monkeypatch.chdir(tmp_path)
    done = run(*options, "--config", kept[0].file)
    assert done.exit_code == 2
    assert says in done.stderr
    assert not list(tmp_path.iterdir())


def test_a_recorded_line_of_another_frame_is_not_taken_for_it(archive: Path) -> None:
    with closing(sqlite3.connect(archive / "results.sqlite")) as store, store:
        store.execute("UPDATE frame SET taken_at_s = taken_at_s - 60 WHERE result & 0xffffffff = 3")
    assert json.loads(run("explain", "3", archive, "--format", "json").stdout)["same"] is None
    folder = next((archive / "frames").iterdir())
    frames = [item for item in read_session(folder) if isinstance(item, RecordedFrame)]
    assert any((said := inspected(frame.recorded)) and said.sequence == 3 for frame in frames)
