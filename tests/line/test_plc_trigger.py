"""A PLC that triggers, takes results and commands over the wire; devices are fakes."""

from __future__ import annotations

import contextlib
import json
import math
import subprocess
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from inspector.handshake_table import Action, Answer, Command, CommandResult, Control
from inspector.model import Snapshot, State, Verdict
from inspector.publish.plc_server import PlcServer, PlcServerError
from inspector.publish.registers import CONTROL_ADDRESS, Status
from inspector.service.control import PANEL_MARKS, PlcControl
from tests.line.conftest import Plc
from tests.line.test_daemon import Bench, bench, reload, shown

__all__ = ["bench", "shown"]

BUSY = 6
BY_PLC = {"trigger": {"kind": "plc"}, "retry_first_s": 0.05, "retry_longest_s": 0.2}


class Line:
    """A station that the PLC triggers, and the PLC."""

    def __init__(self, bench: Callable[..., Bench], wait_until: Callable[..., Any], **sections: Any) -> None:
        self.station = bench(**({"cycle": BY_PLC} | sections))
        self.plc = Plc(self.station.daemon.port)
        self._wait_until = wait_until

    def control(self, bits: int = 0, *words: int) -> None:
        assert self.plc.write(CONTROL_ADDRESS, bits, *words) == 0

    def until(self, condition: Callable[[dict[str, Any]], Any], what: str) -> dict[str, Any]:
        return dict(self.plc.until(self._wait_until, condition, what))

    def until_set(self, answer: Answer) -> dict[str, Any]:
        return self.until(lambda r: answer in Answer(r["handshake"]), str(answer.name))

    def until_off(self, answer: Answer) -> dict[str, Any]:
        return self.until(lambda r: answer not in Answer(r["handshake"]), f"no {answer.name}")

    def execute(self, command: int, argument: int = 0) -> int:
        """How the command ended."""
        self.control(Control.EXECUTE, 0, 0, 0, command, 0, argument >> 16, argument & 0xFFFF)
        ended = Answer.COMMAND_COMPLETED | Answer.COMMAND_FAILED
        told = self.until(lambda r: Answer(r["handshake"]) & ended, "end of the command")
        assert told["command_echo"] == command
        assert (Answer.COMMAND_COMPLETED in Answer(told["handshake"])) is (told["command_result"] == CommandResult.DONE)
        self.control()
        self.until(lambda r: not Answer(r["handshake"]) & ended, "command forgotten")
        return int(told["command_result"])


@pytest.fixture
def line(bench: Callable[..., Bench], wait_until: Callable[..., Any]) -> Any:
    """``line(**sections)``: a station with these settings and its PLC."""
    made: list[Line] = []

    def start(**sections: Any) -> Line:
        made.append(Line(bench, wait_until, **sections))
        return made[-1]

    yield start
    for each in made:
        each.plc.close()


def test_each_trigger_is_one_result_with_the_panels_id(line: Callable[..., Line]) -> None:
    at = line()
    for sequence, panel_id in ((1, 7), (2, 0x10002), (3, 9)):
        at.until_set(Answer.TRIGGER_READY)
        before_s = time.monotonic()
        at.control(Control.TRIGGER, 0, panel_id >> 16, panel_id & 0xFFFF)
        triggered_s = time.monotonic()
        taken = at.until_set(Answer.TRIGGER_ACK)
        assert Answer.TRIGGER_READY not in Answer(taken["handshake"])
        at.control()
        at.until(lambda r: r["state"] == State.SINGLE_EXECUTION, "inspecting")
        inspecting_s = time.monotonic()
        at.station.camera.permits.release()
        result = at.until(lambda r, n=sequence: r["sequence"] == n, "result")
        assert inspecting_s - triggered_s <= 1e-6 * result["response_us"] + 1e-6 <= time.monotonic() - before_s + 2e-6
        assert (result["verdict"], result["panel_id"]) == (Verdict.PASS, panel_id)
        assert Answer.RESULT_AVAILABLE in Answer(result["handshake"])
    assert at.until_set(Answer.TRIGGER_READY)["state"] == State.READY


