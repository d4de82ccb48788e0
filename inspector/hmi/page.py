"""What the page answers to each request: its files, the station's state, the recipes, the map, and commands."""

from __future__ import annotations

import html
import json
import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from http import HTTPStatus
from importlib.resources import files
from typing import Any

from inspector.hmi import view
from inspector.hmi.commands import Deed
from inspector.hmi.gate import Gate, NoPassword
from inspector.hmi.known import Settled
from inspector.hmi.server import Reply, Request
from inspector.hmi.station import Away, Busy, StationLink
from inspector.hmi.texts import Texts

STATIC = {
    "/": ("page.html", "text/html; charset=utf-8"),
    "/page.css": ("page.css", "text/css; charset=utf-8"),
    "/page.js": ("page.js", "text/javascript; charset=utf-8"),
    "/icon.svg": ("icon.svg", "image/svg+xml"),
}
LARGEST_ARGUMENT = {Deed.CHANGE_RECIPE: 65535, Deed.RESET_STATISTICS: 1, Deed.CLEAR_FAULT: 0}


class Refusal(Exception):
    """A command is not passed on: the status, and the key of what people are told."""

    def __init__(self, status: HTTPStatus, key: str, **blanks: str) -> None:
        super().__init__(key)
        self.status, self.key, self.blanks = status, key, blanks


@dataclass(frozen=True, slots=True)
class Command:
    """What a browser asks for, read strictly."""

    deed: Deed
    argument: int
    password: str


class Page:
    """One station's page. Called by any thread."""

    def __init__(
        self,
        name: str,
        link: StationLink,
        settled: Settled,
        gate: Gate,
        texts: Texts,
        *,
        allow_commands: bool,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._name, self._link, self._settled, self._gate, self._texts = name, link, settled, gate, texts
        self._allow_commands, self._clock = allow_commands, clock
        folder = files("inspector.hmi") / "static"
        self._files = {path: ((folder / file).read_bytes(), kind) for path, (file, kind) in STATIC.items()}
        text, kind = self._files["/"]
        self._files["/"] = filled(text.decode(), {**texts, "station": name}).encode(), kind
        self._routes: dict[tuple[str, str], Callable[[Request], Reply]] = {
            ("GET", "/api/state"): self._state,
            ("GET", "/api/recipes"): self._recipes,
            ("GET", "/map.svg"): self._map,
            ("POST", "/api/command"): self._command,
        }

    def answer(self, request: Request) -> Reply:
        """The answer to a request; to one for another name than the page's, nothing of the page."""
        if not self._gate.admits_host(request.hosts):
            return Reply(b"no page of this name; see page.names", status=HTTPStatus.MISDIRECTED_REQUEST)
        if request.method == "GET" and request.path in self._files:
            return Reply(*self._files[request.path])
        route = self._routes.get((request.method, request.path))
        return route(request) if route else Reply(b"there is nothing here", status=HTTPStatus.NOT_FOUND)

    def _state(self, _: Request) -> Reply:
        tree = view.shown(self._link.look, self._settled.known, self._clock())
        commands = {"allowed": self._allow_commands, "password": self._gate.password_file is not None}
        return _json(tree | {"commands": commands, "token": self._gate.token})

    def _recipes(self, _: Request) -> Reply:
        self._settled.refresh()
        block = self._link.look.block
        used = block["recipe_id"] if block else None
        stale = self._texts["dialog.recipe.stale"].format(why=why) if (why := self._settled.why_stale) else ""
        recipes = [{"id": r.id, "name": r.name, "used": r.id == used} for r in self._settled.known.recipes]
        return _json({"recipes": recipes, "stale": stale})

    def _map(self, request: Request) -> Reply:
        """The map that is asked for by its key, or none: never another result's."""
        look = self._link.look
        if request.query != view.map_key(look) or (drawn := self._settled.drawn(look)) is None:
            return Reply(b"not the result that is shown", status=HTTPStatus.NOT_FOUND)
        return Reply(drawn.encode(), "image/svg+xml")

    def _command(self, request: Request) -> Reply:
        try:
            asked = self._admitted(request)
            done = self._link.ask(asked.deed, asked.argument)
        except Refusal as refusal:
            text = self._texts[refusal.key].format(**refusal.blanks)
            return _json({"refused": refusal.key.removeprefix("refusal."), "text": text}, refusal.status)
        except Busy:
            return _json({"refused": "busy", "text": self._texts["refusal.busy"]}, HTTPStatus.CONFLICT)
        except Away:
            return _json({"refused": "down", "text": self._texts["refusal.down"]}, HTTPStatus.SERVICE_UNAVAILABLE)
        return _json({"number": done.number}, HTTPStatus.ACCEPTED)

    def _admitted(self, request: Request) -> Command:
        """The command, from whom it may come from. Raises Refusal."""
        if not self._allow_commands:
            raise Refusal(HTTPStatus.FORBIDDEN, "refusal.disabled")
        if not self._gate.is_own(request.headers):
            raise Refusal(HTTPStatus.FORBIDDEN, "refusal.foreign")
        if not self._gate.has_token(request.headers.get("X-Page-Token", "")):
            raise Refusal(HTTPStatus.FORBIDDEN, "refusal.token")
        if request.headers.get("Content-Type", "").partition(";")[0].strip() != "application/json":
            raise Refusal(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, "refusal.wrong")
        command = _read(request.body)
        self._check_password(command.password)
        return command

    def _check_password(self, given: str) -> None:
        try:
            if self._gate.is_password(given):
                return
        except NoPassword:
            raise Refusal(HTTPStatus.SERVICE_UNAVAILABLE, "refusal.no_password") from None
        if locked_s := self._gate.locked_s():
            raise Refusal(HTTPStatus.TOO_MANY_REQUESTS, "refusal.locked", seconds=f"{locked_s:.0f}")
        raise Refusal(HTTPStatus.UNAUTHORIZED, "refusal.password")


def filled(template: str, texts: Texts) -> str:
    """The template with each {{key}} put in words. Raises KeyError for a key that there is no text for."""
    return re.sub(r"\{\{([\w.]+)\}\}", lambda found: html.escape(texts[found[1]]), template)


def _read(body: bytes) -> Command:
    """A command from JSON, strictly. Raises Refusal."""
    wrong = Refusal(HTTPStatus.BAD_REQUEST, "refusal.wrong")
    try:
        data: Any = json.loads(body)
    except (ValueError, RecursionError):
        raise wrong from None
    if not isinstance(data, dict) or not set(data) <= {"command", "argument", "password"}:
        raise wrong
    name, argument, password = data.get("command"), data.get("argument", 0), data.get("password", "")
    deed = next((deed for deed in Deed if deed.name == name), None)
    if deed is None or type(argument) is not int or type(password) is not str:
        raise wrong
    if not 0 <= argument <= LARGEST_ARGUMENT[deed]:
        raise wrong
    return Command(deed, argument, password)


def _json(tree: dict[str, Any], status: int = HTTPStatus.OK) -> Reply:
    return Reply(json.dumps(tree, ensure_ascii=False).encode(), "application/json", status)
