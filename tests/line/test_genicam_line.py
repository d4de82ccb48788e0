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

    def reported() -> tuple[int, int]:
        """Outages and recoveries in the log, without those of a frame that the loaded machine lost on the way."""
        failed = [line for line in running.log if "fails: " in line]
        lost = [line for line in failed if re.search("is damaged|no frame in", line)]
        works = [line for line in running.log if "camera works again" in line]
        return len(failed) - len(lost), len(works) - len(lost)

    for count in range(1, outages + 1):
        camera.kill()
        wait_until(lambda: plc.read()["fault_code"] == Fault.CAMERA_GONE, f"outage {count}; log: {running.log}")
        assert plc.read()["verdict"] == Verdict.NOT_INSPECTED
        camera.start()
        wait_until(lambda: plc.read()["verdict"], f"recovery {count}; log: {running.log}", 40)
        wait_until(lambda so_far=count: reported() == (so_far, so_far), f"once each; log: {running.log}")
    assert reported() == (outages, outages), running.log
    if outages > 1:
        wait_until(lambda: gige.Traces.of(running.process.pid).within(before), "all is given back", 60)
    # With one outage, the lost connection is still being given up: that keeps nobody from stopping.
    running.send(signal.SIGTERM)
    assert running.ended() == 0, running.log
