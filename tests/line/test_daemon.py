"""The cycle itself, in this process: devices and inspection are fakes, the settings, registers and clock are not."""

from __future__ import annotations

import contextlib
import logging
import re
import socket
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from firmware_bridge.contracts import CameraCapabilities, CameraFrame
from firmware_bridge.errors import BridgeError, NoReply
from firmware_bridge.factory import Devices
from inspector.calibration_file import CalibrationError
from inspector.faults import Fault
from inspector.model import Frame, FrameResult, Reason, State, Verdict
from inspector.publish.registers import Status
from inspector.publish.systemd import Notifier
from inspector.service.daemon import Daemon, Limits
from inspector.service.front import Front
from inspector.settings import Settings, load
from inspector.signals import Signals, StopRequested
from tests.line.conftest import Plc


class FakeLamp:
    """A lamp that obeys unless it ``fails``, and counts how often it is opened, closed and spoken to in between."""

    simulated = False

    def __init__(self) -> None:
        self.volts, self.opened, self.closed, self.kept = 0.0, 0, 0, 0
        self.fails: BridgeError | None = None

    def open(self) -> None:
        self.opened += 1

    def close(self) -> None:
        self.volts = 0.0
        self.closed += 1

    def set_volts(self, volts: float) -> float:
        self._fail()
        self.volts = volts
        return volts

    def read_volts(self) -> float:
        return self.volts

    def keep_alive(self) -> None:
        self._fail()
        self.kept += 1

    def burnt_hours(self) -> float:
        return 0.0

    def _fail(self) -> None:
        if self.fails:
            raise self.fails


class FakeCamera:
    """A camera that gives a frame for each permit; ``grab`` waits for one. ``script``: frame ids and errors to give."""

    simulated = True

    def __init__(self) -> None:
        self.permits = threading.Semaphore(0)
        self.opened, self.taken, self.exposure_us, self.waiting = 0, 0, 0.0, False
        self.script: list[int | BridgeError] = []

    def open(self) -> None:
        self.opened += 1

    def close(self) -> None: ...

    def capabilities(self) -> CameraCapabilities:
        return CameraCapabilities(1, 1e6, 1, 3, 2)

    def set_exposure_us(self, exposure_us: float) -> float:
        self.exposure_us = exposure_us
        return exposure_us

    def grab(self) -> CameraFrame:
        self.waiting = True
        if not self.permits.acquire(timeout=20):
            raise NoReply("camera", "no permit in 20 s")
        self.waiting = False
        step = self.script.pop(0) if self.script else self.taken + 1
        if isinstance(step, BridgeError):
            raise step
        self.taken = step
        return CameraFrame(
            np.zeros((2, 3), np.uint8), self.taken, f"frame {self.taken}", self.exposure_us, 0.0, time.monotonic()
        )


def front_of(station: Any, signals: Signals) -> Front:
    """The station's registers, served."""
    front = Front(load(station.file), signals, Notifier({}))
    front.start()
    return front


class Bench:
    """A daemon in a thread, its fakes, and the verdicts it is to find: ``verdicts[frame id]``, else PASS."""

    def __init__(self, station: Any) -> None:
        self.station, self.signals = station, Signals()
        self.lamp, self.camera = FakeLamp(), FakeCamera()
        self.built: list[Devices] = []
        self.says: dict[int, Any] = {}
        self.refuses = False
        self.daemon = Daemon(
            station.file, front_of(station, self.signals), self.signals, inspection=self._inspection, build=self._build
        )
        self._thread = threading.Thread(target=self.daemon.run, args=(Limits(),), daemon=True)
        self._thread.start()

    def _build(self, *_: Any, **__: Any) -> Devices:
        self.built.append(Devices(self.camera, self.lamp) if not self.built else Devices(FakeCamera(), FakeLamp()))
        return self.built[-1]

    def _inspection(self, settings: Settings) -> Callable[[Frame], FrameResult]:
        if self.refuses:
            raise CalibrationError("the calibration is gone")

        def inspect(frame: Frame) -> FrameResult:
            said = self.says.get(frame.frame_id, Verdict.PASS)
            if isinstance(said, Exception):
                raise said
            if isinstance(said, threading.Event):
                said.wait(60)
                said = Verdict.PASS
            return said if isinstance(said, FrameResult) else FrameResult(frame.name, said)

        return inspect

    def stop(self) -> None:
        self.signals.request_stop()
        for camera in (self.camera, *(devices.camera for devices in self.built)):  # a reload may have built another
            if isinstance(camera, FakeCamera):
                camera.permits.release(1000)
        self._thread.join(30)
        assert not self._thread.is_alive()


