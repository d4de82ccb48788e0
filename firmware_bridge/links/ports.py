"""Byte streams to devices: serial lines and TCP connections. Opened here and nowhere else.

Every call returns or raises within the time it is given. A port that vanishes raises DeviceGone; it is then closed
and opened again, under the same name, as a new one.
"""

from __future__ import annotations

import contextlib
import errno
import os
import select
import socket
import termios
import time
from collections.abc import Callable
from typing import Protocol

from firmware_bridge.errors import DeviceGone, NoReply

READ_BYTES = 4096

SETTLE_READS = 16
"""A line that after so many looks still has something to say is never quiet."""

_IN_USE = "another program has it open: end that first (the service: systemctl stop inspector)"

QUIET_CHARACTERS, CHARACTER_BITS, QUIET_LEAST_S = 3.5, 11, 0.00175
"""The pause between RTU frames (MODBUS over Serial Line V1.02, 2.5.1.1); a module may miss a request before its end."""


class _Opened(Protocol):
    """What is behind a port: a serial.Serial or a socket."""

    def fileno(self) -> int: ...
    def close(self) -> None: ...


def _nothing() -> None:
    """Nobody waits for the port to be closed."""


class Port:
    """An open byte stream. ``name`` is the port's or the peer's; it goes into every error.

    ``quiet_s`` is the pause by which the line tells messages apart, seconds. ``after_close`` is called once, when
    it is closed: whoever made the other end takes it away then.
    """

    def __init__(
        self,
        device: str,
        name: str,
        opened: _Opened,
        *,
        quiet_s: float = 0.0,
        after_close: Callable[[], None] = _nothing,
    ) -> None:
        self._device, self.name, self._opened = device, name, opened
        self._quiet_s, self._after_close = quiet_s, after_close
        self._heard_s = time.monotonic()
        self._fd = opened.fileno()
        os.set_blocking(self._fd, False)
        self._readable, self._writable = select.poll(), select.poll()
        self._readable.register(self._fd, select.POLLIN)
        self._writable.register(self._fd, select.POLLOUT)

    def read(self, timeout_s: float) -> bytes:
        """What has come, at least one byte; empty if nothing came in time. Raises DeviceGone."""
        if self._fd < 0:
            raise self._gone("is closed")
        if not self._readable.poll(max(timeout_s, 0.0) * 1000):
            return b""
        try:
            data = os.read(self._fd, READ_BYTES)
        except BlockingIOError:
            return b""
        except OSError as error:
            raise self._gone(reason(error)) from error
        if not data:
            raise self._gone("closed by the other side")
        self._heard_s = time.monotonic()
        return data

    def write(self, data: bytes, timeout_s: float) -> None:
        """Send all of it. Raises DeviceGone, or NoReply if the other side does not take it in time."""
        if self._fd < 0:
            raise self._gone("is closed")
        until_s = time.monotonic() + timeout_s
        rest = memoryview(data)
        while rest:
            if not self._writable.poll(max(until_s - time.monotonic(), 0.0) * 1000):
                raise NoReply(self._device, f"{self.name} takes no data", "check the line's other end")
            try:
                rest = rest[os.write(self._fd, rest) :]
            except BlockingIOError:
                continue
            except OSError as error:
                raise self._gone(reason(error)) from error

    def settle(self) -> None:
        """Throw away what has come, and wait until the line was quiet for ``quiet_s``. Raises DeviceGone.

        On a line that is never quiet this ends too: what comes then is no answer, and is found to be none.
        """
        for _ in range(SETTLE_READS):
            if not self.read(self._heard_s + self._quiet_s - time.monotonic()):
                break

    def discard(self, for_s: float) -> None:
        """Throw away whatever comes within this time; nothing to do if it is not above 0. Raises DeviceGone."""
        until_s = time.monotonic() + for_s
        while (left_s := until_s - time.monotonic()) > 0:
            self.read(left_s)

    def close(self) -> None:
        """Close; may be called twice, never raises. What nobody took is dropped: the kernel would wait for it."""
        if self._fd < 0:
            return
        with contextlib.suppress(termios.error):  # not a terminal, or gone
            termios.tcflush(self._fd, termios.TCOFLUSH)
        self._fd = -1
        with contextlib.suppress(OSError):
            self._opened.close()
        self._after_close()

    def _gone(self, why: str) -> DeviceGone:
        return DeviceGone(self._device, f"{self.name}: {why}", "check its cable and power")


PortOpener = Callable[[], Port]
"""Opens a port, or raises DeviceGone saying why it cannot."""


def open_serial(
    device: str,
    port: str,
    *,
    baud: int = 9600,
    parity: str = "N",
    stop_bits: int = 1,
    after_close: Callable[[], None] = _nothing,
) -> Port:
    """A serial line, 8 data bits, locked exclusively (flock): two owners would read each other's answers.

    Raises DeviceGone.
    """
    import serial  # only stations with a serial line pay for it

    try:
        opened = serial.Serial(port, baud, parity=parity, stopbits=stop_bits, timeout=0, exclusive=True)
    except (OSError, ValueError, termios.error) as error:  # pyserial's own SerialException is an OSError
        raise DeviceGone(device, f"cannot open {port}: {reason(error)}", _serial_remedy(error)) from error
    quiet_s = max(QUIET_CHARACTERS * CHARACTER_BITS / baud, QUIET_LEAST_S)
    return Port(device, port, opened, quiet_s=quiet_s, after_close=after_close)


def open_tcp_unit(device: str, host: str, port: int, unit: int, timeout_s: float) -> Port:
    """A TCP connection to one Modbus unit, locked exclusively on this machine. Raises DeviceGone."""
    held = _claim(device, f"{host}:{port} unit {unit}")
    try:
        return open_tcp(device, host, port, timeout_s, after_close=held.close)
    except DeviceGone:
        held.close()
        raise


def _claim(device: str, name: str) -> socket.socket:
    """Make ``name`` this process' own until the socket returned is closed, as flock does for a serial line.

    A socket in Linux' abstract namespace: it is no file, and goes with its process however that ends. Raises
    DeviceGone if another has it.
    """
    held = socket.socket(socket.AF_UNIX)
    try:
        held.bind(f"\0firmware_bridge/{name}")
    except OSError as error:
        held.close()
        raise DeviceGone(device, f"cannot open {name}: {reason(error)}", _IN_USE) from error
    return held


def open_tcp(device: str, host: str, port: int, timeout_s: float, after_close: Callable[[], None] = _nothing) -> Port:
    """A TCP connection. Raises DeviceGone."""
    name = f"{host}:{port}"
    try:
        opened = socket.create_connection((host, port), timeout=timeout_s)
    except OSError as error:
        what = f"cannot connect to {name}: {reason(error)}"
        raise DeviceGone(device, what, "check address, cable and power") from error
    opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return Port(device, name, opened, after_close=after_close)


def reason(error: BaseException) -> str:
    """The system's own words for an error, without the path and number that pyserial repeats."""
    number = getattr(error, "errno", None)
    return os.strerror(number) if isinstance(number, int) and number > 0 else str(error)


def _serial_remedy(error: BaseException) -> str:
    number = getattr(error, "errno", None)
    if number == errno.ENOENT:
        return "check the adapter's cable; name it by /dev/serial/by-id"
    if number == errno.EACCES:
        return "let the service's user open it (group dialout)"
    if number in (errno.EAGAIN, errno.EBUSY):
        return _IN_USE
    return "check the port's name and the adapter"
