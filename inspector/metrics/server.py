"""The page of measured values over HTTP, from a thread of its own that the inspection never waits for.

Rules. A newcomer costs little and is looked at 50 times a second at most; a page is made five times a second at most,
whoever asks. A request has a size and a deadline, and one answer: the connection then closes. A port that is taken is
said once and tried again: a station inspects without it.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import socket
import threading
import time
from collections.abc import Callable
from http import HTTPStatus

from inspector.metrics import text
from inspector.metrics.settings import MetricsSettings
from inspector.metrics.table import Scrape
from inspector.outage import Outage
from inspector.publish.plc_access import Networks

log = logging.getLogger(__name__)

PATH = "/metrics"
REQUEST_BYTES = 8192
DEADLINE_S = 2.0
"""A client must have asked and taken its answer in this time."""
CONNECTIONS = 8
PAUSE_S = 0.02
MADE_EVERY_S = 0.2
RETRY_S = 5.0
STOP_DEADLINE_S = 3.0


class MetricsServer:
    """Serves what ``scrape`` tells, which must not wait. No method raises; any thread may call."""

    def __init__(self, settings: MetricsSettings, scrape: Callable[[], Scrape]) -> None:
        self._settings, self._scrape, self._allow = settings, scrape, Networks(settings.allow)
        self._loop = asyncio.new_event_loop()
        self._stop = asyncio.Event()
        self._clients: set[asyncio.Task[None]] = set()
        self._made, self._made_s = b"", -math.inf
        self._outage, self._making = Outage(f"metrics at {settings.host}:{settings.port}"), Outage("metrics page")
        self._thread = threading.Thread(target=self._run, name="metrics", daemon=True)

    def start(self) -> None:
        """Begin to serve."""
        self._thread.start()

    def stop(self) -> None:
        """Close port and connections."""
        if self._thread.is_alive():
            with contextlib.suppress(RuntimeError):  # it ends just now
                self._loop.call_soon_threadsafe(self._stop.set)
            self._thread.join(STOP_DEADLINE_S)

    def _run(self) -> None:
        try:
            self._loop.run_until_complete(self._until_stopped())
        finally:
            self._loop.close()

    async def _until_stopped(self) -> None:
        serving, stopping = asyncio.create_task(self._serve()), asyncio.create_task(self._stop.wait())
        await asyncio.wait((serving, stopping), return_when=asyncio.FIRST_COMPLETED)
        tasks = (serving, stopping, *self._clients)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    async def _serve(self) -> None:
        """Listen, again and again if need be."""
        while True:
            try:
                with self._listener() as listener:
                    await self._accept(listener)
            except Exception as error:
                self._outage.begins(
                    f"{error}; check metrics.host and metrics.port", traceback=not isinstance(error, OSError)
                )
            await asyncio.sleep(RETRY_S)

    def _listener(self) -> socket.socket:
        host, port = self._settings.host, self._settings.port
        listener = socket.create_server((host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET)
        listener.setblocking(False)
        self._outage.ends()
        log.info("metrics on http://%s:%d%s", host, listener.getsockname()[1], PATH)
        return listener

    async def _accept(self, listener: socket.socket) -> None:
        while True:
            client, peer = await self._loop.sock_accept(listener)
            if peer[0] in self._allow and len(self._clients) < CONNECTIONS:
                task = asyncio.create_task(self._attend(client))
                self._clients.add(task)
                task.add_done_callback(self._clients.discard)
            else:
                client.close()
            await asyncio.sleep(PAUSE_S)

    async def _attend(self, client: socket.socket) -> None:
        """One request, one answer; a client that is too slow or has gone is left."""
        with client, contextlib.suppress(OSError, TimeoutError):
            async with asyncio.timeout(DEADLINE_S):
                head = await self._head(client)
                if head:
                    await self._loop.sock_sendall(client, self._answer(head))
                    client.shutdown(socket.SHUT_WR)
                    while await self._loop.sock_recv(client, REQUEST_BYTES):
                        pass  # until it has seen the end: closing before would take back what it has not read

    async def _head(self, client: socket.socket) -> bytes:
        """A request up to its empty line, or more of it than is allowed; empty if the client goes before."""
        head = b""
        while b"\r\n\r\n" not in head and len(head) <= REQUEST_BYTES:
            data = await self._loop.sock_recv(client, REQUEST_BYTES)
            if not data:
                return b""
            head += data
        return head

    def _answer(self, head: bytes) -> bytes:
        status, body = self._answered(head)
        if status is not HTTPStatus.OK:
            body = f"{status.value} {status.phrase}; GET {PATH}\n".encode()
        lines = (
            f"HTTP/1.1 {status.value} {status.phrase}",
            f"Content-Type: {text.CONTENT_TYPE}",
            f"Content-Length: {len(body)}",
            "Connection: close",
            *(("Allow: GET, HEAD",) if status is HTTPStatus.METHOD_NOT_ALLOWED else ()),
        )
        told = b"" if head.startswith(b"HEAD ") else body
        return "\r\n".join((*lines, "", "")).encode() + told

    def _answered(self, head: bytes) -> tuple[HTTPStatus, bytes]:
        words = head.partition(b"\r\n")[0].split(b" ")
        if len(head) > REQUEST_BYTES:
            return HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE, b""
        if len(words) != 3 or not words[2].startswith(b"HTTP/1."):
            return HTTPStatus.BAD_REQUEST, b""
        if words[0] not in (b"GET", b"HEAD"):
            return HTTPStatus.METHOD_NOT_ALLOWED, b""
        if words[1].partition(b"?")[0] != PATH.encode():
            return HTTPStatus.NOT_FOUND, b""
        try:
            return HTTPStatus.OK, self._page()
        except Exception as error:
            self._making.begins(f"{type(error).__name__}: {error}", traceback=True)
            return HTTPStatus.INTERNAL_SERVER_ERROR, b""

    def _page(self) -> bytes:
        now_s = time.monotonic()
        if now_s >= self._made_s + MADE_EVERY_S:
            self._made, self._made_s = text.page(self._scrape()), now_s
            self._making.ends()
        return self._made
