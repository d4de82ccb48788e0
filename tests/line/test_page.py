"""The operator's page as a process beside the service: a browser's requests, the registers, and a PLC at full pace."""

from __future__ import annotations

import contextlib
import http.client
import json
import re
import signal
import socket
import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import yaml
from browser import Browser

from inspector.handshake_table import Answer, CommandResult, Control
from inspector.hmi.server import BODY_BYTES, CONNECTIONS, HEADERS, PageServer, Reply
from inspector.model import Verdict
from inspector.publish.registers import CONTROL_ADDRESS, OPERATOR_ADDRESS, OPERATOR_WORDS
from tests.line.conftest import Plc
from tests.support.forked import Command, run

RECIPES = [
    {"id": 1, "name": "lenient", "limits": {"max_height_um": 3000}},
    {"id": 2, "name": "strict", "limits": {"max_height_um": 100}},
]
CHANGES = 6
"""Changes of the recipe while the PLC triggers."""


class PageProcess:
    """`inspector page` with the station's settings, which point to where the service is served."""

    def __init__(self, station: Any, port: int, wait_until: Callable[..., Any]) -> None:
        file = station.folder / "page.yaml"
        file.write_text(yaml.safe_dump(station.settings | {"plc": {"port": port}, "page": {"port": 0}}))
        self.log = station.folder / "page.log"
        self.log.touch()
        self.process = Command("page", "--config", file, output=self.log)
        found = wait_until(lambda: re.search(r"Page: http://127.0.0.1:(\d+)/", self.log.read_text()), "the page's port")
        self.browser = Browser(int(found[1]))

    def close(self) -> None:
        self.process.send_signal(signal.SIGTERM)
        assert self.process.wait(20) == 0, self.log.read_text()


@pytest.fixture
def page(station: Any, wait_until: Callable[..., Any]) -> Iterator[Callable[[int], Browser]]:
    """``page(port)``: a browser at the page of the station that serves its registers there."""
    with contextlib.ExitStack() as stack:

        def open_page(port: int) -> Browser:
            process = PageProcess(station, port, wait_until)
            stack.callback(process.close)
            return process.browser

        yield open_page


@pytest.fixture
def by_recipes(station: Any) -> Any:
    """The station with two recipes, of which one passes its seed and one does not."""
    del station.settings["recipe"]
    station.settings |= {"recipes": RECIPES, "recipe": 1}
    station.settings["module"]["link"] = {"kind": "simulated"}
    station.settings["camera"] = {"kind": "replay", "paths": ["frames/A000.png"], "rate_hz": 5, "deadline_s": 1}
    station.write()
    return station


def ended(browser: Browser, number: int) -> dict[str, Any] | None:
    told = browser.state()["command"]
    assert told["number"] == number
    return dict(told) if told["outcome"] != "running" else None


def carried_out(browser: Browser, recipe: int, wait_until: Callable[..., Any]) -> dict[str, Any]:
    """Choose a recipe at the page; how that ended."""
    status, told = browser.command("CHANGE_RECIPE", recipe)
    assert status == 202, told
    return dict(wait_until(lambda: ended(browser, told["number"]), "the command's end"))


def until_shown(browser: Browser, verdict: str, wait_until: Callable[..., Any]) -> dict[str, Any]:
    def met() -> dict[str, Any] | None:
        state = browser.state()
        return state if state["verdict"]["name"] == verdict else None

    return dict(wait_until(met, f"{verdict} on the page"))


def foreign_pages_command_nothing(browser: Browser, plc: Plc) -> None:
    for refused in (
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Sec_Fetch_Site": "cross-site"},
        {"X_Page_Token": "guessed"},
        {"X_Page_Token": ""},
        {"Content_Type": "text/plain"},
        {"Host": "evil.example"},
    ):
        assert browser.command("CHANGE_RECIPE", 2, **refused)[0] in (403, 415, 421), refused
    assert browser.command("DISCARD_RESULTS")[0] == 400
    assert browser.command("CHANGE_RECIPE", 65536)[0] == 400
    assert browser.ask("GET", "/api/command")[0] == 404
    assert browser.ask("GET", "/api/state", Host=f"evil.example:{browser.port}")[0] == 421
    assert plc.read(OPERATOR_ADDRESS, OPERATOR_WORDS)["operator_command_echo"] == 0  # none has reached the station