@pytest.fixture
def bench(station: Any) -> Iterator[Callable[..., Bench]]:
    """``bench(**sections)``: a daemon at work with these sections of the settings changed."""
    with contextlib.ExitStack() as stack:

        def start(**sections: Any) -> Bench:
            station.settings |= sections
            station.write()
            made = Bench(station)
            stack.callback(made.stop)
            return made

        yield start


@pytest.fixture
def shown(wait_until: Callable[..., Any]) -> Callable[..., Any]:
    """``shown(bench, condition, what)``: the first registers that the condition holds for, on whatever port."""

    def wait(bench: Bench, condition: Callable[[dict[str, Any]], Any], what: str) -> dict[str, Any]:
        def met() -> dict[str, Any] | None:
            try:
                with contextlib.closing(Plc(bench.daemon.port)) as plc:
                    registers = plc.read()
            except OSError:
                return None  # between one server and the next
            return registers if condition(registers) else None

        return dict(wait_until(met, what))

    return wait


def test_before_the_first_frame_there_is_no_verdict(bench: Callable[..., Bench], shown: Callable[..., Any]) -> None:
    registers = shown(bench(), lambda r: r["recipe_id"], "settings")
    assert (registers["state"], registers["verdict"], registers["sequence"]) == (State.INITIALIZED, 0, 0)


