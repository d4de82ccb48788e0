"""What every simulated device has: a pseudo-terminal with a name, a loop that serves it, and an end."""

from __future__ import annotations

import contextlib
import os
import selectors
import signal
import sys
import threading
import tty
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Self

SILENCE_S = 0.05
"""A pause in which an unfinished message is given up. A real line's is shorter; relays between ptys are slower."""

READ_BYTES = 4096


class Server:
    """A loop over file descriptors. Serve in a thread (:meth:`start`, :meth:`stop`) or in this one (:meth:`serve`).

    ``address`` is what the other side opens. What is added to ``cleanup`` is done at the end.
    """

    address: str

    def __init__(self) -> None:
        self.cleanup = contextlib.ExitStack()
        self._selector = selectors.DefaultSelector()
        self._stop_fd, self._stopping_fd = os.pipe()
        self.cleanup.callback(os.close, self._stop_fd)
        self.cleanup.callback(os.close, self._stopping_fd)
        self.cleanup.callback(self._selector.close)
        self._when_silent: Callable[[], None] | None = None
        self._thread: threading.Thread | None = None

    def start(self) -> Self:
        """Serve in a thread of its own."""
        self._thread = threading.Thread(target=self.serve, name="simulator", daemon=True)
        self._thread.start()
        return self

    def stop(self) -> None:
        """Stop serving and take everything away: for the other side, the cable is pulled. May be called twice."""
        if self._thread:
            os.write(self._stopping_fd, b"x")
            self._thread.join()
            self._thread = None
        self.cleanup.close()

    def serve(self, until_closed_fd: int | None = None) -> None:
        """Answer until :meth:`stop`, or until the other end of ``until_closed_fd`` is closed."""
        self._selector.register(self._stop_fd, selectors.EVENT_READ, lambda: True)
        if until_closed_fd is not None:
            self._selector.register(until_closed_fd, selectors.EVENT_READ, lambda: not os.read(until_closed_fd, 512))
        done = False
        while not done:
            ready = self._selector.select(SILENCE_S if self._when_silent else None)
            if not ready and self._when_silent:
                self._when_silent()
                self._when_silent = None
            done = any(key.data() for key, _ in ready)

    def open_terminal(
        self, receive: Callable[[bytes], object], symlink: Path | None = None, silence: Callable[[], None] | None = None
    ) -> tuple[str, Callable[[bytes], object]]:
        """A raw pseudo-terminal: its path, and what sends bytes through it.

        ``receive`` is given what comes, ``silence`` is called once when nothing more came for a while. ``symlink`` is
        made to point at it, and taken away at the end. Raises FileExistsError if it is a file's name.
        """
        master, slave = os.openpty()
        # The slave side stays open here: while nobody has it open, reading the master fails.
        self.cleanup.callback(os.close, master)
        self.cleanup.callback(os.close, slave)
        tty.setraw(slave)
        os.set_blocking(master, False)
        path = os.ttyname(slave)
        if symlink:
            _point(symlink, path)
            self.cleanup.callback(_unpoint, symlink, path)

        def readable() -> bool:
            with contextlib.suppress(OSError):
                receive(os.read(master, READ_BYTES))
            self._when_silent = silence
            return False

        self._selector.register(master, selectors.EVENT_READ, readable)
        return path, lambda data: os.write(master, data)

    def wait(self, timeout_s: float) -> None:
        """Keep the other side waiting; :meth:`stop` ends that."""
        with selectors.DefaultSelector() as selector:
            selector.register(self._stop_fd, selectors.EVENT_READ)
            selector.select(timeout_s)


def run(server: Server, *, with_parent: bool) -> None:
    """Print the address and serve until SIGTERM or SIGINT, or (``with_parent``) until standard input is closed."""
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, _end)
    try:
        print(server.address, flush=True)
        server.serve(sys.stdin.fileno() if with_parent else None)
    finally:
        server.stop()


def _end(number: int, frame: FrameType | None) -> None:
    raise SystemExit(0)


def _point(symlink: Path, target: str) -> None:
    """Make or move the link in one step; what is not a link is left alone. Raises FileExistsError."""
    if symlink.exists() and not symlink.is_symlink():
        raise FileExistsError(f"{symlink} is in the way and is not a symbolic link: give another name")
    fresh = symlink.with_name(f".{symlink.name}.{os.getpid()}")
    fresh.symlink_to(target)
    fresh.replace(symlink)


def _unpoint(symlink: Path, target: str) -> None:
    """Take the link away, unless it is another's by now."""
    with contextlib.suppress(OSError):
        if os.readlink(symlink) == target:
            symlink.unlink()
