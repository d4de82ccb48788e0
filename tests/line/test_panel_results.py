"""Panels of several frames in the service: one result for each, over the wire; devices and inspection are fakes."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import pytest

from firmware_bridge.errors import BridgeError, NoReply
from inspector.faults import Fault
from inspector.handshake_table import Answer, Command, CommandResult, Control
from inspector.model import Defect, FrameResult, Reason, State, Verdict
from inspector.publish.systemd import Notifier
from tests.line.test_daemon import Bench, bench, shown
from tests.line.test_plc_trigger import BY_PLC, Line, line

__all__ = ["bench", "line", "shown"]

TRAVEL = {"by": {"kind": "pitch", "mm_per_frame": 40.0}}
BY_COUNT = {"frames": {"kind": "count", "count": 3}, "travel": TRAVEL}
BY_MARKS = {"frames": {"kind": "plc"}, "travel": TRAVEL}
RECIPE = {"limits": {"max_height_um": 2000}}


def seed(x_mm: float, height_um: float = 1000.0) -> Defect:
    return Defect(x_mm, 0.0, height_um, 5.0, (0.0, 0.0), (1.0, 1.0), place_sigma_mm=0.02)


def saw(*defects: Defect) -> FrameResult:
    return FrameResult("f", Verdict.PASS, defects=defects)


def test_three_frames_are_one_result_and_a_seed_of_two_counts_once(
    bench: Callable[..., Bench], shown: Callable[..., Any], capsys: pytest.CaptureFixture[str]
) -> None:
    at_work = bench(panel=BY_COUNT, recipe=RECIPE)
    at_work.says = {1: saw(seed(-20)), 2: saw(seed(20), seed(0, 800)), 3: saw(seed(40.1, 800))}
    at_work.camera.permits.release(2)
    within = shown(at_work, lambda r: r["panel_frames_so_far"] == 2, "two frames")
    assert (within["sequence"], within["verdict"], within["acquisition_id"]) == (0, 0, 2)
    at_work.camera.permits.release()
    done = shown(at_work, lambda r: r["sequence"] == 1, "a result")
    assert (done["verdict"], done["defect_count"], done["panel_frames"]) == (Verdict.PASS, 2, 3)
    assert (done["defect_1_x_mm"], done["defect_1_height_um"]) == (-20.0, 1000)
    assert done["defect_2_x_mm"] == -40.0
    assert done["panel_area_cm2"] > 0
    at_work.camera.permits.release(3)
    assert shown(at_work, lambda r: r["sequence"] == 2, "the next one")["panel_id"] == 2
    lines = [text for text in capsys.readouterr().out.splitlines() if text.startswith("#")]
    assert len(lines) == 2
    assert "panel 1, 3 frames" in lines[0]


def test_a_panel_with_a_frame_missing_is_no_pass_and_the_next_one_is_whole(
    bench: Callable[..., Bench], shown: Callable[..., Any]
) -> None:
    at_work = bench(panel=BY_COUNT, recipe=RECIPE)
    at_work.camera.script = [1, NoReply("camera", "no frame"), 2, 3, 4, 5]
    at_work.camera.permits.release(2)
    failed = shown(at_work, lambda r: r["fault_code"], "a fault")
    assert (failed["sequence"], failed["fault_code"]) == (0, Fault.CAMERA_TIMEOUT)
    at_work.camera.permits.release()
    done = shown(at_work, lambda r: r["sequence"] == 1, "a result")
    assert (done["verdict"], done["panel_frames"], done["fault_code"]) == (Verdict.NOT_INSPECTED, 2, 0)
    assert Reason.PANEL_INCOMPLETE in Reason(int(done["reasons"]))
    at_work.camera.permits.release(3)
    whole = shown(at_work, lambda r: r["sequence"] == 2, "the next one")
    assert (whole["verdict"], whole["panel_frames"]) == (Verdict.PASS, 3)


def test_a_frame_that_cannot_be_judged_takes_back_the_last_verdict_and_keeps_its_panel_from_passing(
    bench: Callable[..., Bench], shown: Callable[..., Any]
) -> None:
    at_work = bench(panel=BY_COUNT, recipe=RECIPE)
    black = FrameResult("f", Verdict.NOT_INSPECTED, Reason.FRAME_BLACK, ("the frame is black",))
    at_work.says = {4: black, 5: saw(seed(0, 5000.0))}
    at_work.camera.permits.release(3)
    assert shown(at_work, lambda r: r["sequence"] == 1, "a result")["verdict"] == Verdict.PASS
    at_work.camera.permits.release()
    taken_back = shown(at_work, lambda r: r["fault_code"], "a fault")
    assert (taken_back["verdict"], taken_back["fault_code"], taken_back["sequence"]) == (0, Fault.FRAME_BLACK, 1)
    at_work.camera.permits.release(2)
    done = shown(at_work, lambda r: r["sequence"] == 2, "the next one")
    # What was measured fails it, whatever the black frame would have shown.
    assert done["verdict"] == Verdict.FAIL
    reasons = Reason(int(done["reasons"]))
    assert reasons == Reason.PANEL_INCOMPLETE | Reason.FRAME_BLACK | Reason.HEIGHT_LIMIT


def test_an_error_in_judging_is_no_pass_and_inspection_goes_on(
    bench: Callable[..., Bench], shown: Callable[..., Any]
) -> None:
    at_work = bench(panel=BY_COUNT, recipe=RECIPE)
    at_work.says = {1: replace(saw(), defects=("no defect",))}
    at_work.camera.permits.release(3)
    done = shown(at_work, lambda r: r["sequence"] == 1, "a result")
    assert done["verdict"] == Verdict.NOT_INSPECTED
    assert Reason.DEVICE_FAULT in Reason(int(done["reasons"]))
    at_work.camera.permits.release(3)
    assert shown(at_work, lambda r: r["sequence"] == 2, "the next one")["verdict"] == Verdict.PASS


def test_a_panel_whose_frames_stop_coming_is_ended(bench: Callable[..., Bench], shown: Callable[..., Any]) -> None:
    by_hand = {"trigger": {"kind": "by_hand"}}
    at_work = bench(panel=BY_COUNT | {"timeout_s": 0.2}, recipe=RECIPE, cycle=by_hand)
    at_work.camera.permits.release()
    shown(at_work, lambda r: r["state"] == 2, "ready")
    at_work.signals.request_trigger()
    done = shown(at_work, lambda r: r["sequence"] == 1, "a result")
    assert (done["verdict"], done["panel_frames"]) == (Verdict.NOT_INSPECTED, 1)


def inspect_one(at: Line, frames: int) -> None:
    """The PLC triggers so many frames, one by one."""
    for _ in range(frames):
        at.until_set(Answer.TRIGGER_READY)
        at.control(Control.TRIGGER)
        at.until_set(Answer.TRIGGER_ACK)
        at.station.camera.permits.release()
        at.control()
        at.until_set(Answer.TRIGGER_READY)


def test_the_plc_begins_and_ends_a_panel_and_its_id_comes_back(line: Callable[..., Line]) -> None:
    at = line(panel=BY_MARKS, cycle=BY_PLC, recipe=RECIPE)
    at.station.says = {2: saw(seed(-20)), 3: saw(seed(20))}
    inspect_one(at, 1)  # of no panel
    at.control(Control.PANEL_START, 0, 1, 7)
    at.control(0, 0, 1, 7)
    inspect_one(at, 2)
    at.control(Control.PANEL_END)
    done = at.until(lambda r: r["sequence"] == 1, "a result")
    assert (done["panel_id"], done["panel_frames"], done["defect_count"]) == (0x10007, 2, 1)
    assert done["verdict"] == Verdict.PASS


def test_an_end_without_a_start_is_a_result_without_a_verdict(line: Callable[..., Line]) -> None:
    at = line(panel=BY_MARKS, cycle=BY_PLC, recipe=RECIPE)
    inspect_one(at, 1)
    at.control(Control.PANEL_END)
    done = at.until(lambda r: r["sequence"] == 1, "a result")
    assert (done["verdict"], done["panel_frames"]) == (Verdict.NOT_INSPECTED, 0)
    assert Reason.PANEL_INCOMPLETE in Reason(int(done["reasons"]))


def test_a_trigger_that_was_missed_within_a_panel_keeps_it_from_passing(line: Callable[..., Line]) -> None:
    at = line(panel=BY_MARKS, cycle=BY_PLC, recipe=RECIPE)
    at.until_set(Answer.TRIGGER_READY)
    at.control(Control.PANEL_START)
    at.control(Control.TRIGGER)
    at.control()
    at.control(Control.TRIGGER)
    at.until_set(Answer.TRIGGER_MISSED)
    at.control()
    at.station.camera.permits.release()
    inspect_one(at, 1)
    at.control(Control.PANEL_END)
    done = at.until(lambda r: r["sequence"] == 1, "a result")
    assert (done["verdict"], done["panel_frames"]) == (Verdict.NOT_INSPECTED, 2)


def triggered_again(at: Line, meanwhile: contextlib.AbstractContextManager[None] | None = None) -> None:
    """The PLC triggers, and once more while the frame is still to come; then it comes."""
    at.until_set(Answer.TRIGGER_READY)
    missed = at.plc.read()["missed_triggers"]
    with meanwhile or contextlib.nullcontext():
        at.control(Control.TRIGGER)
        at.until_set(Answer.TRIGGER_ACK)
        at.control()
        at.control(Control.TRIGGER)
        at.until(lambda r: r["missed_triggers"] == missed + 1, "a missed trigger")
        at.control()
    at.station.camera.permits.release()
    at.until_set(Answer.TRIGGER_READY)


def test_a_frame_is_of_the_panel_that_the_plc_had_begun_when_it_was_taken(
    line: Callable[..., Line], wait_until: Callable[..., Any]
) -> None:
    """The marks come while the camera is waited for, as at a line of its own: no panel has the frame of another."""
    at = line(panel=BY_MARKS, recipe=RECIPE, cycle=BY_PLC | {"trigger": {"kind": "free_running"}})
    camera = at.station.camera
    for number, panel_id, bits in ((1, 7, Control.PANEL_START), (2, 8, Control.PANEL_END | Control.PANEL_START)):
        wait_until(lambda: camera.waiting, "a camera that is waited for")
        at.control()
        at.control(bits, 0, 0, panel_id)
        camera.permits.release()
        at.until(lambda r, n=number: r["acquisition_id"] == n, "the panel's frame")
    wait_until(lambda: camera.waiting, "a camera that is waited for")
    first = at.until(lambda r: r["sequence"] == 1, "the first panel")
    assert (first["panel_id"], first["panel_frames"], first["verdict"]) == (7, 1, Verdict.PASS)
    at.control()
    at.control(Control.PANEL_END)
    camera.permits.release()
    second = at.until(lambda r: r["sequence"] == 2, "the second panel")
    assert (second["panel_id"], second["panel_frames"], second["verdict"]) == (8, 1, Verdict.PASS)


class Inputs:
    """The module's digital inputs, of which the first triggers; ``asked``: how often they were read."""

    def __init__(self) -> None:
        self.on, self.asked = False, 0
        self.fails: BridgeError | None = None

    def read_inputs(self) -> tuple[bool, ...]:
        self.asked += 1
        if self.fails:
            raise self.fails
        return (self.on, False)


