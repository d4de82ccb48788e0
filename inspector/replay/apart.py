"""Work in a process of its own, forked for it: what crashes there, or is killed, costs nothing else and is known."""

from __future__ import annotations

import ctypes
import os
import signal
from collections.abc import Callable
from contextlib import suppress
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import NoReturn, TypeVar

Made = TypeVar("Made")

PR_SET_PDEATHSIG = 1
"""Option of prctl(2)."""


class Died(Exception):
    """The process ended without having done its work; the message says by what."""


def apart(work: Callable[[], Made], within_s: float) -> Made:
    """What ``work`` makes, which must be picklable. Raises Died, also where it takes longer."""
    ours, theirs = Pipe(duplex=False)
    child = os.fork()
    if child == 0:
        _do(work, theirs)
    theirs.close()
    try:
        if ours.poll(within_s):
            return ours.recv()  # type: ignore[no-any-return]  # what the other end made
        raise Died(f"not done within {within_s:g} s")
    except EOFError:
        pass
    finally:
        ours.close()
        os.kill(child, signal.SIGKILL)  # not waited for yet, so the number is still its
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    raise Died(f"killed by {signal.Signals(-status).name}" if status < 0 else f"exit status {status}")


def _do(work: Callable[[], object], result: Connection) -> NoReturn:
    """In the child, which ends here, and with the one that waits for it."""
    status = 1
    with suppress(BaseException):
        with suppress(AttributeError):  # another C library
            ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        result.send(work())
        status = 0
    os._exit(status)
