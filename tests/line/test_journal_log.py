"""The journal's native protocol, byte for byte, and what a journal that is busy, gone or new does to the service."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import socket
import struct
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from inspector import journal_log
from inspector.faults import Fault
from inspector.journal_log import JournalHandler, TextFormatter, encoded
from inspector.model import Reason, Snapshot, Verdict
from inspector.publish.result_log import LogSettings, ResultLog
from inspector.service.last_good import log_problems
from inspector.settings import SettingsError, load


def read(datagram: bytes) -> dict[str, bytes]:
    """An entry's fields, read as the protocol's text says."""
    fields = {}
    while datagram:
        line, _, datagram = datagram.partition(b"\n")
        name, is_plain, value = line.partition(b"=")
        if not is_plain:
            (length,) = struct.unpack("<Q", datagram[:8])
            value, datagram = datagram[8 : 8 + length], datagram[8 + length :]
            assert datagram[:1] == b"\n"
            datagram = datagram[1:]
        fields[name.decode()] = value
    return fields


@pytest.fixture
def journal(tmp_path: Path) -> Iterator[socket.socket]:
    """A journal's socket, which nobody reads but the test."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(tmp_path / "journal"))
        listener.settimeout(20)
        yield listener


@pytest.fixture
def log(journal: socket.socket) -> Iterator[logging.Logger]:
    """A logger that speaks to that journal and nobody else."""
    logger, handler = logging.Logger("inspector.test", logging.DEBUG), JournalHandler(journal.getsockname())
    logger.addHandler(handler)
    yield logger
    handler.close()


def test_an_entry_byte_for_byte(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "getpid", lambda: 12)
    assert encoded({"MESSAGE": "camera fails", "FAULT_CODE": Fault.CAMERA_GONE}) == (
        b"SYSLOG_IDENTIFIER=inspector\nSYSLOG_PID=12\nMESSAGE=camera fails\nFAULT_CODE=301\n"
    )
    assert encoded({"MESSAGE": "a\nb="}).endswith(b"\nMESSAGE\n\x04\x00\x00\x00\x00\x00\x00\x00a\nb=\n")


@given(st.text(st.characters(), max_size=200))
def test_no_text_makes_a_field_of_its_own(text: str) -> None:
    fields = read(encoded({"MESSAGE": text, "PRIORITY": 6}))
    assert list(fields) == ["SYSLOG_IDENTIFIER", "SYSLOG_PID", "MESSAGE", "PRIORITY"]
    assert fields["MESSAGE"] == text.encode("utf-8", "backslashreplace")


@pytest.mark.parametrize(("level", "priority"), [
    ("DEBUG", b"7"), ("INFO", b"6"), ("WARNING", b"4"), ("ERROR", b"3"), ("CRITICAL", b"2"),
])  # fmt: skip
def test_levels_are_priorities(level: str, priority: bytes, log: logging.Logger, journal: socket.socket) -> None:
    log.log(logging.getLevelNamesMapping()[level], "it is so")
    assert read(journal.recv(100_000))["PRIORITY"] == priority


def test_a_line_says_what_it_is_about_and_where_it_was_written(log: logging.Logger, journal: socket.socket) -> None:
    log.error("camera fails", extra={"device": "camera", "fault_code": Fault.CAMERA_TIMEOUT, "sequence": 70000})
    fields = read(journal.recv(100_000))
    assert (fields["DEVICE"], fields["FAULT_CODE"], fields["SEQUENCE"]) == (b"camera", b"302", b"70000")
    assert (fields["CODE_FILE"], fields["LOGGER"]) == (__file__.encode(), b"inspector.test")
    assert fields["CODE_FUNC"] == b"test_a_line_says_what_it_is_about_and_where_it_was_written"
    assert "PANEL_ID" not in fields


def test_a_traceback_is_one_entry(log: logging.Logger, journal: socket.socket) -> None:
    try:
        raise ZeroDivisionError("a bug")
    except ZeroDivisionError:
        log.exception("inspection fails")
    message = read(journal.recv(100_000))["MESSAGE"].decode().splitlines()
    assert (message[0], message[-1]) == ("inspection fails", "ZeroDivisionError: a bug")