@pytest.fixture
def by_input(bench: Callable[..., Bench], line: Callable[..., Line], monkeypatch: pytest.MonkeyPatch) -> Any:
    """A station that an input triggers, within a panel of the PLC's with one frame; and its inputs."""
    inputs = Inputs()
    made = Bench._build
    monkeypatch.setattr(Bench, "_build", lambda *a, **k: replace(made(*a, **k), digital=inputs))
    trigger = {"kind": "digital_input", "channel": 0, "debounce_s": 0.0, "poll_s": 0.005}
    at = line(panel=BY_MARKS, recipe=RECIPE, cycle=BY_PLC | {"trigger": trigger})
    at.until(lambda r: r["state"] == State.READY, "ready")
    at.control(Control.PANEL_START)
    return at, inputs


def triggered(at: Line, inputs: Inputs, wait_until: Callable[..., Any]) -> int:
    """The input comes on, and goes off while the camera is waited for; how often it had been read until then."""
    seen = inputs.asked
    wait_until(lambda: inputs.asked > seen + 3, "looks at the input that is off")
    inputs.on = True
    wait_until(lambda: at.station.camera.waiting, "a cycle")
    inputs.on = False
    return inputs.asked


def test_a_trigger_missed_after_the_last_frame_is_told_before_the_panel_ends(
    by_input: tuple[Line, Inputs], wait_until: Callable[..., Any]
) -> None:
    (at, inputs), inspected = by_input, threading.Event()
    at.station.says = {1: inspected}
    seen = triggered(at, inputs, wait_until)
    at.station.camera.permits.release()
    wait_until(lambda: inputs.asked > seen, "the look in mid-cycle")
    inputs.on = True  # the last one of the panel: nobody sees it
    at.control(Control.PANEL_END)
    inspected.set()
    done = at.until(lambda r: r["sequence"] == 1, "a result")
    assert (done["panel_frames"], done["missed_triggers"]) == (1, 1)
    assert done["verdict"] == Verdict.NOT_INSPECTED


