"""The statistics of the service as a process, as a PLC reads them."""

from __future__ import annotations

import signal
from collections.abc import Callable
from typing import Any

from firmware_bridge.simulators.module_server import ModuleServer
from inspector.handshake_table import Answer, Command, CommandResult, Control
from inspector.publish.registers import CONTROL_ADDRESS
from inspector.publish.statistics_registers import STATISTICS_ADDRESS, STATISTICS_WORDS, StatisticsStatus
from tests.line.conftest import Plc, Service, Station


def read(plc: Plc) -> dict[str, Any]:
    shown = plc.read(STATISTICS_ADDRESS, STATISTICS_WORDS)
    assert shown["statistics_sequence"] == shown["statistics_sequence_end"]
    return shown


def test_statistics_are_served_kept_over_a_restart_and_reset_by_the_plc(
    station: Station,
    module: Callable[[], ModuleServer],
    service: Callable[..., Service],
    wait_until: Callable[..., Any],
) -> None:
    module()
    station.settings["statistics_file"] = "statistics.json"
    station.settings["statistics"] = {"baseline_panels": 10, "baseline_defects": 1}
    station.write()
    first = service()
    plc = first.plc()
    learnt = StatisticsStatus.VALID | StatisticsStatus.BASELINE

    def known() -> dict[str, Any] | None:
        shown = read(plc)
        return shown if learnt in StatisticsStatus(shown["statistics_status"]) else None

    before = wait_until(known, "a baseline")
    assert before["statistics_panels"] >= 10
    assert before["baseline_per_m2"] > 0
    assert before["upper_per_m2"] > before["baseline_per_m2"] > before["lower_per_m2"]
    first.send(signal.SIGTERM)
    assert first.ended() == 0

    again = service()
    plc = again.plc()
    after = wait_until(known, "the same baseline")
    assert after["statistics_panels"] > before["statistics_panels"], "the count goes on"

    assert plc.write(CONTROL_ADDRESS, Control.EXECUTE, 0, 0, 0, Command.RESET_STATISTICS, 0, 0, 0) == 0
    told = again.until(lambda r: Answer(r["handshake"]) & Answer.COMMAND_COMPLETED, "the reset")
    assert told["command_result"] == CommandResult.DONE
    reset = wait_until(known, "statistics after the reset")
    assert reset["statistics_panels"] < after["statistics_panels"]