def test_triggers_while_a_cycle_runs_are_missed_and_flagged(line: Callable[..., Line]) -> None:
    at = line()
    at.until_set(Answer.TRIGGER_READY)
    at.control(Control.TRIGGER)
    at.control()
    at.control(Control.TRIGGER)
    assert at.until_set(Answer.TRIGGER_MISSED)["missed_triggers"] == 1
    at.control()
    at.station.camera.permits.release()
    at.until_set(Answer.RESULT_AVAILABLE)
    at.control(Control.CLEAR_FAULT)
    at.until_off(Answer.TRIGGER_MISSED)
    assert at.station.camera.taken == 1


def test_another_kind_of_trigger_refuses_the_plcs(line: Callable[..., Line]) -> None:
    at = line(cycle={"trigger": {"kind": "by_hand"}})
    at.until(lambda r: r["state"] == State.READY, "ready")
    at.control(Control.TRIGGER)
    missed = at.until_set(Answer.TRIGGER_MISSED)
    assert (missed["missed_triggers"], missed["sequence"]) == (1, 0)


def test_results_are_held_until_they_are_acknowledged(line: Callable[..., Line]) -> None:
    at = line(cycle={}, plc={"port": 0, "buffer_results": True})
    at.station.says = {2: Verdict.FAIL}
    at.station.camera.permits.release(3)
    at.until(lambda r: r["results_waiting"] == 2, "three results")
    for sequence, verdict in ((1, Verdict.PASS), (2, Verdict.FAIL), (3, Verdict.PASS)):
        held = at.until_set(Answer.RESULT_AVAILABLE)
        assert (held["sequence"], held["verdict"], held["panels_passed"]) == (sequence, verdict, 2)
        at.control(Control.RESULTS_ACK, sequence)
        at.until_off(Answer.RESULT_AVAILABLE)
        at.control()


def test_offline_the_station_is_ready_and_inspects_nothing(line: Callable[..., Line]) -> None:
    at = line(cycle={})
    at.station.camera.permits.release()
    at.until(lambda r: r["sequence"] == 1, "a result")
    at.control(Control.OFFLINE)
    at.station.camera.permits.release()  # the cycle under way ends
    at.until(lambda r: r["state"] == State.READY, "ready")
    before = at.plc.read()["sequence"]
    at.control()
    at.station.camera.permits.release()
    after = at.until(lambda r: r["sequence"] == before + 1, "a result")
    assert after["state"] == State.CONTINUOUS_EXECUTION


def test_commands_are_carried_out_or_refused_with_a_code(line: Callable[..., Line]) -> None:
    at = line(plc={"port": 0, "buffer_results": True})
    at.until_set(Answer.TRIGGER_READY)
    assert at.execute(99) == CommandResult.UNKNOWN_COMMAND
    assert at.execute(Command.CHANGE_RECIPE, 1) == CommandResult.DONE
    assert at.execute(Command.RESET_STATISTICS) == CommandResult.DONE
    assert at.execute(Command.RESET_STATISTICS, 2) == CommandResult.REFUSED
    at.control(Control.TRIGGER)
    at.station.camera.permits.release()
    at.until_set(Answer.RESULT_AVAILABLE)
    at.control()
    assert at.execute(Command.DISCARD_RESULTS) == CommandResult.DONE
    assert at.until_off(Answer.RESULT_AVAILABLE)["overruns"] == 1


def test_a_recipe_is_changed_when_it_is_whole_and_the_old_one_stays_otherwise(line: Callable[..., Line]) -> None:
    recipes = [{"id": 1, "name": "one"}, {"id": 2, "name": "two", "lamp_percent": 50.0}, {"id": 3, "name": "three"}]
    at = line(recipe=1, recipes=recipes, recipe_choice_file="choice.json")
    before = at.until_set(Answer.TRIGGER_READY)
    assert at.execute(Command.CHANGE_RECIPE, 2) == CommandResult.DONE
    changed = at.until_set(Answer.TRIGGER_READY)
    assert (changed["recipe_id"], changed["lamp_set_mv"]) == (2, 2500)
    assert changed["recipe_hash"] != before["recipe_hash"]
    assert at.execute(Command.CHANGE_RECIPE, 9) == CommandResult.REFUSED
    at.station.refuses = True
    assert at.execute(Command.CHANGE_RECIPE, 3) == CommandResult.REFUSED
    assert at.plc.read()["recipe_id"] == 2
    choice = at.station.station.folder / "choice.json"
    assert json.loads(choice.read_text())["recipe_id"] == 2