def test_what_is_too_long_is_cut_between_two_characters_and_says_so(
    log: logging.Logger, journal: socket.socket
) -> None:
    log.info("x" + "µ" * journal_log.VALUE_BYTES)
    message = read(journal.recv(500_000))["MESSAGE"].decode()
    kept = (journal_log.VALUE_BYTES - 1) // 2
    assert message == "x" + "µ" * kept + f"... ({2 * (journal_log.VALUE_BYTES - kept)} bytes more)"


def test_a_journal_that_does_not_read_costs_lines_and_says_so(log: logging.Logger, journal: socket.socket) -> None:
    (handler,) = log.handlers
    assert isinstance(handler, JournalHandler)
    sent = 0
    while not handler.lost:  # until its queue is full: a call that waited would never come back
        log.info("line %d", sent)
        sent += 1
    log.info("lost too")
    for n in range(sent - 1):
        assert read(journal.recv(100_000))["MESSAGE"] == b"line %d" % n
    log.info("heard again")
    told, heard = (read(journal.recv(100_000)) for _ in range(2))
    assert told["MESSAGE"] == b"lines of the log lost: 2, which the journal did not take"
    assert (heard["MESSAGE"], handler.lost) == (b"heard again", 2)


def test_a_journal_that_starts_again_is_found(log: logging.Logger, journal: socket.socket) -> None:
    address = journal.getsockname()
    journal.close()
    log.info("to nobody")
    os.unlink(address)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as anew:
        anew.bind(address)
        anew.settimeout(20)
        log.info("to the new one")
        assert b"lines of the log lost: 1," in anew.recv(100_000)
        assert read(anew.recv(100_000))["MESSAGE"] == b"to the new one"


def test_nothing_that_is_logged_raises(log: logging.Logger, journal: socket.socket) -> None:
    class Wrong:
        def __str__(self) -> str:
            raise ZeroDivisionError

    log.info("%s", Wrong())
    log.info("%d", "no number")
    log.info("after")
    for message in (b"lines of the log lost: 1,", b"lines of the log lost: 1,", b"MESSAGE=after\n"):
        assert message in journal.recv(100_000)


def test_text_on_a_terminal_names_what_it_is_about() -> None:
    record = logging.makeLogRecord({"msg": "camera fails", "device": "camera", "fault_code": Fault.CAMERA_GONE})
    assert TextFormatter("%(message)s").format(record) == "camera fails  [fault_code=301 device=camera]"
    assert TextFormatter("%(message)s").format(logging.makeLogRecord({"msg": "stopped"})) == "stopped"


BLACK = Snapshot(verdict=Verdict.NOT_INSPECTED, fault_code=Fault.FRAME_BLACK, reasons=Reason.FRAME_BLACK)
GONE = Snapshot(verdict=Verdict.NOT_INSPECTED, fault_code=Fault.CAMERA_GONE, reasons=Reason.DEVICE_FAULT)
PASS, FAIL = Snapshot(verdict=Verdict.PASS), Snapshot(verdict=Verdict.FAIL)