@pytest.mark.parametrize("in_the_cycle", [True, False])
def test_a_panel_whose_triggers_could_not_be_read_does_not_pass(
    by_input: tuple[Line, Inputs], in_the_cycle: bool, wait_until: Callable[..., Any]
) -> None:
    at, inputs = by_input
    seen = triggered(at, inputs, wait_until)
    if in_the_cycle:
        inputs.fails = NoReply("module", "silent")
    at.station.camera.permits.release()
    if not in_the_cycle:
        at.until(lambda r: r["panel_frames_so_far"] == 1, "a frame")
        seen, inputs.fails = inputs.asked, NoReply("module", "silent")
    wait_until(lambda: inputs.asked > seen, "a look that fails")
    inputs.fails = None
    at.until(lambda r: r["panel_frames_so_far"] == 1 and r["state"] == State.READY, "ready again")
    at.control(Control.PANEL_END)
    done = at.until(lambda r: r["sequence"] == 1, "a result")
    assert (done["verdict"], done["panel_frames"]) == (Verdict.NOT_INSPECTED, 1)


def test_the_last_trigger_of_a_panel_missed_is_that_panels_and_not_the_next_ones(line: Callable[..., Line]) -> None:
    at = line(panel=BY_MARKS, cycle=BY_PLC, recipe=RECIPE)
    at.until_set(Answer.TRIGGER_READY)
    at.control(Control.PANEL_START)
    inspect_one(at, 2)
    at.control(Control.OFFLINE)
    at.control(Control.OFFLINE | Control.TRIGGER)
    at.until_set(Answer.TRIGGER_MISSED)
    at.control(Control.PANEL_END)
    done = at.until(lambda r: r["sequence"] == 1, "a result")
    assert (done["verdict"], done["panel_frames"]) == (Verdict.NOT_INSPECTED, 2)
    at.control(Control.PANEL_START)
    inspect_one(at, 2)
    at.control(Control.PANEL_END)
    done = at.until(lambda r: r["sequence"] == 2, "the next one")
    assert (done["verdict"], done["panel_frames"]) == (Verdict.PASS, 2)


