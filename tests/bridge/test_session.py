"""A session's index: what is written is read back, what is cut short costs one line, what is wrong is named."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_bridge import errors
from firmware_bridge.drivers.replay_camera import ReplayCamera
from firmware_bridge.wire import session
from firmware_bridge.wire.session import Recorded, SessionWrong

NUMBERS = st.floats(allow_nan=False, allow_infinity=False)
NAMES = st.text(st.characters(codec="utf-8", exclude_characters="/"), min_size=1).filter(lambda n: n not in (".", ".."))
FRAMES = st.builds(Recorded, NAMES, st.integers(0), NUMBERS, st.none() | NUMBERS, NUMBERS, st.none() | NUMBERS, NUMBERS)


def index_of(*frames: Recorded) -> str:
    return session.first_line({"station": "line 2"}) + "".join(map(session.line, frames))


@given(st.lists(FRAMES))
def test_what_is_written_is_read_back(frames: list[Recorded]) -> None:
    assert session.parse(index_of(*frames)) == tuple(frames)


@given(st.lists(FRAMES, min_size=1), st.data())
def test_a_power_cut_costs_the_last_line_only(frames: list[Recorded], data: st.DataObject) -> None:
    whole = index_of(*frames)
    cut = whole[: data.draw(st.integers(len(index_of()), len(whole)))]
    assert session.parse(cut) == tuple(frames[: cut.count("\n") - 1])


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("{", "line 3: "),
        ("[]", "line 3: not a JSON object"),
        ("{}", "line 3: file is None"),
        ('{"file": "../etc"}', "line 3: file is '../etc', not a name beside the index"),
        ('{"file": "b.png", "frame_id": "2"}', "line 3: frame_id is '2', not a number"),
    ],
)
def test_a_wrong_line_is_named(line: str, words: str) -> None:
    text = index_of(Recorded("a.png", 1, 0.0, 1000.0, 1000.0, 4.0, 4.0)) + line + "\n"
    with pytest.raises(SessionWrong) as caught:
        session.parse(text)
    assert words in str(caught.value)


@pytest.mark.parametrize("heading", ["{}", '{"session": 2}', ""])
def test_another_kind_of_index_is_refused(heading: str) -> None:
    with pytest.raises(SessionWrong, match="line 1"):
        session.parse(heading + "\n")


def test_the_replay_camera_shows_a_session_in_its_order_at_its_exposures(tmp_path: Path) -> None:
    frames = [("b.png", 7, 800.0), ("a.png", 9, None), ("c.png", 11, 1200.0)]
    for name, level, _ in frames:
        cv2.imwrite(str(tmp_path / name), np.full((6, 8), level, np.uint8))
    recorded = [Recorded(name, level, 0.0, us, 1000.0, 4.0, 4.0) for name, level, us in frames]
    (tmp_path / session.INDEX).write_text(index_of(*recorded))
    camera = ReplayCamera([tmp_path])
    camera.open()
    camera.set_exposure_us(1000.0)
    shown = [camera.grab() for _ in range(4)]
    assert [int(frame.image[0, 0]) for frame in shown] == [7, 9, 11, 7]
    assert [frame.exposure_us for frame in shown] == [800.0, None, 1200.0, 800.0]


def test_a_session_with_a_wrong_index_is_a_camera_gone_and_back_when_it_is_mended(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.full((6, 8), 5, np.uint8))
    (tmp_path / session.INDEX).write_text(json.dumps({"session": 9}) + "\n")
    camera = ReplayCamera([tmp_path])
    with pytest.raises(errors.DeviceGone, match=r"session\.jsonl: line 1"):
        camera.open()
    (tmp_path / session.INDEX).unlink()
    camera.open()
    assert int(camera.grab().image[0, 0]) == 5