def test_an_error_in_the_program_is_a_fault_and_the_next_panel_is_inspected(
    bench: Callable[..., Bench], shown: Callable[..., Any], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    at_work = bench()
    at_work.says = {2: ZeroDivisionError("a bug"), 3: ZeroDivisionError("a bug")}
    at_work.camera.permits.release(3)
    failed = shown(at_work, lambda r: r["sequence"] == 3, "third result")
    assert (failed["fault_code"], failed["verdict"], failed["state"]) == (Fault.INTERNAL, 0, State.ERROR)
    assert Reason.DEVICE_FAULT in Reason(int(failed["reasons"]))
    at_work.camera.permits.release()
    healed = shown(at_work, lambda r: r["sequence"] == 4, "fourth result")
    assert (healed["fault_code"], healed["verdict"], healed["panels_not_inspected"]) == (0, Verdict.PASS, 2)
    (told,) = (r for r in caplog.records if r.exc_info)
    assert "inspection fails: ZeroDivisionError: a bug" in told.getMessage()
    assert any(r.getMessage().startswith("inspection works again") for r in caplog.records)


def test_frames_that_cannot_be_judged_have_a_code_and_are_said_once(
    bench: Callable[..., Bench], shown: Callable[..., Any], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    at_work = bench()
    black = FrameResult("x", Verdict.NOT_INSPECTED, Reason.FRAME_BLACK, ("the frame is black",))
    at_work.says = {1: black, 2: black}
    at_work.camera.permits.release(2)
    registers = shown(at_work, lambda r: r["sequence"] == 2, "two results")
    assert (registers["fault_code"], registers["state"]) == (Fault.FRAME_BLACK, State.CONTINUOUS_EXECUTION)
    at_work.camera.permits.release()
    shown(at_work, lambda r: r["verdict"] == Verdict.PASS, "a pass")
    assert len([r for r in caplog.records if r.getMessage() == "frame fails: the frame is black"]) == 1


def test_a_lamp_that_warms_up_is_waited_for(bench: Callable[..., Bench], shown: Callable[..., Any]) -> None:
    at_work = bench(lamp={"warm_up_s": 3600.0})
    at_work.camera.permits.release(2)
    registers = shown(at_work, lambda r: r["sequence"] == 2, "two results")
    assert (registers["fault_code"], registers["verdict"]) == (Fault.LAMP_WARMING_UP, 0)
    assert registers["state"] == State.INITIALIZED
    assert Status.LAMP_OK in Status(int(registers["status"]))


def test_a_clock_sets_the_pace_and_what_it_misses_is_counted(
    bench: Callable[..., Bench], shown: Callable[..., Any], wait_until: Callable[..., Any]
) -> None:
    at_work = bench(cycle={"trigger": {"kind": "timed", "rate_hz": 50.0}})
    at_work.camera.permits.release()
    first = shown(at_work, lambda r: r["sequence"] == 1, "first result")
    threading.Event().wait(0.1)  # ticks pass while the camera keeps the second cycle waiting: that is the subject
    at_work.camera.permits.release(2)
    third = shown(at_work, lambda r: r["sequence"] == 3, "third result")
    assert third["missed_triggers"] > first["missed_triggers"]


def test_reload_opens_again_only_what_changed(
    bench: Callable[..., Bench], shown: Callable[..., Any], caplog: pytest.LogCaptureFixture
) -> None:
    at_work = bench()
    at_work.camera.permits.release()
    shown(at_work, lambda r: r["sequence"] == 1, "a result")
    at_work.station.settings["recipe"] = {"id": 2, "lamp_percent": 50.0}
    reload(at_work)
    shown(at_work, lambda r: r["recipe_id"] == 2 and r["lamp_set_mv"] == 2500, "new recipe")
    assert (at_work.camera.opened, at_work.lamp.opened, at_work.lamp.closed) == (1, 1, 0)
    at_work.station.settings["lamp"] = {"tolerance_v": 0.1}
    at_work.station.settings["recipe"]["id"] = 3
    reload(at_work)
    shown(at_work, lambda r: r["recipe_id"] == 3, "new lamp")
    assert (at_work.camera.opened, at_work.lamp.closed) == (1, 1)


def test_by_another_recipe_the_last_result_is_no_verdict_until_there_is_a_new_one(
    bench: Callable[..., Bench], shown: Callable[..., Any], wait_until: Callable[..., Any]
) -> None:
    at_work = bench()
    at_work.camera.permits.release()
    shown(at_work, lambda r: r["sequence"] == 1 and r["verdict"] == Verdict.PASS, "a result")
    at_work.station.settings["recipe"] = {"id": 2}
    wait_until(lambda: at_work.camera.waiting, "a cycle under way")
    reload(at_work)
    taken = shown(at_work, lambda r: r["recipe_id"] == 2, "new recipe")
    assert (taken["sequence"], taken["verdict"], taken["panels_passed"]) == (2, Verdict.NOT_INSPECTED, 2)
    assert Status.RESULTS_VALID not in Status(int(taken["status"]))
    wait_until(lambda: at_work.camera.waiting, "a cycle under way")
    reload(at_work)  # nothing has changed: the result stays
    again = shown(at_work, lambda r: r["sequence"] == 3 and r["state"] != State.CONTINUOUS_EXECUTION, "the same again")
    assert (again["recipe_id"], again["verdict"]) == (2, Verdict.PASS)


def test_a_result_that_is_held_keeps_its_recipe_over_new_settings(
    bench: Callable[..., Bench], shown: Callable[..., Any]
) -> None:
    at_work = bench(plc={"port": 0, "buffer_results": True})
    at_work.camera.permits.release()
    before = shown(at_work, lambda r: r["sequence"] == 1, "a result")
    at_work.station.settings["recipe"] = {"id": 2, "lamp_percent": 50.0}
    reload(at_work)
    held = shown(at_work, lambda r: r["lamp_set_mv"] == 2500, "new recipe")
    kept = ("sequence", "verdict", "recipe_id", "recipe_hash", "configuration_hash")
    assert [held[name] for name in kept] == [before[name] for name in kept]
    assert held["verdict"] == Verdict.PASS


@pytest.mark.parametrize(
    "fails", ["inspector.service.line_history.extent_of", "inspector.service.daemon.configuration_hash"]
)
def test_settings_that_are_refused_change_nothing_whatever_they_are_refused_for(
    fails: str, bench: Callable[..., Bench], shown: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    def gone(*_: Any) -> Any:
        raise CalibrationError("the calibration is gone")

    at_work = bench()
    at_work.camera.permits.release()
    before = shown(at_work, lambda r: r["sequence"] == 1, "a result")
    at_work.station.settings |= {"recipe": {"id": 2, "lamp_percent": 50.0}, "plc": {"port": 0, "idle_timeout_s": 9.0}}
    port = at_work.daemon.port
    monkeypatch.setattr(fails, gone)
    reload(at_work)
    shown(at_work, lambda r: Status.SETTINGS_REFUSED in Status(int(r["status"])), "refused")
    at_work.camera.permits.release()
    after = shown(at_work, lambda r: r["sequence"] == 3, "a result after it")
    same = ("recipe_id", "lamp_set_mv", "lamp_read_mv", "configuration_hash", "verdict")
    assert [after[name] for name in same] == [before[name] for name in same]
    assert at_work.daemon.port == port


def test_an_error_while_the_station_gets_ready_is_not_hidden_by_the_farewell(
    station: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: Any) -> Any:
        raise ZeroDivisionError("a bug")

    monkeypatch.setattr(Daemon, "_triggered", fails)
    signals = Signals()
    daemon = Daemon(station.file, front_of(station, signals), signals)
    with pytest.raises(ZeroDivisionError):
        daemon.run(Limits())


def test_reload_lets_the_cycle_be_silent_for_as_long_as_the_new_devices_may(
    bench: Callable[..., Bench], wait_until: Callable[..., Any]
) -> None:
    at_work = bench()
    before_s = at_work.daemon.stall_after_s
    at_work.station.settings["camera"]["deadline_s"] = 60
    reload(at_work)
    wait_until(lambda: at_work.daemon.stall_after_s > 60 > before_s, "a longer silence is allowed")


def test_an_inspection_that_hangs_is_told_long_before_a_device_would_be(
    bench: Callable[..., Bench], shown: Callable[..., Any]
) -> None:
    """The camera may keep the cycle silent for a minute; an inspection may not."""
    at_work, goes_on = bench(camera={"kind": "replay", "paths": ["frames"], "deadline_s": 50}), threading.Event()
    at_work.says[1] = goes_on
    assert at_work.daemon.stall_after_s > 50
    at_work.camera.permits.release()
    told = shown(at_work, lambda r: r["fault_code"] == Fault.CYCLE_STALLED, "the stall")
    assert (told["state"], told["verdict"]) == (State.ERROR, Verdict.NOT_INSPECTED)
    goes_on.set()
    shown(at_work, lambda r: r["sequence"] == 1 and r["verdict"] == Verdict.PASS, "the result after all")


def reload(bench: Bench) -> None:
    """As SIGHUP does; a permit lets the cycle under way end."""
    bench.station.write()
    bench.signals.request_reload()
    bench.camera.permits.release()


def test_a_reload_that_cannot_have_its_port_leaves_the_registers_where_they_are(
    bench: Callable[..., Bench], shown: Callable[..., Any]
) -> None:
    at_work = bench()
    port = at_work.daemon.port
    with socket.create_server(("127.0.0.1", 0)) as taken:
        at_work.station.settings["plc"] = {"port": taken.getsockname()[1]}
        reload(at_work)
        shown(at_work, lambda r: Status.SETTINGS_REFUSED in Status(int(r["status"])), "refused")
    assert at_work.daemon.port == port
    reload(at_work)
    shown(
        at_work, lambda r: r["sequence"] == 2 and at_work.daemon.port != port, "a result on the port that is free now"
    )


@pytest.mark.parametrize(("host", "refused"), [("0.0.0.0", False), ("192.0.2.1", True)])
def test_a_reload_on_the_same_port_is_served_again_either_way(
    host: str, refused: bool, bench: Callable[..., Bench], wait_until: Callable[..., Any], shown: Callable[..., Any]
) -> None:
    at_work = bench()
    before = at_work.daemon.port
    at_work.station.settings["plc"] = {"port": 0, "host": host}
    reload(at_work)
    wait_until(lambda: at_work.daemon.port not in (before, 0), "another server")
    registers = shown(at_work, lambda r: r["sequence"] >= 2 or at_work.camera.permits.release(), "a second result")
    assert (Status.SETTINGS_REFUSED in Status(int(registers["status"]))) is refused


def test_limits_and_a_stop_end_a_run(station: Any) -> None:
    signals = Signals()
    signals.request_stop()
    signals.wait(1000)
    with pytest.raises(StopRequested), signals.interruptible():
        pytest.fail("a stop that came before is not forgotten")
    daemon = Daemon(station.file, front_of(station, signals), signals)
    daemon.run(Limits())
    with pytest.raises(OSError, match=re.compile("refused", re.IGNORECASE)):
        socket.create_connection(("127.0.0.1", daemon.port), timeout=5)


def test_a_wait_ends_when_another_thread_asks_for_new_settings() -> None:
    signals = Signals()
    waiter = threading.Thread(target=signals.wait, args=(1000.0,))
    waiter.start()
    signals.request_reload()
    waiter.join(20)
    assert not waiter.is_alive()
