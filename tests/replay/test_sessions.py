"""Recorded sessions read again and inspected again: to the last bit, and whatever became of the index meanwhile."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import panel_frames
import pytest
import recorded_sessions
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_bridge.wire import session
from firmware_bridge.wire.session import Recorded, SessionWrong
from inspector import imagefile
from inspector.archive import result_json
from inspector.archive.session_frames import Inspected, Kept
from inspector.model import FrameResult, PanelFrame, Verdict
from inspector.reinspection import Change, Reinspection
from inspector.sessions import RecordedFrame, Spoilt, find, read, read_session, stretches
from inspector.settings_version import VersionWrong

PATCH = {"patch": {"x_px": 560, "y_px": 20, "width_px": 60, "height_px": 60}, "target_dn": 150}
SEVERAL = {
    "frames": {"kind": "count", "count": panel_frames.FRAMES},
    "travel": {"by": {"kind": "pitch", "mm_per_frame": panel_frames.STEP_MM}, "direction_deg": 90},
}


def frames_of(folder: Path) -> list[RecordedFrame]:
    items = read_session(folder)
    assert not [item for item in items if isinstance(item, Spoilt)]
    return [item for item in items if isinstance(item, RecordedFrame)]


def test_frames_with_a_reference_in_the_field_are_inspected_as_they_were(tmp_path: Path) -> None:
    recording = recorded_sessions.Recording(tmp_path / "one")
    version = recorded_sessions.version(tmp_path, light=PATCH)
    for image in recorded_sessions.images():
        lit = image.copy()
        lit[20:80, 560:620] = 150
        recording.panel(version, [lit])
    frames = frames_of(tmp_path / "one")
    assert len(frames) == len(recorded_sessions.FRAMES)
    for frame in frames:
        assert frame.inspected
        image, again = imagefile.read(frame.image), Reinspection(frame.version())
        assert result_json.same(again.frame(image, frame.recorded.file), frame.inspected.result)
        with_patch = Reinspection(Change(version=recorded_sessions.version(tmp_path)).applied(frame.version()))
        assert not result_json.same(with_patch.frame(image, frame.recorded.file), frame.inspected.result)


def test_a_panel_of_several_frames_is_judged_as_it_was(tmp_path: Path) -> None:
    images = [imagefile.read(file) for file in panel_frames.write(tmp_path)]
    recording = recorded_sessions.Recording(tmp_path / "one")
    version = recorded_sessions.version(tmp_path, panel=SEVERAL)
    travels_mm = [n * panel_frames.STEP_MM for n in range(len(images))]
    recording.panel(version, images, travels_mm)
    frames = frames_of(tmp_path / "one")
    again = Reinspection(frames[0].version())
    said = [frame.inspected for frame in frames]
    last = said[-1]
    assert last
    assert last.panel
    assert len(last.panel.defects) == len(panel_frames.SEEDS)
    parts = [
        PanelFrame(again.frame(imagefile.read(frame.image), frame.recorded.file), travel_mm)
        for frame, travel_mm in zip(frames, travels_mm, strict=True)
    ]
    assert result_json.same(again.panel(parts, last.panel_id, last.missing), last.panel)


def test_another_recipe_of_the_same_id_is_used_where_the_settings_have_it(tmp_path: Path) -> None:
    old = recorded_sessions.version(tmp_path, recipe={"id": 2, "limits": {"max_height_um": 900}})
    recipes = [{"id": n, "name": f"r{n}", "limits": {"max_height_um": 100 * n}} for n in (1, 2)]
    new = recorded_sessions.version(tmp_path, recipe=1, recipes=recipes)
    assert Change(version=new).applied(old).recipe.limits.max_height_um == 200
    assert Change(version=new, method="thesis").applied(old).recipe.method == "thesis"
    assert Change(recipe=new.recipe).applied(old).recipe == new.recipe
    assert Change().applied(old) is old


LINES = st.lists(
    st.one_of(
        st.integers(1, 4),  # a panel of so many frames
        st.sampled_from([b"{", b"[]", b"\xff\xfe", b'{"file": "../a.png"}', b""]),
    ),
    max_size=12,
)


def index_of(shape: list[int | bytes], end: bytes) -> bytes:
    """An index of panels of so many frames and of spoilt lines, with ``end`` after the last whole line."""
    lines = [session.first_line({"station": "x"}).encode()]
    for sequence, what in enumerate(shape, 1):
        if isinstance(what, bytes):
            lines.append(what + b"\n")
            continue
        for n in range(what):
            said = Inspected("0", Kept.LAST, FrameResult("a.png", Verdict.PASS), sequence, None, n, 0.0, frames=what)
            lines.append(session.line(Recorded("a.png", n, 2.0, None, 3.0, 4.0, 5.0, said.as_dict())).encode())
    return b"".join(lines) + end


@settings(max_examples=40)
@given(LINES, st.sampled_from([b"", b'{"file": "b.p']), st.integers(0, 3000))
def test_stretches_of_any_size_say_what_the_whole_says(
    tmp_path_factory: pytest.TempPathFactory, shape: list[int | bytes], end: bytes, size: int
) -> None:
    folder = tmp_path_factory.mktemp("session")
    (folder / session.INDEX).write_bytes(index_of(shape, end))

    def panels(size: int) -> list[Any]:
        return [panel for stretch in stretches(folder, size) for panel in read(stretch)]

    whole = panels(1 << 40)
    assert panels(size) == whole
    assert [item for panel in whole for item in panel] == read_session(folder)
    assert [len(panel) for panel in whole] == [what if isinstance(what, int) else 1 for what in shape] + [1] * bool(end)
    spoilt = [item.line for panel in whole for item in panel if isinstance(item, Spoilt)]
    wrong = [n for n, line in enumerate(index_of(shape, end).split(b"\n"), 1) if n > 1 and line and not_a_frame(line)]
    blank = [n for n, line in enumerate(index_of(shape, b"").split(b"\n")[:-1], 1) if not line]
    assert spoilt == sorted(wrong + blank)


def not_a_frame(line: bytes) -> bool:
    try:
        return "result" not in json.loads(line)
    except ValueError:
        return True


@pytest.mark.parametrize("first", [b"", b'{"session": 99}\n', b"\xff\n"])
def test_a_session_of_another_kind_is_named(tmp_path: Path, first: bytes) -> None:
    (tmp_path / session.INDEX).write_bytes(first)
    with pytest.raises(SessionWrong, match=str(tmp_path)):
        read_session(tmp_path)


def test_settings_that_are_missing_or_unknown_are_named(tmp_path: Path) -> None:
    recording = recorded_sessions.Recording(tmp_path / "one")
    version = recorded_sessions.version(tmp_path)
    recording.panel(version, recorded_sessions.images(["A000.png"]))
    (frame,) = frames_of(tmp_path / "one")
    file = tmp_path / "one" / f"settings-{version.name}.json"
    assert frame.version() == version
    file.write_text("{}")
    with pytest.raises(VersionWrong, match=version.name):
        frame.version()
    file.unlink()
    with pytest.raises(VersionWrong, match=version.name):
        frame.version()


def test_sessions_are_found_below_a_folder_once_and_in_order(tmp_path: Path) -> None:
    for name in ("b", "a/2", "a/1"):
        (tmp_path / name).mkdir(parents=True)
        (tmp_path / name / session.INDEX).write_text(session.first_line({}))
    found = [tmp_path / name for name in ("a/1", "a/2", "b")]
    assert find([tmp_path, tmp_path / "b"]) == found
    assert find([tmp_path / "b", tmp_path]) == [found[2], *found[:2]]
