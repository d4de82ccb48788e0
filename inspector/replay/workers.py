"""Work shared among this machine's cores, each a process; a process that dies costs what it was at, done once more."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import partial
from itertools import islice
from multiprocessing.connection import Connection
from typing import TypeVar

from inspector import heap

Task = TypeVar("Task")
Made = TypeVar("Made")

TRIES = 3
"""So often may processes die with nothing done in between, before the work is given up."""


class WorkersDied(RuntimeError):
    """Processes died again and again; the message says what may be behind it."""


def cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0))


def share(
    work: Callable[[Task, bool], Made], tasks: Sequence[tuple[int, Task]], jobs: int
) -> Iterator[tuple[int, Made]]:
    """What ``work`` makes of each numbered task, as soon as it is there, in any order. ``work`` must be picklable.

    It is told, by its second argument, whether a process died that may have been at the task: what killed it is then to
    be kept from doing so again. One job is done in this process. Raises WorkersDied, and what ``work`` raises.
    """
    if jobs == 1:
        _begin()
        for number, task in tasks:
            yield number, work(task, False)
        return
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([getattr(work, "func", work).__module__])
    alive, _ours = context.Pipe(duplex=False)  # closed with this process, however it ends
    left, suspects, in_vain = dict(tasks), set[int](), 0
    while left:
        under_way: dict[Future[Made], int] = {}
        with ProcessPoolExecutor(min(jobs, len(left)), context, _begin_process, (alive,)) as pool:
            calls = ((number, partial(work, task, number in suspects)) for number, task in list(left.items()))
            try:
                for number, made in _made(pool, calls, jobs + 1, under_way):
                    del left[number]
                    in_vain = 0
                    yield number, made
            except BrokenProcessPool as error:
                suspects.update(under_way.values())
                in_vain += 1
                if in_vain == TRIES:
                    raise WorkersDied(DIED) from error
            finally:
                pool.shutdown(wait=False, cancel_futures=True)


DIED = "processes die at their work: see the kernel's log for out of memory, try fewer (--jobs)"


def _made(
    pool: ProcessPoolExecutor,
    calls: Iterator[tuple[int, Callable[[], Made]]],
    most: int,
    under_way: dict[Future[Made], int],
) -> Iterator[tuple[int, Made]]:
    """What the numbered calls make; no more than ``most`` are ``under_way``: a process can have died at these only."""
    while True:
        for number, call in islice(calls, most - len(under_way)):
            under_way[pool.submit(call)] = number
        if not under_way:
            return
        for future in wait(under_way, return_when=FIRST_COMPLETED).done:
            made = future.result()
            yield under_way.pop(future), made


def _begin_process(alive: Connection) -> None:
    """Ctrl-C is for the one that shares the work out; and when that one is gone, nobody wants the work."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(alive,), daemon=True).start()
    _begin()


def _end_with(alive: Connection) -> None:
    alive.poll(None)
    os._exit(1)


def _begin() -> None:
    """One thread in each process, they are as many as the cores already."""
    import cv2

    cv2.setNumThreads(1)
    heap.keep_for_the_next_frame()


@contextmanager
def progress(what: str, parts: int, count: int, done: int) -> Iterator[Callable[[int], None]]:
    """A bar on stderr, where that is a terminal; ``count`` of ``what`` in ``done`` parts are there already. Call what
    this gives with the count of each further part."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    columns = (BarColumn(), TextColumn("{task.percentage:.0f} %  {task.fields[count]} " + what), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(what, total=parts, completed=done, count=count)

        def advance(further: int) -> None:
            bar.update(task, advance=1, count=bar.tasks[0].fields["count"] + further)

        yield advance