def the_recipe_is_changed_or_stays(browser: Browser, plc: Plc, wait_until: Callable[..., Any]) -> None:
    done = carried_out(browser, 2, wait_until)
    assert (done["outcome"], done["code"]) == ("done", CommandResult.DONE)
    plc.until(wait_until, lambda r: (r["recipe_id"], r["verdict"]) == (2, Verdict.FAIL), "judged by the strict recipe")
    until_shown(browser, "FAIL", wait_until)
    failed = carried_out(browser, 9, wait_until)
    assert (failed["outcome"], failed["code"]) == ("failed", CommandResult.REFUSED)
    assert "FAILED, code 5" in failed["text"]
    assert plc.read()["recipe_id"] == 2
    at_rest = plc.read(OPERATOR_ADDRESS, OPERATOR_WORDS)
    assert (at_rest["operator_control"], at_rest["operator_handshake"]) == (0, 0)


def test_people_at_the_page_of_a_station_that_hangs_dies_and_comes_back(
    by_recipes: Any, service: Callable[..., Any], page: Callable[[int], Browser], wait_until: Callable[..., Any]
) -> None:
    running = service()
    port, plc = running.port, running.plc()
    browser = page(port)
    shown = until_shown(browser, "PASS", wait_until)
    assert (shown["recipe"], shown["fault"]) == ("1  lenient", None)
    offered = json.loads(browser.ask("GET", "/api/recipes")[2])["recipes"]
    assert [(r["id"], r["name"], r["used"]) for r in offered] == [(1, "lenient", True), (2, "strict", False)]
    foreign_pages_command_nothing(browser, plc)
    the_recipe_is_changed_or_stays(browser, plc, wait_until)

    running.send(signal.SIGSTOP)  # it still has its port, and answers nothing
    until_shown(browser, "NO_STATION", wait_until)
    running.send(signal.SIGCONT)
    until_shown(browser, "FAIL", wait_until)
    running.process.kill()
    gone = wait_until(lambda: s if (s := browser.state())["link"]["kind"] == "down" else None, "a station that is gone")
    assert (gone["verdict"]["name"], "seeds" in gone) == ("NO_STATION", False)
    assert gone["history"]
    assert browser.command("CHANGE_RECIPE", 2)[0] == 503
    by_recipes.settings["plc"]["port"] = port
    by_recipes.write()
    service()
    until_shown(browser, "PASS", wait_until)  # by the settings' recipe again


class LinePlc:
    """A PLC that triggers panel after panel, writes its whole control block each time, and takes every result once."""

    def __init__(self, plc: Plc, wait_until: Callable[..., Any]) -> None:
        self._plc, self._wait_until = plc, wait_until
        self.results: list[dict[str, Any]] = []

    def write(self, bits: int, sequence: int = 0, panel_id: int = 0) -> None:
        words = (Control.BUFFER_RESULTS | bits, sequence, panel_id >> 16, panel_id & 0xFFFF, *[0] * 12)
        assert self._plc.write(CONTROL_ADDRESS, *words) == 0

    def until(self, answer: Answer, is_set: bool = True) -> dict[str, Any]:
        def met(registers: dict[str, Any]) -> bool:
            return (answer in Answer(registers["handshake"])) is is_set

        return dict(self._plc.until(self._wait_until, met, f"{answer.name} {is_set}"))

    def panel(self, panel_id: int) -> None:
        self.until(Answer.TRIGGER_READY)
        self.write(Control.TRIGGER, panel_id=panel_id)
        self.until(Answer.TRIGGER_ACK)
        self.write(0)
        self.results.append(self.until(Answer.RESULT_AVAILABLE))
        self.write(Control.RESULTS_ACK, self.results[-1]["sequence"])
        self.until(Answer.RESULT_AVAILABLE, is_set=False)
        self.write(0)


