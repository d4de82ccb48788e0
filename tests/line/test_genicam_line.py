"""The service with a GigE Vision camera that is killed and plugged in again while it inspects."""

from __future__ import annotations

import re
import signal
from collections.abc import Callable
from typing import Any

import gige
import pytest

from firmware_bridge.simulators.module_server import ModuleServer
from inspector.faults import Fault
from inspector.model import Verdict

LOST_FRAME = re.compile("is damaged|no frame in")
"""How the log tells of a frame lost on the way, from a camera that lives."""


@pytest.mark.xdist_group(gige.PORT)
@pytest.mark.timeout(400)
@pytest.mark.parametrize("outages", [1, pytest.param(10, marks=pytest.mark.long)])
def test_each_outage_is_reported_once_and_ends_without_a_restart(
    outages: int, station: Any, module: Callable[[], ModuleServer], service: Callable[..., Any], gige_camera: Any,
    wait_until: Any,
) -> None:  # fmt: skip
    module()
    camera = gige_camera()
    station.settings["camera"] = {"kind": "genicam", "camera": gige.ADDRESS, "command_deadline_s": 1.0}
    station.settings["recipe"] |= {"exposure_us": 1000}
    station.write()
    running = service()
    running.until_inspecting()
    plc, before = running.plc(), gige.Traces.of(running.process.pid)

    def told() -> list[str]:
        """What the log says of the camera, in order."""
        return [line for line in running.log if "camera fails: " in line or "camera works again" in line]

    for count in range(1, outages + 1):
        said = len(told())
        camera.kill()
        wait_until(lambda: plc.read()["fault_code"] == Fault.CAMERA_GONE, f"outage {count}; log: {running.log}")
        assert plc.read()["verdict"] == Verdict.NOT_INSPECTED
        wait_until(lambda: len(told()) % 2 == 1, f"the beginning of outage {count} is said; log: {running.log}")
        camera.start()
        wait_until(lambda: plc.read()["verdict"], f"recovery {count}; log: {running.log}", 40)
        wait_until(lambda: len(told()) % 2 == 0, f"the end of outage {count} is said; log: {running.log}")
        assert _kill_is_told_once(told(), said), running.log
    if outages > 1:
        wait_until(lambda: gige.Traces.of(running.process.pid).within(before), "all is given back", 60)
    # With one outage, the lost connection is still being given up: that keeps nobody from stopping.
    running.send(signal.SIGTERM)
    assert running.ended() == 0, running.log


def _kill_is_told_once(told: list[str], said: int) -> bool:
    """Whether beginnings and ends alternate, and a kill after the first ``said`` lines has one beginning, not more.

    A frame that a loaded machine loses on the way is an outage of its own. If one was going on at the kill, it became
    the kill's, and its beginning is not said again.
    """
    alternate = all(("camera fails: " in line) == (n % 2 == 0) for n, line in enumerate(told))
    begun = [line for line in told[said - said % 2 :] if "camera fails: " in line]
    return alternate and bool(begun) and sum(not LOST_FRAME.search(line) for line in begun) <= 1