def test_certificates_are_read_anew_with_the_settings_file_and_not_with_a_recipe(
    line: Callable[..., Line], monkeypatch: pytest.MonkeyPatch
) -> None:
    def expired(_: PlcServer) -> None:
        raise PlcServerError("the certificate has expired")

    at = line(recipe=1, recipes=[{"id": 1, "name": "one"}, {"id": 2, "name": "two"}])
    at.until_set(Answer.TRIGGER_READY)
    monkeypatch.setattr(PlcServer, "renew_certificates", expired)
    assert at.execute(Command.CHANGE_RECIPE, 2) == CommandResult.DONE
    at.until_set(Answer.TRIGGER_READY)
    reload(at.station)
    refused = at.until(lambda r: Status.SETTINGS_REFUSED in Status(int(r["status"])), "refused")
    assert refused["recipe_id"] == 2


def test_what_only_stands_behind_the_registers_is_changed_without_a_connection_lost(line: Callable[..., Line]) -> None:
    at = line()
    before = at.until_set(Answer.TRIGGER_READY)
    at.station.station.settings["plc"] = {"port": 0, "buffer_results": True, "sequence_file": "sequence.json"}
    reload(at.station)
    at.until(lambda r: r["configuration_hash"] != before["configuration_hash"], "new settings")
    at.control(Control.TRIGGER)
    at.until_set(Answer.BUFFERING)


def test_a_trigger_taken_before_new_settings_is_kept_or_counted_as_missed(line: Callable[..., Line]) -> None:
    at = line()
    at.until_set(Answer.TRIGGER_READY)
    at.control(Control.TRIGGER)
    at.station.signals.request_reload()
    at.station.camera.permits.release()
    at.until(lambda r: r["sequence"] == 1, "its result")


def test_what_means_nothing_is_refused_and_the_rest_cannot_be_written(line: Callable[..., Line]) -> None:
    at = line()
    assert at.plc.write(CONTROL_ADDRESS, 0x8000) == 3
    assert at.plc.write(CONTROL_ADDRESS + 15, 1) == 3
    assert at.plc.write(CONTROL_ADDRESS + 15, 0, 0) == 2
    assert at.plc.write(0, 1) == 2
    assert at.plc.write(1000, 1) == 2


def test_a_fault_that_only_a_frame_can_end_is_cleared(line: Callable[..., Line]) -> None:
    at = line()
    at.station.says = {1: ZeroDivisionError("a bug")}
    at.until_set(Answer.TRIGGER_READY)
    at.control(Control.TRIGGER)
    at.station.camera.permits.release()
    failed = at.until(lambda r: r["sequence"] == 1, "a result")
    assert (failed["state"], failed["verdict"]) == (State.ERROR, 0)
    at.control(Control.CLEAR_FAULT)
    ready = at.until(lambda r: r["fault_code"] == 0, "cleared")
    assert (ready["state"], ready["verdict"], ready["sequence"]) == (State.READY, 0, 1)


def test_new_settings_leave_the_handshake_where_it_stands(line: Callable[..., Line], shown: Callable[..., Any]) -> None:
    at = line(plc={"port": 0, "buffer_results": True})
    at.until_set(Answer.TRIGGER_READY)
    at.control(Control.TRIGGER)
    at.station.camera.permits.release()
    at.until_set(Answer.RESULT_AVAILABLE)
    port = at.station.daemon.port
    at.station.station.settings["plc"]["idle_timeout_s"] = 30.0
    reload(at.station)
    moved = shown(at.station, lambda r: at.station.daemon.port != port, "another server")
    assert (moved["sequence"], moved["verdict"]) == (1, Verdict.PASS)
    assert {Answer.RESULT_AVAILABLE, Answer.TRIGGER_ACK} <= set(Answer(moved["handshake"]))


