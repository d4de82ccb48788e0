"""The service under every trigger but its own pace, which the other tests use; and what it does while it waits."""

from __future__ import annotations

import signal
from collections.abc import Callable
from typing import Any

import pytest

from firmware_bridge.errors import NoReply, NoTrigger
from firmware_bridge.simulators.module_server import ModuleServer
from inspector.faults import Fault
from inspector.model import State, Verdict
from inspector.publish.registers import Status
from tests.line.test_daemon import Bench, bench, shown

__all__ = ["bench", "shown"]

BY_HAND = {"trigger": {"kind": "by_hand"}, "retry_first_s": 0.05, "retry_longest_s": 0.2}
WATCHED = {"profile": "tm-da1p1r1", "link": {"kind": "simulated"}, "deadline_s": 0.1, "watchdog_s": 0.5}


def test_by_hand_each_call_is_one_result_and_the_station_is_ready_in_between(
    bench: Callable[..., Bench], shown: Callable[..., Any]
) -> None:
    at_work = bench(cycle=BY_HAND)
    at_work.camera.permits.release(2)
    waiting = shown(at_work, lambda r: r["state"] == State.READY, "ready")
    assert (waiting["sequence"], waiting["verdict"], waiting["fault_code"]) == (0, 0, 0)
    assert {Status.READY, Status.LAMP_OK, Status.CAMERA_OK} <= set(Status(int(waiting["status"])))
    for sequence in (1, 2):
        at_work.signals.request_trigger()
        shown(at_work, lambda r, n=sequence: r["sequence"] == n and r["verdict"] == Verdict.PASS, "a result")
    assert at_work.camera.taken == 2


def test_calls_during_a_cycle_are_missed(
    bench: Callable[..., Bench], shown: Callable[..., Any], wait_until: Any
) -> None:
    at_work = bench(cycle=BY_HAND)
    shown(at_work, lambda r: r["state"] == State.READY, "ready")
    at_work.signals.request_trigger()
    wait_until(lambda: at_work.camera.waiting, "the camera is waited for")
    for _ in range(3):
        at_work.signals.request_trigger()
    at_work.camera.permits.release()
    missed = shown(at_work, lambda r: r["missed_triggers"], "missed triggers")
    assert (missed["missed_triggers"], missed["sequence"]) == (3, 1)


def test_a_module_with_a_watchdog_is_spoken_to_while_the_line_stands(
    bench: Callable[..., Bench], wait_until: Callable[..., Any]
) -> None:
    at_work = bench(cycle=BY_HAND, module=WATCHED, camera={"kind": "replay", "paths": ["frames"], "deadline_s": 0.1})
    wait_until(lambda: at_work.lamp.kept >= 3, "keep-alive again and again")
    assert at_work.lamp.volts == pytest.approx(4.0)


def test_a_lamp_that_fails_while_the_line_stands_takes_the_last_verdict_back(
    bench: Callable[..., Bench], shown: Callable[..., Any]
) -> None:
    at_work = bench(cycle=BY_HAND, module=WATCHED, camera={"kind": "replay", "paths": ["frames"], "deadline_s": 0.1})
    at_work.camera.permits.release(2)
    shown(at_work, lambda r: r["state"] == State.READY, "ready")  # an earlier call is not for this station
    at_work.signals.request_trigger()
    shown(at_work, lambda r: r["verdict"] == Verdict.PASS, "a pass")
    at_work.lamp.fails = NoReply("module", "silent")
    failed = shown(at_work, lambda r: r["fault_code"] == Fault.MODULE_SILENT, "a fault")
    assert (failed["verdict"], failed["sequence"], failed["state"]) == (0, 1, State.ERROR)
    at_work.lamp.fails = None
    healed = shown(at_work, lambda r: r["state"] == State.READY, "ready again")
    assert (healed["verdict"], healed["sequence"], healed["fault_code"]) == (0, 1, 0)
    at_work.signals.request_trigger()
    shown(at_work, lambda r: r["sequence"] == 2 and r["verdict"] == Verdict.PASS, "a pass again")


def test_a_camera_that_waits_for_its_line_is_no_fault_and_frames_between_were_missed(
    bench: Callable[..., Bench], shown: Callable[..., Any]
) -> None:
    at_work = bench(cycle={"trigger": {"kind": "hardware_line"}})
    still = NoTrigger("camera", "no signal")
    at_work.camera.script = [still, 1, still, 4, *[still] * 100]
    at_work.camera.permits.release(50)
    seen = shown(at_work, lambda r: r["sequence"] == 2, "two results")
    assert (seen["verdict"], seen["panels_not_inspected"]) == (Verdict.PASS, 0)
    assert shown(at_work, lambda r: r["missed_triggers"], "frames nobody took")["missed_triggers"] == 2


def test_an_input_of_the_module_begins_each_cycle(
    station: Any, module: Callable[[], ModuleServer], service: Callable[..., Any], wait_until: Callable[..., Any]
) -> None:
    server = module()
    point = server.module.profile.digital_inputs.first
    station.settings["cycle"]["trigger"] = {"kind": "digital_input", "channel": 0, "debounce_s": 0.0}
    station.settings["camera"]["rate_hz"] = 0
    station.write()
    running = service()
    running.until(lambda r: r["state"] == State.READY, "ready")
    for sequence in (1, 2, 3):
        server.module.set_value(point, 1)
        running.until(lambda r, n=sequence: r["sequence"] == n and r["verdict"], "a verdict")
        server.module.set_value(point, 0)
        looks = server._answers
        wait_until(lambda so_far=looks: server._answers > so_far + 3, "looks at the input that is off again")
    ended = running.plc().read()
    assert (ended["sequence"], ended["missed_triggers"]) == (3, 0)


def test_sigusr1_is_a_call_by_hand(
    station: Any, module: Callable[[], ModuleServer], service: Callable[..., Any]
) -> None:
    module()
    station.settings["cycle"]["trigger"] = {"kind": "by_hand"}
    station.settings["camera"]["rate_hz"] = 0
    station.write()
    running = service()
    running.until(lambda r: r["state"] == State.READY, "ready")
    running.send(signal.SIGUSR1)
    shown = running.until(lambda r: r["verdict"], "a verdict")
    assert shown["sequence"] == 1
    running.send(signal.SIGTERM)
    assert running.ended() == 0
