"""The page over HTTP: a few fixed files, the state as JSON, and one way to command. Standard library alone.

Limits. One request a connection, all of it within a deadline; so many connections, heads and bodies so long: a browser
that hangs, or a program that is none, costs a place for a while and nothing else.
"""

from __future__ import annotations

import contextlib
import logging
import socket
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from io import BufferedIOBase
from typing import Any

log = logging.getLogger(__name__)

CONNECTIONS = 32
DEADLINE_S = 10.0
HEAD_BYTES, BODY_BYTES = 16384, 4096

HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
    "connect-src 'self'; form-action 'none'; base-uri 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cache-Control": "no-store",
}
"""Of every answer: nothing but this page's own files is loaded, run or framed, and nothing is kept."""


@dataclass(frozen=True, slots=True)
class Request:
    """What came. ``headers`` by their names; ``hosts``: every Host header."""

    method: str
    path: str
    query: str
    headers: Mapping[str, str]
    hosts: tuple[str, ...]
    body: bytes = b""


@dataclass(frozen=True, slots=True)
class Reply:
    """What is answered."""

    body: bytes = b""
    kind: str = "text/plain; charset=utf-8"
    status: int = HTTPStatus.OK


Answers = Callable[[Request], Reply]


class PageServer(ThreadingHTTPServer):
    """Answers requests by ``answer`` until stopped. ``port`` 0 takes any free one. Raises OSError if it is taken."""

    daemon_threads = True
    request_queue_size = 64

    def __init__(self, host: str, port: int, answer: Answers, *, deadline_s: float = DEADLINE_S) -> None:
        self.address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self.answer, self._deadline_s = answer, deadline_s
        self._since_s: dict[socket.socket, float] = {}
        self._lock = threading.Lock()
        super().__init__((host, port), _Handler)

    @property
    def port(self) -> int:
        """The port listened on."""
        return int(self.server_address[1])

    def verify_request(self, request: Any, client_address: Any) -> bool:
        """Whether there is a place for this connection."""
        with self._lock:
            if len(self._since_s) >= CONNECTIONS:
                return False
            self._since_s[request] = time.monotonic()
            return True

    def shutdown_request(self, request: Any) -> None:
        """The connection ends, and gives its place back."""
        with self._lock:
            self._since_s.pop(request, None)
        super().shutdown_request(request)

    def service_actions(self) -> None:
        """Looked after regularly: who has not said or taken all in time is cut off."""
        now_s = time.monotonic()
        with self._lock:
            late = [request for request, since_s in self._since_s.items() if now_s > since_s + self._deadline_s]
        for request in late:
            with contextlib.suppress(OSError):
                request.shutdown(socket.SHUT_RDWR)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A client that went away is no news; a fault of the program's is."""
        log.debug("a request of %s broke off", client_address, exc_info=True)


class _Head:
    """Lines of a request's head, no more of them than HEAD_BYTES; then the body as it comes."""

    def __init__(self, stream: BufferedIOBase) -> None:
        self._stream, self._left = stream, HEAD_BYTES
        self.read, self.close = stream.read, stream.close

    @property
    def closed(self) -> bool:
        return self._stream.closed

    def readline(self, most: int = -1) -> bytes:
        line = self._stream.readline(min(most, self._left) if most >= 0 else self._left)
        self._left -= len(line)
        if self._left <= 0:
            raise ConnectionAbortedError("the request's head is too long")
        return line


class _Handler(BaseHTTPRequestHandler):
    """One request, one answer, and the connection ends."""

    server: PageServer
    timeout = DEADLINE_S
    server_version, sys_version = "inspector", ""

    def setup(self) -> None:
        super().setup()
        self.rfile = _Head(self.rfile)  # type: ignore[assignment]  # all that is asked of it is readline and read

    def do_GET(self) -> None:
        self._reply(self.server.answer(self._request("GET")))

    def do_POST(self) -> None:
        length = self.headers.get("Content-Length", "")
        if self.headers.get("Transfer-Encoding") or not (length.isascii() and length.isdigit() and len(length) < 9):
            self._reply(Reply(b"say Content-Length", status=HTTPStatus.LENGTH_REQUIRED))
        elif int(length) > BODY_BYTES:
            self._reply(Reply(b"too long", status=HTTPStatus.REQUEST_ENTITY_TOO_LARGE))
        else:
            body = self.rfile.read(int(length))
            self._reply(self.server.answer(self._request("POST", body)))

    def _request(self, method: str, body: bytes = b"") -> Request:
        path, _, query = self.path.partition("?")
        return Request(method, path, query, dict(self.headers.items()), tuple(self.headers.get_all("Host") or ()), body)

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """What the library refuses by itself, in the form of every other answer."""
        self._reply(Reply((message or HTTPStatus(code).phrase).encode(), status=code))

    def _reply(self, reply: Reply) -> None:
        if self.request_version == "HTTP/0.9":  # which knows no headers, and so nothing of what is forbidden
            return
        self.send_response(reply.status)
        for name, value in HEADERS.items():
            self.send_header(name, value)
        self.send_header("Content-Type", reply.kind)
        self.send_header("Content-Length", str(len(reply.body)))
        self.send_header("Connection", "close")
        self.end_headers()
        self.wfile.write(reply.body)
        self.close_connection = True

    def log_message(self, format: str, *args: object) -> None:
        log.debug("%s %s", self.client_address[0], format % args)
