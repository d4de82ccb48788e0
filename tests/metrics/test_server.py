"""The page over HTTP: who may ask, how, how long it may take; and what a client cannot do to the others."""

from __future__ import annotations

import contextlib
import http.client
import logging
import re
import socket
import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from inspector.metrics import server
from inspector.metrics.server import MetricsServer
from inspector.metrics.table import Scrape

GET = b"GET /metrics HTTP/1.1\r\nHost: station\r\n\r\n"


@pytest.fixture
def port(caplog: pytest.LogCaptureFixture, wait_until: Callable[..., Any]) -> Callable[[], int]:
    """``port()``: what the log says is listened on."""
    caplog.set_level(logging.INFO)

    def said() -> str | None:
        return next((found[1] for r in caplog.records if (found := re.search(r":(\d+)/metrics", r.getMessage()))), None)

    return lambda: int(wait_until(said, "a port"))


def ask(port: int, request: bytes) -> bytes:
    """All that comes back until the station closes."""
    with socket.create_connection(("127.0.0.1", port), timeout=20) as client:
        client.sendall(request)
        return rest(client)


def rest(client: socket.socket) -> bytes:
    return b"".join(iter(lambda: client.recv(65536), b""))


def status(answer: bytes) -> int:
    return int(answer.split(b" ")[1])


def test_a_usual_client_gets_the_page(serving: Callable[..., MetricsServer], port: Callable[[], int]) -> None:
    serving()
    client = http.client.HTTPConnection("127.0.0.1", port(), timeout=20)
    client.request("GET", "/metrics?collect[]=x", headers={"Accept": "application/openmetrics-text"})
    answer = client.getresponse()
    page = answer.read()
    client.close()
    assert (answer.status, len(page)) == (200, int(answer.headers["Content-Length"]))
    assert answer.headers["Content-Type"].startswith("text/plain; version=0.0.4")
    assert b'\ninspector_results_total{verdict="PASS"} 60000.0\n' in page


@pytest.mark.parametrize(("request_", "wanted"), [
    (GET, 200),
    (b"GET / HTTP/1.0\r\n\r\n", 404),
    (b"POST /metrics HTTP/1.1\r\nContent-Length: 3\r\n\r\nabc", 405),
    (b"\x00\x01\x00\x00\x00\x06\x01\x03\x00\x00\x00\x01\r\n\r\n", 400),
    (b"GET /metrics\r\n\r\n", 400),
    (b"GET /metrics HTTP/1.1\r\nX: " + b"x" * server.REQUEST_BYTES, 431),
])  # fmt: skip
def test_every_request_has_its_answer(
    request_: bytes, wanted: int, serving: Callable[..., MetricsServer], port: Callable[[], int]
) -> None:
    serving()
    assert status(ask(port(), request_)) == wanted


def test_head_tells_the_size_alone(serving: Callable[..., MetricsServer], port: Callable[[], int]) -> None:
    serving()
    head, _, body = ask(port(), GET.replace(b"GET", b"HEAD")).partition(b"\r\n\r\n")
    assert (status(head), body) == (200, b"")
    assert int(re.search(rb"Content-Length: (\d+)", head)[1]) > 1000


def test_strangers_are_not_heard(serving: Callable[..., MetricsServer], port: Callable[[], int]) -> None:
    serving(allow=("192.0.2.0/24",))
    heard = b""
    with contextlib.suppress(ConnectionResetError):
        heard = ask(port(), GET)
    assert heard == b""


def test_clients_that_say_nothing_are_closed_and_others_served(
    serving: Callable[..., MetricsServer], port: Callable[[], int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "DEADLINE_S", 0.5)
    serving()
    silent = [socket.create_connection(("127.0.0.1", port()), timeout=20) for _ in range(server.CONNECTIONS - 1)]
    silent[0].sendall(b"GET /metr")
    assert status(ask(port(), GET)) == 200
    for client in silent:
        with client:
            assert client.recv(1) == b""


def test_a_full_house_turns_newcomers_away_until_a_place_is_free(
    serving: Callable[..., MetricsServer],
    port: Callable[[], int],
    wait_until: Callable[..., Any],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(server, "DEADLINE_S", 60.0)
    serving()
    silent = [socket.create_connection(("127.0.0.1", port()), timeout=20) for _ in range(server.CONNECTIONS)]
    for client in silent:
        client.sendall(GET[:-2])
    with socket.create_connection(("127.0.0.1", port()), timeout=20) as late:
        assert late.recv(1) == b""
    for client in silent:
        client.sendall(GET[-2:])
        with client:
            assert status(rest(client)) == 200
    wait_until(lambda: ask(port(), GET), "a place")


@pytest.fixture
def taken_port() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as other:
        yield other


def test_a_port_that_is_taken_is_said_once_and_had_when_it_is_free(
    serving: Callable[..., MetricsServer],
    port: Callable[[], int],
    taken_port: socket.socket,
    caplog: pytest.LogCaptureFixture,
    wait_until: Callable[..., Any],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tries = threading.Semaphore(0)
    listening = MetricsServer._listener

    def listener(self: MetricsServer) -> socket.socket:
        tries.release()
        return listening(self)

    monkeypatch.setattr(MetricsServer, "_listener", listener)
    monkeypatch.setattr(server, "RETRY_S", 0.01)
    serving(port=taken_port.getsockname()[1])
    for _ in range(3):
        assert tries.acquire(timeout=20)
    taken_port.close()
    assert status(ask(port(), GET)) == 200
    assert [r.levelname for r in caplog.records if "metrics at 127.0.0.1" in r.getMessage()] == ["ERROR", "INFO"]


def test_an_error_in_the_program_is_an_answer_and_said_once(
    serving: Callable[..., MetricsServer], port: Callable[[], int], caplog: pytest.LogCaptureFixture
) -> None:
    def fails() -> Scrape:
        raise ZeroDivisionError("a bug")

    serving(fails)
    assert [status(ask(port(), GET)) for _ in range(2)] == [500, 500]
    assert len([r for r in caplog.records if "metrics page fails: ZeroDivisionError: a bug" in r.getMessage()]) == 1


def test_a_page_is_not_made_more_often_than_is_useful(
    serving: Callable[..., MetricsServer], port: Callable[[], int], scrape: Scrape, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = []

    def scraped() -> Scrape:
        made.append(scrape)
        return scrape

    monkeypatch.setattr(server, "MADE_EVERY_S", 3600.0)
    serving(scraped)
    pages = {ask(port(), GET) for _ in range(3)}
    assert (len(made), len(pages)) == (1, 1)
