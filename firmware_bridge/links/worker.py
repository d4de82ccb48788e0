"""A thread for calls that may outlast their deadline: whoever asked goes on, and the thread ends by itself."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future
from queue import SimpleQueue
from typing import Any, TypeVar

ResultT = TypeVar("ResultT")


class Worker:
    """One thread that does what it is asked, in order, until :meth:`end`.

    The thread does not keep the program from ending. Waiting for it leaves signals their turn, as a foreign library's
    own wait would not.
    """

    def __init__(self, name: str) -> None:
        self._jobs: SimpleQueue[tuple[Future[Any], Callable[[], Any]] | None] = SimpleQueue()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def call(self, work: Callable[[], ResultT], deadline_s: float) -> ResultT:
        """What ``work`` returns or raises. Raises TimeoutError after the deadline; the work goes on."""
        future: Future[ResultT] = Future()
        self._jobs.put((future, work))
        return future.result(deadline_s)

    def end(self, last: Callable[[], None], wait_s: float) -> None:
        """Do ``last`` after what was asked, then end; waits for that so long at most."""
        self._jobs.put((Future(), last))
        self._jobs.put(None)
        self._thread.join(wait_s)

    @property
    def lives(self) -> bool:
        """Whether the thread has not ended yet."""
        return self._thread.is_alive()

    def _run(self) -> None:
        while job := self._jobs.get():
            future, work = job
            try:
                future.set_result(work())
            except BaseException as error:  # it belongs to whoever asked
                future.set_exception(error)
            del job, future, work  # nothing is kept alive while there is nothing to do
