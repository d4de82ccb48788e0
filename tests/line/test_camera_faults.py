"""What goes wrong with frames, one after another in one run of the service; and every row of the fault table is met."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from firmware_bridge.simulators.module_server import ModuleServer
from inspector.commands.fault_table import ROWS

TESTS = Path(__file__).parents[1]
COUNT, APART = 3, 12

ASKED_FOR = {
    "gone": ("the camera, its port or its folder is gone", "CAMERA_GONE"),
    "silent": (
        "the camera gives no frame in time; a camera that waits for its line's signal is no fault",
        "CAMERA_TIMEOUT",
    ),
    "damaged": ("the frame is short or damaged, or an old one comes again", "CAMERA_FRAME_WRONG"),
    "old": ("the frame is short or damaged, or an old one comes again", "CAMERA_FRAME_WRONG"),
    "ids back": ("the frame is short or damaged, or an old one comes again", "CAMERA_FRAME_WRONG"),
    "other exposure": ("the exposure read back, or the frame's own, is not the one set", "EXPOSURE_READBACK"),
    "black": ("the lamp is dead, or the lens cap is on", "the frame is black"),
    "saturated": ("light from elsewhere, or too long an exposure", "the frame is lit all over"),
    "noise": ("light from elsewhere, or too long an exposure", "no highlight could stand out"),
    "other size": ("a frame of another size", "the frame is 640 x 240 pixels"),
}
"""What can be asked of a simulated camera -> the table's row, and what the station's line says."""

ELSEWHERE = {
    "the camera refuses a setting": "bridge/test_serial_ccd_camera.py::test_an_exposure_that_the_head_refuses",
    "a frame whose pixels are not grey values of 8 or 16 bits": "line/test_snapshots.py::test_a_frame_that_cannot_be",
    "the lamp is not warm, after a start or an outage": "line/test_daemon.py::test_a_lamp_that_warms_up_is_waited_for",
    "the lamp is weak: the reference patch stays dark at the highest level allowed": (
        "line/test_tuned_cycle.py::test_a_bulb_that_ages_is_trimmed_told"
    ),
    "the line babbles without end": "bridge/test_modbus_master.py::test_a_babbling_line_does_not_hang_a_request",
    "the cycle hangs": "publish/test_plc_server.py::test_a_stalled_cycle_is_told_until_it_beats_again",
    "an error in the program": "line/test_daemon.py::test_an_error_in_the_program_is_a_fault",
    "new settings do not bring a station to Ready that was (cycle.rollback_after_s)": (
        "line/test_last_good.py::test_over_the_wire_settings_that_fail_are_taken_back"
    ),
    "the settings are refused at a start": "line/test_last_good.py::test_a_refused_file_begins_with_the_last_good",
    "the disk is full, read-only, gone or too slow for the results": (
        "line/test_archive_service.py::test_without_its_disk_the_line_goes_on_and_nothing_is_lost"
    ),
    "the results' store is damaged, or was taken away": (
        "line/test_archive_service.py::test_a_damaged_store_is_set_aside_and_the_plc_is_told"
    ),
    "new settings are refused at a reload": "line/test_service.py::test_reload_takes_a_right_file_whole_and_a_wrong",
}
"""Rows that other tests meet, by file and the beginning of the name. The module's are in test_faults_at_the_wire.py."""


def kind_of(line: str) -> str:
    """What a station's line says: a verdict's word, or which of the faults above it was."""
    if line.split()[1] != "NOT_INSPECTED":
        return "inspected"
    return next((words for _, words in ASKED_FOR.values() if words in line), line)


def test_each_fault_is_told_said_once_and_over_by_itself(
    station: Any, module: Callable[[], ModuleServer], service: Callable[..., Any]
) -> None:
    module()
    plan = [{"kind": kind, "after": APART * (n + 1), "count": COUNT} for n, kind in enumerate(ASKED_FOR)]
    station.settings["camera"] = {"kind": "simulated", "seeds": [[0, 0, 1500]], "rate_hz": 60, "faults": plan}
    station.write()
    running = service()
    running.until(lambda r: r["acquisition_id"] > APART * (len(ASKED_FOR) + 1), "all of it is over")
    lines = running.lines_to(len(running.results))
    seen = [kind for kind, _ in itertools.groupby(map(kind_of, lines))]
    expected = [said for _, words in ASKED_FOR.values() for said in ("inspected", words)]
    assert seen[: len(expected) + 1] == [*expected, "inspected"]
    assert not [line for line in lines if line.split()[1] == "PASS" and "1 seed" not in line]
    # Each begins once and ends once; in between the log is silent.
    log = [line for line in running.log if " fails: " in line or " works again " in line]
    assert len(log) == 2 * len(ASKED_FOR), log
    for (happening, _), begins, ends in zip(ASKED_FOR.values(), log[::2], log[1::2], strict=True):
        (row,) = (row for row in ROWS if row.happening == happening)
        assert re.search(".*".join(map(re.escape, row.log.split("…"))), begins), (row.log, begins)
        assert " works again after " in ends


def test_every_row_of_the_table_is_met_by_a_test_of_its_name() -> None:
    here = {happening for happening, _ in ASKED_FOR.values()}
    at_the_wire = (TESTS / "bridge" / "test_faults_at_the_wire.py").read_text()
    for row in ROWS:
        if row.happening in here or f'"{row.happening}"' in at_the_wire:
            continue
        file, _, name = ELSEWHERE[row.happening].partition("::")
        assert f"def {name}" in (TESTS / file).read_text(), row.happening