@pytest.fixture
def late_cycle(monkeypatch: pytest.MonkeyPatch) -> Callable[[], contextlib.AbstractContextManager[None]]:
    """``late_cycle()``: meanwhile the cycle's thread does not get on, as on a machine that gives it no turn."""
    held, goes_on, feed = threading.Event(), threading.Event(), Notifier.feed_watchdog
    goes_on.set()

    def fed(notifier: Notifier, now_s: float) -> None:
        if not goes_on.is_set():
            held.set()
            goes_on.wait(20)
        feed(notifier, now_s)

    monkeypatch.setattr(Notifier, "feed_watchdog", fed)

    @contextlib.contextmanager
    def hold() -> Iterator[None]:
        goes_on.clear()
        assert held.wait(20)
        try:
            yield
        finally:
            goes_on.set()

    return hold


@pytest.mark.parametrize("late", [False, True], ids=["at once", "late"])
def test_a_trigger_missed_while_a_panels_last_frame_is_taken_is_the_next_panels_first(
    late: bool, line: Callable[..., Line], late_cycle: Any
) -> None:
    at = line(panel=BY_COUNT, cycle=BY_PLC, recipe=RECIPE)
    inspect_one(at, 2)
    triggered_again(at, late_cycle() if late else None)
    first = at.until(lambda r: r["sequence"] == 1, "a result")
    assert (first["verdict"], first["panel_frames"]) == (Verdict.PASS, 3)
    inspect_one(at, 2)
    second = at.until(lambda r: r["sequence"] == 2, "the next one")
    assert (second["verdict"], second["panel_frames"]) == (Verdict.NOT_INSPECTED, 2)
    inspect_one(at, 3)
    third = at.until(lambda r: r["sequence"] == 3, "the third one")
    assert (third["verdict"], third["panel_frames"]) == (Verdict.PASS, 3)


