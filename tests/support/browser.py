"""A browser at the operator's page."""

from __future__ import annotations

import contextlib
import http.client
import json
import threading
from typing import Any


class Browser:
    """Speaks HTTP to the page, as a browser that shows it would."""

    def __init__(self, port: int) -> None:
        self.port, self.own = port, f"127.0.0.1:{port}"
        self._pace = threading.Event()

    def ask(
        self, method: str, path: str, body: bytes | None = None, **headers: str
    ) -> tuple[int, dict[str, str], bytes]:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=20)
        with contextlib.closing(connection):
            told = {name.replace("_", "-"): value for name, value in headers.items()}
            connection.request(method, path, body, told)
            answer = connection.getresponse()
            return answer.status, dict(answer.getheaders()), answer.read()

    def state(self) -> dict[str, Any]:
        """The state, no oftener than a page asks: whoever waits for something leaves the processor to others."""
        self._pace.wait(0.1)
        status, _, body = self.ask("GET", "/api/state")
        assert status == 200
        return dict(json.loads(body))

    def command(self, name: str, argument: int = 0, **changed: str) -> tuple[int, dict[str, Any]]:
        """A command; headers that are ``changed`` to nothing are left out."""
        headers = {"Content_Type": "application/json", "Origin": f"http://{self.own}", "X_Page_Token": ""}
        if "X_Page_Token" not in changed:
            headers["X_Page_Token"] = self.state()["token"]
        headers = {name: value for name, value in (headers | changed).items() if value}
        body = json.dumps({"command": name, "argument": argument}).encode()
        status, _, told = self.ask("POST", "/api/command", body, **headers)
        return status, json.loads(told) if told.startswith(b"{") else {}