@pytest.mark.parametrize(("results", "told"), [
    ("fails", "FAIL FAIL NOT_INSPECTED NOT_INSPECTED NOT_INSPECTED"),
    ("all", "PASS FAIL FAIL NOT_INSPECTED NOT_INSPECTED NOT_INSPECTED PASS NOT_INSPECTED"),
    ("none", ""),
])  # fmt: skip
def test_which_results_the_journal_is_told(results: Any, told: str, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    result_log = ResultLog()
    for result in (PASS, FAIL, FAIL, BLACK, BLACK, GONE, PASS, BLACK):
        result_log.tell(LogSettings(results=results), result, "frame", ())
    assert " ".join(record.verdict for record in caplog.records) == told


STDERR_IS_THE_JOURNAL = """
import os, sys
from inspector import __main__ as cli
from inspector import journal_log
found = os.fstat(2)
os.environ["JOURNAL_STREAM"] = f"{found.st_dev}:{found.st_ino}"
journal_log.SOCKET = sys.argv[1]
sys.argv[1:] = sys.argv[2:]
cli.main()
"""


@pytest.fixture
def journalled(station: Any, journal: socket.socket, tmp_path: Path) -> Iterator[Callable[..., dict[str, bytes]]]:
    """``journalled(condition)``: the first entry that it holds for, of a service whose output leads to the journal."""
    command = [sys.executable, "-c", STDERR_IS_THE_JOURNAL, journal.getsockname(), "run", "--config", str(station.file)]
    with contextlib.ExitStack() as stack, (tmp_path / "stream").open("w+") as stream:
        started: list[subprocess.Popen[bytes]] = []

        def first(condition: Callable[[dict[str, bytes]], Any]) -> dict[str, bytes]:
            if not started:
                started.append(subprocess.Popen(command, stdout=stream, stderr=stream))
                stack.callback(lambda: (started[0].kill(), started[0].wait(20)))
            return next(entry for entry in iter(lambda: read(journal.recv(200_000)), None) if condition(entry))

        yield first


def test_a_station_whose_output_leads_to_the_journal(
    station: Any, module: Callable[..., Any], journalled: Callable[..., dict[str, bytes]], tmp_path: Path
) -> None:
    plugged = module()
    station.settings["recipe"]["limits"]["max_height_um"] = 500
    station.write()
    fail = journalled(lambda e: e.get("VERDICT") == b"FAIL")
    assert fail["MESSAGE"].startswith(b"#" + fail["SEQUENCE"])
    assert (fail["PRIORITY"], fail["RECIPE_ID"], fail["FAULT_CODE"]) == (b"6", b"1", b"0")
    plugged.stop()
    outage = journalled(lambda e: e.get("DEVICE") == b"module")
    assert (outage["PRIORITY"], outage["FAULT_CODE"]) == (b"3", b"101")
    once = journalled(lambda e: e.get("VERDICT") == b"NOT_INSPECTED")
    assert (once["FAULT_CODE"], once["PRIORITY"]) == (b"101", b"4")
    module()
    between: list[dict[str, bytes]] = []
    journalled(lambda e: between.append(e) or b"works again" in e["MESSAGE"])
    assert {e["FAULT_CODE"] for e in between if e.get("VERDICT") == b"NOT_INSPECTED"} <= {b"102", b"103"}
    printed = (tmp_path / "stream").read_text()
    assert "mbpoll" in printed
    assert "#1 " not in printed


@pytest.mark.parametrize("key", ["password", "passwort", "api_token", "address", "host"])
def test_no_message_shows_a_secret(key: str, station: Any, caplog: pytest.LogCaptureFixture) -> None:
    address = "http://station:hunter2@10.0.0.7/stream"
    secret = address if key in ("address", "host") else "hunter2"
    for place in ("plc", "camera", "module"):
        station.settings[place][key] = [secret] if key == "host" else secret
    station.settings["recipe"] = {"login": {key: secret}, "limits": [{key: secret}]}
    station.write()
    with pytest.raises(SettingsError) as refused:
        load(station.file)
    log_problems(refused.value)
    assert len(caplog.records) >= 5
    assert "hunter2" not in caplog.text
    assert "(hidden)" in caplog.text


@pytest.mark.long
def test_systemd_reads_what_we_write(tmp_path: Path, peer: Callable[[str, str], str]) -> None:
    """The export format's fields are the native protocol's: systemd's own reader takes the bytes."""
    remote = peer("/lib/systemd/systemd-journal-remote", "systemd-journal-remote")
    entry = b"__REALTIME_TIMESTAMP=1800000000000000\n_BOOT_ID=" + b"0123456789abcdef" * 2 + b"\n"
    fields = {"MESSAGE": "two\nlines = µ", "PRIORITY": 3, "FAULT_CODE": Fault.CAMERA_GONE, "DEVICE": "camera"}
    (tmp_path / "export").write_bytes(entry + encoded(fields) + b"\n")
    file = tmp_path / "test.journal"
    subprocess.run([remote, "-o", str(file), str(tmp_path / "export")], check=True, capture_output=True, timeout=60)
    command = [peer("journalctl", "systemd"), "--file", str(file), "-o", "json", "FAULT_CODE=301"]
    told = json.loads(subprocess.run(command, check=True, capture_output=True, text=True, timeout=60).stdout)
    assert (told["MESSAGE"], told["PRIORITY"], told["DEVICE"]) == ("two\nlines = µ", "3", "camera")
    assert told["SYSLOG_IDENTIFIER"] == "inspector"