def test_a_plc_at_full_pace_loses_nothing_while_people_change_the_recipe(
    by_recipes: Any, service: Callable[..., Any], page: Callable[[int], Browser], wait_until: Callable[..., Any]
) -> None:
    by_recipes.settings["cycle"]["trigger"] = {"kind": "plc"}
    by_recipes.settings["camera"]["rate_hz"] = 200
    by_recipes.write()
    running = service()
    browser, line = page(running.port), LinePlc(running.plc(), wait_until)
    wait_until(lambda: browser.state()["link"]["kind"] == "up", "the page has found the station")
    over, changed = threading.Event(), list[str]()

    def change_recipes() -> None:
        with contextlib.ExitStack() as at_end:
            at_end.callback(over.set)
            for n in range(CHANGES):
                changed.append(carried_out(browser, 2 - n % 2, wait_until)["outcome"])

    people = threading.Thread(target=change_recipes)
    people.start()
    panel_id = 0
    while not over.is_set() or panel_id < 20:
        panel_id += 1
        line.panel(panel_id)
    people.join()
    assert changed == ["done"] * CHANGES
    assert [r["panel_id"] for r in line.results] == list(range(1, panel_id + 1))
    assert [r["sequence"] for r in line.results] == list(range(1, panel_id + 1))
    last = line.results[-1]
    assert (last["missed_triggers"], last["overruns"]) == (0, 0)
    for result in line.results:
        assert (result["recipe_id"], result["verdict"]) in ((1, Verdict.PASS), (2, Verdict.FAIL))
    assert {r["recipe_id"] for r in line.results} == {1, 2}
    entries = [entry for entry in running.log if "Operator command 1 (CHANGE_RECIPE)" in entry]
    assert len(entries) == CHANGES
    assert all("carried out" in entry for entry in entries)


@pytest.fixture
def server() -> Iterator[Callable[..., PageServer]]:
    """``server(deadline_s)``: a page's server with one answer to everything."""
    with contextlib.ExitStack() as stack:

        def start(deadline_s: float) -> PageServer:
            made = PageServer("127.0.0.1", 0, lambda request: Reply(request.body or b"here"), deadline_s=deadline_s)
            stack.callback(made.server_close)
            threading.Thread(target=made.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True).start()
            stack.callback(made.shutdown)
            return made

        yield start


def test_every_answer_forbids_what_the_page_does_not_need(server: Callable[..., PageServer]) -> None:
    browser = Browser(server(10.0).port)
    for method, path, body in (("GET", "/", None), ("POST", "/", b"x"), ("PUT", "/", b"x"), ("BREW", "/", None)):
        _, headers, _ = browser.ask(method, path, body)
        assert HEADERS.items() <= headers.items()
        assert "Access-Control-Allow-Origin" not in headers
    policy = HEADERS["Content-Security-Policy"]
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy


@pytest.mark.parametrize(
    ("head", "status"),
    [
        (b"POST / HTTP/1.1\r\nHost: x\r\nContent-Length: %d\r\n\r\n" % (BODY_BYTES + 1), b"413"),
        (b"POST / HTTP/1.1\r\nHost: x\r\nContent-Length: -1\r\n\r\n", b"411"),
        (b"POST / HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n", b"411"),
        (b"GET / HTTP/1.1\r\n" + b"X: %s\r\n" % (b"y" * 20000), b""),
        (b"GET / HTTP/1.1\r\n" + b"X: y\r\n" * 200 + b"\r\n", b"431"),
        (b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03\r\n\r\n", b""),
        (b"GET /\r\n\r\n", b""),
        (b"GET / HTTP/9.9\r\n\r\n", b""),
    ],
)
def test_what_is_no_request_of_a_browser_is_refused(
    server: Callable[..., PageServer], head: bytes, status: bytes
) -> None:
    with socket.create_connection(("127.0.0.1", server(10.0).port), timeout=20) as client:
        answer = b""
        with contextlib.suppress(ConnectionError):
            client.sendall(head)
            while data := client.recv(4096):
                answer += data
    assert status in answer.split(b"\r\n")[0]
    assert bool(answer) is bool(status)


def test_a_crowd_that_says_nothing_gives_its_places_back(
    server: Callable[..., PageServer], wait_until: Callable[..., Any]
) -> None:
    made = server(0.5)
    with contextlib.ExitStack() as stack:
        for _ in range(CONNECTIONS):
            client = stack.enter_context(socket.create_connection(("127.0.0.1", made.port), timeout=20))
            client.sendall(b"GET / HT")

        def served() -> bool:
            with contextlib.suppress(OSError, http.client.HTTPException):
                return Browser(made.port).ask("GET", "/")[0] == 200
            return False

        wait_until(served, "a browser is served although a crowd says nothing")


def test_a_page_whose_port_is_taken_says_so(station: Any, server: Callable[..., PageServer]) -> None:
    taken = server(10.0).port
    done = run("page", "--config", station.file, "--port", taken)
    assert done.returncode == 69
    assert f"127.0.0.1:{taken}" in done.stderr