RECIPES = [
    {"id": 1, "name": "black", "lamp_percent": 80.0, "exposure_us": 1000.0},
    {"id": 2, "name": "white", "lamp_percent": 60.0, "exposure_us": 400.0},
    {"id": 3, "name": "dark", "exposure_us": 2e6},
]


def test_a_changed_recipe_ends_the_panel_and_no_frame_counts_before_the_lamp_has_settled(
    line: Callable[..., Line],
) -> None:
    sections = {"recipes": RECIPES, "recipe": 1, "lamp": {"settle_s": 0.5}, "cycle": {}}
    at = line(panel=BY_COUNT, **sections)
    at.station.camera.permits.release(1)
    at.until(lambda r: r["panel_frames_so_far"] == 1, "a frame")
    at.control(Control.EXECUTE, 0, 0, 0, Command.CHANGE_RECIPE, 0, 0, 2)
    at.station.camera.permits.release(1)  # the one that was waited for
    ended = at.until(lambda r: r["command_result"] == CommandResult.DONE, "end of the command")
    assert (ended["recipe_id"], ended["sequence"], ended["verdict"]) == (2, 1, Verdict.NOT_INSPECTED)
    frames = at.station.camera.taken
    at.station.camera.permits.release(1)
    unsettled = at.until(lambda r: r["fault_code"], "a fault")
    assert unsettled["fault_code"] == Fault.LAMP_WARMING_UP
    assert (at.station.camera.exposure_us, round(at.station.lamp.volts, 3)) == (400.0, 3.0)
    at.station.camera.permits.release(1000)
    whole = at.until(lambda r: r["verdict"] == Verdict.PASS, "a panel")
    assert whole["acquisition_id"] > frames + 3
    assert whole["exposure_us"] == 400


def test_a_recipe_that_the_camera_cannot_expose_is_refused_and_the_old_one_stays(line: Callable[..., Line]) -> None:
    at = line(recipes=RECIPES, recipe=1)
    at.until_set(Answer.TRIGGER_READY)
    assert at.execute(Command.CHANGE_RECIPE, 3) == CommandResult.REFUSED
    stays = at.until(lambda r: r["recipe_id"], "a recipe")
    assert stays["recipe_id"] == 1
    assert at.execute(Command.CHANGE_RECIPE, 2) == CommandResult.DONE