def test_a_foreign_client_triggers_and_acknowledges(line: Callable[..., Line], peer: Callable[[str, str], str]) -> None:
    at, mbpoll = line(), peer("mbpoll", "mbpoll")

    def write(address: int, *words: int) -> None:
        place = ["-p", str(at.station.daemon.port), "-0", "-r", str(address), "-t", "4"]
        command = [mbpoll, "-m", "tcp", *place, "-1", "127.0.0.1", *map(str, words)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60)
        assert done.returncode == 0, done.stdout + done.stderr

    at.until_set(Answer.TRIGGER_READY)
    write(CONTROL_ADDRESS + 2, 1, 2)
    write(CONTROL_ADDRESS, Control.TRIGGER)
    at.until_set(Answer.TRIGGER_ACK)
    write(CONTROL_ADDRESS, 0)
    at.station.camera.permits.release()
    assert at.until_set(Answer.RESULT_AVAILABLE)["panel_id"] == 0x10002
    write(CONTROL_ADDRESS, Control.RESULTS_ACK, 1)
    at.until_off(Answer.RESULT_AVAILABLE)


@pytest.fixture
def control() -> Iterator[tuple[PlcControl, PlcServer]]:
    """A handshake and its server, with nobody who beats."""
    made = PlcControl(Snapshot(state=State.READY), lambda: None)
    server = PlcServer(port=0, stall_after_s=0.01, on_control=made.write)
    server.start()
    made.serve(server, "high_first", False)
    made.ready(True)
    yield made, server
    server.stop()


def test_a_stalled_station_takes_no_trigger(
    control: tuple[PlcControl, PlcServer], wait_until: Callable[..., Any]
) -> None:
    made, server = control
    wait_until(lambda: server.stalled, "a stall")
    with contextlib.closing(Plc(server.port)) as plc:
        told = Answer(plc.until(wait_until, lambda r: r["state"] == State.ERROR, "told")["handshake"])
        assert not told & (Answer.TRIGGER_READY | Answer.ONLINE)
        assert plc.write(CONTROL_ADDRESS, Control.TRIGGER) == 0
        assert plc.read()["missed_triggers"] == 1
    assert made.trigger_s == math.inf


def test_a_trigger_taken_that_can_have_no_cycle_is_counted() -> None:
    made = PlcControl(Snapshot(state=State.READY), lambda: None)
    made.ready(True)
    made.write(CONTROL_ADDRESS, [Control.TRIGGER, 0, 0, 5])
    assert (made.trigger_s < math.inf, made.panel_id) == (True, 5)
    server = PlcServer(port=0, stall_after_s=120.0, on_control=made.write)
    server.start()
    made.cycle_lost()
    made.serve(server, "high_first", False)
    with contextlib.closing(Plc(server.port)) as plc:
        read = plc.read()
    server.stop()
    assert (made.trigger_s, read["missed_triggers"]) == (math.inf, 1)
    assert Answer.TRIGGER_MISSED in Answer(read["handshake"])


def test_a_panel_mark_that_finds_no_room_is_refused_as_busy_and_its_panel_does_not_pass(
    control: tuple[PlcControl, PlcServer], caplog: pytest.LogCaptureFixture
) -> None:
    """Nobody takes the marks. What the PLC writes beside marks is taken; a mark refused is taken once there is room."""
    made, server = control
    with contextlib.closing(Plc(server.port)) as plc:
        for panel_id in range(1, PANEL_MARKS // 2 + 1):
            assert plc.write(CONTROL_ADDRESS, Control.PANEL_START, 0, 0, panel_id) == 0
            assert plc.write(CONTROL_ADDRESS, Control.PANEL_END) == 0
        assert plc.write(CONTROL_ADDRESS, 0) == 0
        for bits in (Control.PANEL_END, Control.PANEL_START, Control.PANEL_END | Control.CLEAR_FAULT):
            assert plc.write(CONTROL_ADDRESS, bits) == BUSY
            assert plc.read(CONTROL_ADDRESS, 1)["control"] == 0
        assert plc.write(CONTROL_ADDRESS, Control.CLEAR_FAULT) == 0
        assert made.take_clear()
        marks = made.take_panel_marks()
        assert plc.write(CONTROL_ADDRESS, Control.PANEL_END) == 0
    assert [mark.panel_id for mark in marks] == sorted(2 * [*range(1, PANEL_MARKS // 2 + 1)])
    assert [mark.mark_refused_after for mark in marks] == [False] * (PANEL_MARKS - 1) + [True]
    assert [mark.action for mark in made.take_panel_marks()] == [Action.END_PANEL]
    assert caplog.text.count("the PLC is answered busy") == 1
