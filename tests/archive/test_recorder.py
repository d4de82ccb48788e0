"""Which frames are kept, where, and which go when room is wanted; whoever lists the folders finds whole images only."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from itertools import accumulate
from pathlib import Path
from threading import Event
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_bridge.drivers.replay_camera import ReplayCamera
from firmware_bridge.wire import session
from firmware_bridge.wire.session import Recorded
from inspector.archive import recorder as recorder_module
from inspector.archive.archive_settings import KeptFrames
from inspector.archive.recorder import FRAMES, LAST, Plan, Recorder, Version
from inspector.archive.retention import DAY_S, Held, Limits, overdue, past_the_last
from inspector.archive.session_frames import Inspected, Kept, inspected
from inspector.archive.shelf import Shelf
from inspector.model import FrameResult, Verdict
from inspector.outage import Outage

VERSION = Version("0a", "{}\n")


@pytest.fixture
def recorder(tmp_path: Path) -> Iterator[Callable[..., Recorder]]:
    started: list[Recorder] = []

    def start(**settings: Any) -> Recorder:
        kept = KeptFrames(**{"min_free_mb": 0, **settings})
        started.append(Recorder(tmp_path, kept, {"station": "line 2"}, Outage("frames")))
        return started[-1]

    yield start
    for one in started:
        one.close(20)


def image(number: int) -> np.ndarray[Any, Any]:
    return np.full((48, 64), number % 251, np.uint8)


def put(recorder: Recorder, number: int, passed: bool, at_s: float | None = None) -> Plan | None:
    plan = recorder.plan(passed, 1, time.time() if at_s is None else at_s)
    if plan is not None:
        said = Inspected("0a", plan.kept, FrameResult("", Verdict.PASS if passed else Verdict.FAIL), sequence=number)
        recorded = Recorded(f"{number:010d}-00.png", number, 5.0, 1000.0, 1000.0, 4.0, 4.0, said.as_dict())
        recorder.put(plan, VERSION, [(image(number), recorded)])
    return plan


def numbers(folder: Path) -> list[int]:
    """The frames in the sessions of a shelf, as a reader of sessions finds them."""
    found = []
    for index in sorted(folder.glob(f"*/{session.INDEX}")):
        for recorded in session.parse(index.read_text()):
            said = inspected(recorded)
            assert said is not None
            shown = cv2.imread(str(index.with_name(recorded.file)), cv2.IMREAD_UNCHANGED)
            assert (shown == image(recorded.frame_id)).all()
            found.append(recorded.frame_id)
    return found


def test_all_that_failed_a_sample_of_what_passed_and_the_last(recorder: Any, tmp_path: Path) -> None:
    one = recorder(passing_every=10, last=20)
    for number in range(100):
        put(one, number, passed=number % 7 != 0)
    one.close(20)
    passed = [n for n in range(100) if n % 7]
    assert numbers(tmp_path / FRAMES) == sorted([*range(0, 100, 7), *passed[9::10]])
    last = numbers(tmp_path / LAST)
    assert last == list(range(last[0], 100))
    assert last[0] <= 80
    assert not list(tmp_path.rglob(".*"))


def test_the_ring_keeps_no_more_than_it_should(recorder: Any, tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(recorder_module, "LOOK_EVERY_S", 0.0)
    one = recorder(failing=False, passing_every=None, last=8)
    for number in range(100):
        put(one, number, passed=True)
    one.close(60)
    one.make_room()
    found = numbers(tmp_path / LAST)
    assert found == list(range(found[0], 100))
    assert 8 <= len(found) <= 12


def test_a_session_is_shown_by_the_replay_camera(recorder: Any, tmp_path: Path) -> None:
    one = recorder()
    plan = put(one, 3, passed=False)
    one.close(20)
    assert plan is not None
    assert plan.frames is not None
    camera = ReplayCamera([tmp_path / FRAMES / plan.frames])
    camera.open()
    frame = camera.grab()
    assert (frame.image == image(3)).all()
    assert frame.exposure_us == 1000.0


def test_frames_of_least_worth_are_left_out_when_the_disk_is_slow(
    recorder: Any, tmp_path: Path, monkeypatch: Any
) -> None:
    one, let_go = recorder(passing_every=2, last=50), Event()
    write = one._write

    def slow(jobs: Any) -> None:
        let_go.wait(20)
        write(jobs)

    monkeypatch.setattr(one, "_write", slow)
    monkeypatch.setattr(recorder_module, "QUEUE_BYTES", 20 * image(0).nbytes)
    for number in range(60):
        put(one, number, passed=number % 3 != 0)
    assert one.waiting_bytes <= 20 * image(0).nbytes
    assert one.left_out >= 30
    let_go.set()
    one.close(20)
    failing = [n for n in range(60) if n % 3 == 0]
    assert set(failing[-18:]) <= set(numbers(tmp_path / FRAMES))


def test_what_a_crash_left_half_done_is_taken_away(recorder: Any, tmp_path: Path) -> None:
    one = recorder()
    plan = put(one, 1, passed=False)
    one.close(20)
    assert plan is not None
    folder = tmp_path / FRAMES / str(plan.frames)
    (folder / ".0000000002-00.png.part").write_bytes(b"\x89PNG")
    (folder / "0000000003-00.png").write_bytes(b"\x89PNG half")
    with (folder / session.INDEX).open("a") as index:
        index.write('{"file": "0000000004-00')
    (tmp_path / FRAMES / ".going-old").mkdir()
    recorder().close(20)
    assert numbers(tmp_path / FRAMES) == [1]
    assert sorted(p.name for p in folder.iterdir() if p.suffix == ".png") == ["0000000001-00.png"]
    assert not list(tmp_path.rglob(".*"))


def test_a_folder_that_cannot_be_written_costs_frames_and_is_said_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / FRAMES).write_text("a file where the folder should be")
    one = Recorder(tmp_path, KeptFrames(min_free_mb=0, last=0), {}, Outage("keeping of frames"))
    for number in range(5):
        put(one, number, passed=False)
    one.close(20)
    assert one.left_out == 5
    assert sum("keeping of frames fails" in record.message for record in caplog.records) == 1


HELD = st.lists(
    st.builds(Held, st.uuids().map(str), st.integers(0, 10**9), st.floats(0, 1e9), st.integers(0, 500)), max_size=8
)


@given(HELD, st.floats(0.01, 100), st.floats(0.01, 4000), st.floats(0, 2e9), st.floats(0, 2e9))
def test_no_more_goes_than_has_to_and_the_oldest_first(
    held: list[Held], days: float, most_mb: float, least_free: float, free: float
) -> None:
    now_s = 1e9
    old = overdue(held, Limits(days, 1e9, 0.0), now_s, 0.0)
    assert all(now_s - h.newest_s > days * DAY_S for h in held if h.name in old)
    going = overdue(held, Limits(days, most_mb, least_free), now_s, free)
    young = [name for name in going if name not in old]
    assert young == [h.name for h in held if h.name not in old][: len(young)]
    left = [h for h in held if h.name not in going]
    freed = sum(h.size_bytes for h in held if h.name in going)
    fits = sum(h.size_bytes for h in left) <= most_mb * 1e6 and free + freed >= least_free
    assert set(old) <= set(going)
    assert not left or fits


@given(st.lists(st.integers(1, 80), min_size=1, max_size=8), st.integers(1, 60))
def test_frames_go_at_their_age_while_the_line_runs(pauses_days: list[int], days: int) -> None:
    now_s, ages = 1e9, list(accumulate(pauses_days))
    held = [Held(str(age), 1, now_s - age * DAY_S, 1) for age in reversed(ages)]
    assert overdue(held, Limits(days, 1.0, 0.0), now_s, 0.0) == [str(a) for a in reversed(ages) if a > days]


@pytest.mark.parametrize("ahead_days", [365, 20_000])
def test_a_clock_that_is_set_ahead_deletes_nothing_and_one_set_back_stops_nothing(ahead_days: float) -> None:
    held = [Held(str(day), 1, 1e9 + day * DAY_S, 1) for day in range(20)]
    ahead_s, limits = 1e9 + ahead_days * DAY_S, Limits(30, 1.0, 0.0)
    after = Held("after", 1, ahead_s, 1)
    assert overdue([*held, after], limits, ahead_s + 3600, 0.0) == []
    assert overdue([after, *held], limits, 1e9 + 40.5 * DAY_S, 0.0) == [str(day) for day in range(11)]


def test_sessions_from_before_the_clock_was_set_back_are_the_oldest(tmp_path: Path) -> None:
    at_s = {"before": 3600.0, "after": 100.0, "later": 200.0}
    names = {what: time.strftime("%Y%m%dT%H%M%SZ-0", time.gmtime(when)) for what, when in at_s.items()}
    for name in names.values():
        (tmp_path / name).mkdir()
    shelf = Shelf(tmp_path)
    assert [h.name for h in shelf.held((), 250.0)] == [names[what] for what in ("before", "after", "later")]
    assert [h.name for h in shelf.held((), 9999.0)] == sorted(names.values())


def test_what_is_somebody_elses_or_stuck_stays_and_the_rest_goes(
    recorder: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(recorder_module, "SESSION_FRAMES", 1)
    shelf = tmp_path / FRAMES
    for folder in ("kept by hand", "20200101T000000Z-stuck"):
        (shelf / folder).mkdir(parents=True)
        (shelf / folder / "a.png").symlink_to("nowhere")
    (shelf / "notes.txt").write_text("not a session")
    (shelf / ".going-20200101T000000Z-stuck" / "in the way").mkdir(parents=True)
    monkeypatch.setattr(Shelf, "clean", lambda _: None)
    one = recorder(last=0, most_mb=1e-6)
    for number in range(9):
        put(one, number, passed=False)
    one.close(20)
    for _ in range(2):
        one.make_room()
    assert len(numbers(shelf)) == 1
    assert {"kept by hand", "20200101T000000Z-stuck", "notes.txt"} < {path.name for path in shelf.iterdir()}
    assert caplog.text.count("cannot be deleted") == 1


def test_nothing_is_touched_in_a_folder_that_is_not_ours(recorder: Any, tmp_path: Path) -> None:
    half = tmp_path / FRAMES / "20260101T000000Z-0" / ".0000000002-00.png.part"
    half.parent.mkdir(parents=True)
    half.write_bytes(b"being written by somebody else")
    one = Recorder(tmp_path, KeptFrames(min_free_mb=0, days=1e-9), {}, Outage("frames"), lambda: False)
    for number in range(5):
        put(one, number, passed=False)
    one.make_room()
    one.close(20)
    assert one.left_out == 5
    assert half.exists()
    assert [path.name for path in (tmp_path / FRAMES).iterdir()] == [half.parent.name]


@given(HELD, st.integers(0, 1000))
def test_the_last_frames_stay(held: list[Held], last: int) -> None:
    going = past_the_last(held, last)
    left = sum(h.frames for h in held[len(going) :])
    assert left >= min(last, sum(h.frames for h in held))
    assert not held[len(going) :] or left - held[len(going)].frames < last


def test_the_oldest_sessions_go_when_they_take_too_much(recorder: Any, tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(recorder_module, "SESSION_FRAMES", 5)
    one = recorder(most_mb=0.05, last=0)
    for number in range(40):
        put(one, number, passed=False)
    one.close(20)
    one.make_room()
    found = numbers(tmp_path / FRAMES)
    assert found == list(range(found[0], 40))
    sizes = sum(held.size_bytes for held in Shelf(tmp_path / FRAMES).held((), time.time())[:-1])
    assert sizes <= 0.05e6
    assert Kept.FAILING.value == "failing"


def test_a_session_that_is_being_written_counts_and_ends_when_it_grows(
    recorder: Any, tmp_path: Path, wait_until: Any
) -> None:
    one = recorder(most_mb=0.1, last=0)
    for number in range(30):
        put(one, number, passed=False)
        wait_until(lambda: not one.waiting_bytes, "the frame on the disk")
        one.make_room()
    one.close(20)
    one.make_room()
    taken = sum(file.stat().st_blocks * 512 for file in (tmp_path / FRAMES).glob("*/*"))
    assert 0 < taken <= 0.1e6
    found = numbers(tmp_path / FRAMES)
    assert found == list(range(found[0], 30))
