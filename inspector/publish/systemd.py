"""What the service tells systemd (sd_notify(3)): a datagram to the socket that NOTIFY_SOCKET names."""

from __future__ import annotations

import contextlib
import os
import socket
import time
from collections.abc import Mapping

SEND_TIMEOUT_S = 0.5
"""A manager that is behind with its messages may hold up the cycle for so long."""

FEED_MARGIN_S = 5.0
"""The PLC is told of a cycle that is silent for too long so much earlier than the watchdog ends the service."""


class Notifier:
    """Speaks to systemd when it started us with Type=notify; says nothing otherwise. Never raises."""

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        address = environment.get("NOTIFY_SOCKET", "")
        # A name that begins with @ is in Linux's abstract namespace: its first byte is zero on the wire.
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._watchdog_s = _watchdog_s(environment)
        self._fed_at_s = float("-inf")
        self._status = ""

    def send(self, *lines: str) -> None:
        """Send assignments such as READY=1; lost if nobody listens, since systemd then asks no more of us."""
        if not self._address:
            return
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sock:
            sock.settimeout(SEND_TIMEOUT_S)
            with contextlib.suppress(OSError):
                sock.sendto("\n".join(lines).encode(), self._address)

    def status(self, text: str) -> None:
        """Show a line in ``systemctl status``; the same line again is not sent."""
        if text != self._status:
            self._status = text
            self.send(f"STATUS={text}")

    def reloading(self) -> None:
        """Say that settings are being read again; READY=1 ends it."""
        self.send("RELOADING=1", f"MONOTONIC_USEC={time.monotonic_ns() // 1000}")

    def allow_silence(self, silence_s: float) -> None:
        """Ask for a longer interval of the watchdog if the cycle may be silent for so long by its settings."""
        if self._watchdog_s is not None and self._watchdog_s < silence_s + FEED_MARGIN_S:
            self._watchdog_s = silence_s + FEED_MARGIN_S
            self.send(f"WATCHDOG_USEC={round(self._watchdog_s * 1e6)}")

    def feed_watchdog(self, now_s: float) -> None:
        """Tell the watchdog that the cycle lives: as often as called, sent four times in its interval."""
        if self._watchdog_s is not None and now_s - self._fed_at_s >= self._watchdog_s / 4:
            self._fed_at_s = now_s
            self.send("WATCHDOG=1")


def _watchdog_s(environment: Mapping[str, str]) -> float | None:
    """The interval within which systemd wants to hear of us, seconds; None if the watchdog is off or another's."""
    if environment.get("WATCHDOG_PID", str(os.getpid())) != str(os.getpid()):
        return None
    try:
        return int(environment["WATCHDOG_USEC"]) / 1e6
    except (KeyError, ValueError):
        return None
