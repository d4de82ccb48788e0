"""Results in a session's lines: they come back to the last bit, whatever they say, and what is wrong is named."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_bridge.wire import session
from firmware_bridge.wire.session import Recorded, SessionWrong
from inspector.archive import result_json
from inspector.archive.session_frames import Inspected, Kept, inspected
from inspector.model import Defect, Extent, Flag, FrameResult, PanelResult, PanelSpot, Reason, Unpaired, Verdict

NUMBERS = st.floats(-1e9, 1e9)
ANY = st.floats()
PIXELS = st.tuples(NUMBERS, NUMBERS)
FLAGS = st.integers(0, 2**16 - 1).map(Flag)
VERDICT = {
    "verdict": st.sampled_from(Verdict),
    "reasons": st.integers(0, 2**16 - 1).map(Reason),
    "reasons_text": st.lists(st.text(max_size=10), max_size=2).map(tuple),
}
DEFECTS = st.lists(
    st.builds(Defect, ANY, NUMBERS, ANY, st.none() | ANY, PIXELS, PIXELS, FLAGS, *[st.none() | ANY] * 3), max_size=3
).map(tuple)
FRAMES = st.builds(
    FrameResult,
    frame=st.just("a.png"),
    **VERDICT,
    defects=DEFECTS,
    unpaired=st.lists(st.builds(Unpaired, ANY, NUMBERS, FLAGS), max_size=2).map(tuple),
    elapsed_us=st.just(0.0),
)
PANELS = st.builds(
    PanelResult,
    **VERDICT,
    defects=DEFECTS,
    unpaired=st.lists(st.builds(PanelSpot, NUMBERS, NUMBERS, FLAGS, ANY, ANY), max_size=2).map(tuple),
    panel_id=st.none() | st.integers(0, 2**32 - 1),
    travels_mm=st.lists(NUMBERS, max_size=2).map(tuple),
    extent=st.builds(Extent, NUMBERS, st.tuples(*[NUMBERS] * 4), NUMBERS),
)


def line_of(said: Inspected) -> str:
    return session.line(Recorded("a.png", 1, 2.0, None, 3.0, 4.0, 5.0, said.as_dict()))


@given(FRAMES, st.none() | PANELS, st.sampled_from(Kept), st.none() | st.integers(0))
def test_results_come_back_to_the_last_bit(
    result: FrameResult, panel: PanelResult | None, kept: Kept, sequence: int | None
) -> None:
    said = Inspected("0123abcd", kept, result, sequence, 7, 1, 12.5, panel, ("a frame",) if panel else (), 2)
    (read,) = session.parse(session.first_line({}) + line_of(said))
    found = inspected(read)
    assert found is not None
    assert result_json.same(found.result, result)
    assert (found.panel is None) == (panel is None)
    assert panel is None or result_json.same(found.panel, panel)
    assert repr(found) == repr(said)


@given(FRAMES, st.floats(1.0, 1e5))
def test_the_last_bit_of_a_height_makes_another_result(result: FrameResult, height_um: float) -> None:
    def of_height(height_um: float) -> FrameResult:
        return replace(result, defects=(Defect(1.0, 2.0, height_um, None, (3.0, 4.0), (5.0, 6.0)),))

    assert result_json.same(of_height(height_um), of_height(height_um))
    assert not result_json.same(of_height(height_um), of_height(math.nextafter(height_um, math.inf)))


@pytest.mark.parametrize("spoil", ["result", "settings", "kept", "frames"])
def test_a_line_that_was_spoilt_is_named(spoil: str) -> None:
    said = json.loads(line_of(Inspected("0", Kept.LAST, FrameResult("a.png", Verdict.PASS))))
    said[spoil] = "nonsense" if spoil in ("result", "kept") else None
    if spoil in ("settings", "frames"):
        del said[spoil]
    (read,) = session.parse(session.first_line({}) + json.dumps(said) + "\n")
    with pytest.raises(SessionWrong, match=r"a\.png"):
        inspected(read)


def test_a_line_without_a_result_is_none() -> None:
    assert inspected(Recorded("a.png", 1, 2.0, None, 3.0, 4.0, 5.0)) is None
