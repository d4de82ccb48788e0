"""Who is let in at the page's door: right names only, and commands from this page alone, with its password.

A foreign page in the operator's browser can send requests here, but neither read an answer nor, with that, the token
that each command carries; a name that was made to point here (DNS rebinding) is none of ours.
"""

from __future__ import annotations

import base64
import hashlib
import hmac
import secrets
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

from firmware_bridge import whole_file
from inspector.publish.address import EVERYWHERE

LOCAL_NAMES = ("localhost", "127.0.0.1", "::1")
WRONG_TRIES, LOCKED_S = 5, 30.0
"""So many wrong passwords, and none is looked at for a while: enough for slips, too few to guess."""
_SCRYPT = {"n": 1 << 14, "r": 8, "p": 1}
LEAST_LETTERS = 4


class NoPassword(Exception):
    """The password file cannot be read, or is none."""


def host_of(header: str) -> str:
    """The name in a Host header, without its port, in lower case."""
    if header.startswith("["):
        return header[1:].partition("]")[0].lower()
    return header.partition(":")[0].lower()


class Gate:
    """The rules of one page. ``names``: what browsers may call it, besides this machine's own."""

    def __init__(
        self, names: Iterable[str], password_file: Path | None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._names = {*LOCAL_NAMES, *(name.lower() for name in names)} - set(EVERYWHERE)
        self.token = secrets.token_urlsafe(24)
        self.password_file, self._clock = password_file, clock
        self._lock, self._wrong, self._locked_until_s = threading.Lock(), 0, 0.0

    def admits_host(self, hosts: Sequence[str]) -> bool:
        """Whether a request's Host headers are one, and name this page."""
        return len(hosts) == 1 and host_of(hosts[0]) in self._names

    def is_own(self, headers: Mapping[str, str]) -> bool:
        """Whether a command comes from this page, as far as the browser says."""
        origin, host = headers.get("Origin"), headers.get("Host", "")
        if origin is not None and origin.partition("://")[2].lower() != host.lower():
            return False
        return headers.get("Sec-Fetch-Site", "same-origin") == "same-origin"

    def has_token(self, given: str) -> bool:
        """Whether the command carries what only a reader of this page knows."""
        return hmac.compare_digest(given.encode(), self.token.encode())

    def locked_s(self) -> float:
        """For how long no password is looked at, seconds; 0: one is."""
        return max(0.0, self._locked_until_s - self._clock())

    def is_password(self, given: str) -> bool:
        """Whether it is the password; one at a time, since it costs the processor something. Raises NoPassword."""
        with self._lock:
            if self.password_file is None:
                return True
            if self.locked_s():
                return False
            right = matches(self.password_file, given)
            self._wrong = 0 if right else self._wrong + 1
            if self._wrong >= WRONG_TRIES:
                self._wrong, self._locked_until_s = 0, self._clock() + LOCKED_S
            return right


def matches(file: Path, given: str) -> bool:
    """Whether the file was made of this password; it is read anew each time. Raises NoPassword."""
    try:
        kind, salt, kept = file.read_text().strip().split("$")
        if kind != "scrypt":
            raise ValueError(kind)
        made = _scrypt(given, base64.b64decode(salt, validate=True))
        return hmac.compare_digest(made, base64.b64decode(kept, validate=True))
    except (OSError, ValueError) as error:
        raise NoPassword(f"{file}: {error}; make it by: inspector page --set-password") from error


def keep(file: Path, password: str) -> None:
    """Write the password's file, for this user's eyes. Raises OSError, and ValueError for one too short."""
    if len(password) < LEAST_LETTERS:
        raise ValueError(f"a password has {LEAST_LETTERS} letters or more")
    salt = secrets.token_bytes(16)
    texts = (base64.b64encode(data).decode() for data in (salt, _scrypt(password, salt)))
    if not file.exists():
        file.touch(0o600)  # the mode that the whole file then keeps
    whole_file.write(file, "$".join(("scrypt", *texts)) + "\n")


def _scrypt(password: str, salt: bytes) -> bytes:
    return hashlib.scrypt(password.encode(), salt=salt, **_SCRYPT, dklen=32)
