"""The program's commands as processes that are forked from one that has imported them: each is there in a few
milliseconds of the processor's time, where `python -m inspector` takes most of a second. How it starts from nothing is
proved where that is the subject (house/test_start.py, line/test_service.py, deploy/)."""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection
from pathlib import Path
from typing import IO

CONTEXT = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload(
    [
        "inspector.__main__",
        "inspector.cli.app",
        "inspector.commands.calibrate",
        "inspector.commands.inspect_files",
        "inspector.hmi.serve",
        "inspector.journal_log",
        "inspector.service.daemon",
        "inspector.service.permissions",
        "inspector.service.serve",
        "inspector.service.settings_trial",
        "tests.support.forked",
        "tests.support.lives",
    ]
)


class Command:
    """An `inspector` command at work, in this process' folder and environment unless others are given; as
    `subprocess.Popen`, as far as tests need one. Its input is empty, its output text by pipes, or in a file."""

    def __init__(
        self, *arguments: object, cwd: Path | None = None, output: Path | None = None, **environment: str
    ) -> None:
        read_out, out = CONTEXT.Pipe(duplex=False)
        read_errors, errors = CONTEXT.Pipe(duplex=False)
        self.stdout, self.stderr = _text(read_out), _text(read_errors)
        words = tuple(map(str, arguments))
        given = (words, str(cwd or Path.cwd()), os.environ | environment, output or (out, errors))
        self._process = CONTEXT.Process(target=_carry_out, args=given, daemon=True)
        self._process.start()
        out.close()
        errors.close()
        assert self._process.pid is not None
        self.pid: int = self._process.pid

    def poll(self) -> int | None:
        """The exit status, None while it works; of a signal its number, negative."""
        return self._process.exitcode

    def wait(self, timeout: float) -> int:
        """The exit status, once it has ended. Raises TimeoutExpired."""
        self._process.join(timeout)
        status = self.poll()
        if status is None:
            raise subprocess.TimeoutExpired("inspector", timeout)
        return status

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        self._process.kill()


def run(*arguments: object, cwd: Path | None = None, timeout_s: float = 60) -> subprocess.CompletedProcess[str]:
    """A command carried out, as by `subprocess.run`. Raises TimeoutExpired."""
    command = Command(*arguments, cwd=cwd)
    with command.stdout, command.stderr, ThreadPoolExecutor(2) as readers:
        said = [readers.submit(stream.read) for stream in (command.stdout, command.stderr)]
        try:
            status = command.wait(timeout_s)
        finally:
            command.kill()
        return subprocess.CompletedProcess(arguments, status, *(text.result() for text in said))


def _text(connection: Connection) -> IO[str]:
    number = os.dup(connection.fileno())
    connection.close()
    return os.fdopen(number)


def _carry_out(
    arguments: tuple[str, ...], folder: str, environment: Mapping[str, str], output: Path | tuple[Connection, ...]
) -> None:
    """In the forked process: as if it had been started with these."""
    given = (output.open("ab"),) * 2 if isinstance(output, Path) else output
    for number, stream in enumerate(given, 1):
        os.dup2(stream.fileno(), number)
    for stream in given:
        stream.close()
    sys.stdout = os.fdopen(1, "w", closefd=False)
    sys.stderr = os.fdopen(2, "w", buffering=1, errors="backslashreplace", closefd=False)
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    sys.argv = ["inspector", *arguments]
    from inspector.__main__ import main

    main()
