"""Log lines into systemd's journal by its native protocol: one datagram a line, with fields that can be searched.

    journalctl -t inspector FAULT_CODE=301
    journalctl -t inspector DEVICE=camera -o json

Each field is NAME=value and a newline; of a value with newlines NAME, a newline, its length in 64 bits, little-endian,
and its bytes. The cycle is never held up: what the journal does not take at once is lost, counted, and said once it
takes lines again. Source: systemd.io/JOURNAL_NATIVE_PROTOCOL.
"""

from __future__ import annotations

import contextlib
import logging
import os
import socket
import struct
from collections.abc import Mapping

SOCKET = "/run/systemd/journal/socket"
IDENTIFIER = "inspector"
VALUE_BYTES = 48 * 1024
"""What is longer is cut and says so, so that every entry fits a datagram (its fields beside the message are short)."""
IDS = ("panel_id", "sequence", "frame_id", "recipe_id", "fault_code", "device", "verdict")
"""What a line may say it is about: given as ``extra`` to the logger, a field of the same name in the journal."""

_PRIORITIES = ((logging.ERROR + 1, 2), (logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6))
"""Least level of a record, and its priority as in syslog(3)."""


def leads_to_journal(fd: int, environment: Mapping[str, str] = os.environ) -> bool:
    """Whether what is written there ends in the journal: systemd names that stream in JOURNAL_STREAM."""
    with contextlib.suppress(OSError):
        found = os.fstat(fd)
        return environment.get("JOURNAL_STREAM") == f"{found.st_dev}:{found.st_ino}"
    return False


def ids_of(record: logging.LogRecord) -> dict[str, object]:
    """What the record says it is about."""
    return {name: value for name in IDS if (value := getattr(record, name, None)) is not None}


class TextFormatter(logging.Formatter):
    """One line of text, with what it is about behind it."""

    def formatMessage(self, record: logging.LogRecord) -> str:
        ids = " ".join(f"{name}={_text(value)}" for name, value in ids_of(record).items())
        return super().formatMessage(record) + (f"  [{ids}]" if ids else "")


class JournalHandler(logging.Handler):
    """Sends records to the journal's socket at ``address``. Never blocks, never raises."""

    def __init__(self, address: str) -> None:
        super().__init__()
        self.setFormatter(logging.Formatter("%(message)s"))
        self._address = address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK)
        self.lost = 0
        """Lines that the journal did not take."""
        self._said = 0

    def emit(self, record: logging.LogRecord) -> None:
        """See logging.Handler."""
        try:
            self._say_lost()
            self._send(self.entry(record))
        except Exception:  # it cannot be told to anybody
            self.lost += 1

    def entry(self, record: logging.LogRecord) -> bytes:
        """The record as a datagram."""
        fields: dict[str, object] = {
            "MESSAGE": self.format(record),
            "PRIORITY": next((priority for least, priority in _PRIORITIES if record.levelno >= least), 7),
            "CODE_FILE": record.pathname,
            "CODE_LINE": record.lineno,
            "CODE_FUNC": record.funcName,
            "LOGGER": record.name,
            "THREAD_NAME": record.threadName,
        }
        return encoded(fields | {name.upper(): value for name, value in ids_of(record).items()})

    def close(self) -> None:
        """See logging.Handler."""
        self._socket.close()
        super().close()

    def _say_lost(self) -> None:
        lost = self.lost
        if lost > self._said:
            message = f"lines of the log lost: {lost - self._said}, which the journal did not take"
            self._send(encoded({"MESSAGE": message, "PRIORITY": 4}))
            self._said = lost

    def _send(self, datagram: bytes) -> None:
        self._socket.sendto(datagram, self._address)  # by name each time: a journal that starts again has a new socket


def encoded(fields: Mapping[str, object]) -> bytes:
    """Fields of one entry, as the journal reads them."""
    named = {"SYSLOG_IDENTIFIER": IDENTIFIER, "SYSLOG_PID": os.getpid(), **fields}
    return b"".join(_field(name.encode(), _cut(_text(value))) for name, value in named.items())


def _field(name: bytes, value: bytes) -> bytes:
    if b"\n" in value:
        return name + b"\n" + struct.pack("<Q", len(value)) + value + b"\n"
    return name + b"=" + value + b"\n"


def _cut(text: str) -> bytes:
    value = text.encode("utf-8", "backslashreplace")
    if len(value) <= VALUE_BYTES:
        return value
    kept = value[:VALUE_BYTES].decode("utf-8", "ignore").encode()
    return kept + f"... ({len(value) - len(kept)} bytes more)".encode()


def _text(value: object) -> str:
    """Codes as numbers, everything else as it is."""
    return str(int(value)) if isinstance(value, int) else str(value)
