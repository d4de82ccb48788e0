"""What `inspector reinspect` does: a whole archive inspected again, on this machine's cores or on a Dask cluster.

The archive is cut into partitions, which follow from its indices alone. Of each, two files are written whole, the
frames' last, by the one that shares the work out: a run that was interrupted makes those that are not there yet.
"""

from __future__ import annotations

import json
import shutil
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from firmware_bridge import whole_file
from inspector.change_options import Asked, Unusable, change_of
from inspector.reinspection import Change
from inspector.replay import workers
from inspector.replay.apart import Died, apart
from inspector.replay.command import AS_IT_WAS, NOTHING_DONE, SOME_NOT
from inspector.replay.comparison import Comparing
from inspector.replay.plan import Part, Plan
from inspector.replay.state import program, program_release
from inspector.replay.tables import COUNTS, Written, written
from inspector.replay.workers import WorkersDied

PARTITION_BYTES = 1 << 20
"""An index is shared out in partitions of this size: some eight hundred frames, three seconds' work."""
PARTITION_WITHIN_S = 3600.0
VERSION = 1
NO_EXTRA = "reinspect needs pyarrow, and dask on a cluster: pip install 'seed-inspector[cluster]'"
WORKERS_WITHIN_S = 60
RETRIES = 3

Task = tuple[int, Part]
Work = Callable[[Part, bool], Written]
Sharing = Callable[[Work, Sequence[Task]], Iterator[tuple[int, Written]]]


def run(
    archive: Path,
    asked: Asked,
    output: Path,
    scheduler: str | None = None,
    jobs: int | None = None,
    partition_bytes: int = PARTITION_BYTES,
) -> int:
    """Inspect all of the archive's frames again and write the tables; the exit status. ``jobs`` is for this machine."""
    try:
        change = change_of(asked)
        folder = _Folder(output, archive, change, partition_bytes)
        work = partial(examine, change=change, root=str(archive.resolve()))
        sharing: Sharing = partial(_on_cluster, scheduler) if scheduler else partial(_here, jobs or workers.cores())
        _make(folder, work, sharing)
        counted = folder.counts()
        folder.finish()
    except ImportError as error:
        return _refused(f"{NO_EXTRA} ({error})")
    except (Unusable, WorkersDied) as error:
        return _refused(str(error))
    except OSError as error:
        return _refused(f"{error.filename or output}: {error.strerror or error}")
    print(_told(counted, output))
    if not counted["frames"]:
        return _refused("no frame could be compared")
    differ = counted["frames"] - counted["frames_same"] + counted["panels"] - counted["panels_same"]
    return SOME_NOT if counted["not_compared"] or (differ and not asked.anything) else AS_IT_WAS


def _refused(why: str) -> int:
    print(f"inspector: {why}", file=sys.stderr)
    return NOTHING_DONE


def _told(counted: Counter[str], output: Path) -> str:
    lines = [
        f"{counted[of]} {what} compared: {counted[of + '_same']} the same to the last bit, "
        f"{counted[of] - counted[of + '_same']} differ"
        for of, what in (("frames", "frames"), ("panels", "panels of several frames"))
    ]
    return "\n".join([*lines, f"{counted['not_compared']} not compared; all in {output}"])


def examine(part: Part, careful: bool, change: Change, root: str) -> Written:
    """The tables of one partition, in whatever process of whatever machine; ``careful`` where one died at it.

    It is inspected in a process of its own, so that a frame that crashes it costs no worker; then frame by frame.
    """
    import cv2

    cv2.setNumThreads(1)
    if not careful:
        with suppress(Died):
            return written(apart(lambda: list(Comparing(change).all(part)), PARTITION_WITHIN_S), root)
    return written(Comparing(change, careful=True).all(part), root)


def _make(folder: _Folder, work: Work, sharing: Sharing) -> None:
    """Make the partitions that are not there yet. Raises what the sharing raises, OSError."""
    parts = list(enumerate(folder.plan.parts()))
    missing = [(number, part) for number, part in parts if not folder.has(number)]
    with workers.progress("partitions", len(parts), len(parts) - len(missing), len(parts) - len(missing)) as advance:
        for number, made in sharing(work, missing):
            folder.put(number, made)
            advance(1)


def _here(jobs: int, work: Work, tasks: Sequence[Task]) -> Iterator[tuple[int, Written]]:
    return workers.share(work, tasks, jobs)


def _on_cluster(scheduler: str, work: Work, tasks: Sequence[Task]) -> Iterator[tuple[int, Written]]:
    """What the cluster's workers make of the tasks; what a worker that dies was at is done by another. A task at which
    workers die again and again is left, and told at the end: WorkersDied. Raises Unusable, OSError."""
    from distributed import Client, KilledWorker, as_completed

    killed: list[int] = []
    connect: Any = Client
    with connect(scheduler, timeout=f"{WORKERS_WITHIN_S} s", set_as_default=False) as client:
        try:
            client.wait_for_workers(1, timeout=WORKERS_WITHIN_S)
        except TimeoutError as error:
            raise Unusable(f"{scheduler} has no workers: start some, dask worker {scheduler}") from error
        _refuse_others(client.run(program_release, on_error="return"))
        futures = {client.submit(_signed, work, part, pure=False, retries=RETRIES): number for number, part in tasks}
        done: Any = as_completed
        for future in done(list(futures), loop=client.loop):
            number = futures.pop(future)
            try:
                worker, theirs, made = future.result()
            except KilledWorker:
                killed.append(number)
            else:
                _refuse_others({worker: theirs})  # it may have joined since the others were asked
                yield number, made
            future.release()
    if killed:
        raise WorkersDied(f"workers died at partitions {killed}, which are not written; run it again to try these")


def _signed(work: Work, part: Part) -> tuple[str, str, Written]:
    """What a worker makes of a partition, with its address and its release of this program."""
    from distributed import get_worker

    return get_worker().address, program_release(), work(part, False)


def _refuse_others(told: dict[str, object]) -> None:
    """Raise Unusable where a worker, by its address, told of another release of this program than ours, or of none."""
    ours = program_release()
    others = [f"{worker} has {_release_told(said)}" for worker, said in sorted(told.items()) if said != ours]
    if others:
        raise Unusable(f"workers must have this program's release, {ours}: {'; '.join(others)}: install it there")


def _release_told(said: object) -> str:
    return said if isinstance(said, str) else f"none that can be asked ({type(said).__name__}: {said})"


class _Folder:
    """Where partitions are kept: ``output``, or a folder beside it where that is to be one file. Raises Unusable,
    OSError."""

    def __init__(self, output: Path, archive: Path, change: Change, partition_bytes: int) -> None:
        import pyarrow  # noqa: F401  # said before hours of work, where it is missing

        self.output, self._one_file = output, output.suffix == ".parquet"
        if self._one_file and output.exists():
            raise Unusable(f"{output} is there already: name a new file, so that no result is lost")
        self.folder = output.with_name(output.name + ".parts") if self._one_file else output
        self.plan = self._planned(archive, program([archive], change), partition_bytes)
        if not self.plan.sessions:
            raise Unusable(f"no session in {archive}: name the archive's folder, or one of sessions")
        for table in TABLES:
            (self.folder / table).mkdir(parents=True, exist_ok=True)

    def _planned(self, archive: Path, of: str, partition_bytes: int) -> Plan:
        """The plan of the run that goes on here, or a new one."""
        file = self.folder / "plan.json"
        if not file.exists():
            if self.folder.exists() and any(self.folder.iterdir()):
                raise Unusable(f"{self.folder} holds something else: name a new folder")
            plan = Plan.of([archive], partition_bytes)
            if plan.sessions:
                self.folder.mkdir(parents=True, exist_ok=True)
                whole_file.write(file, json.dumps({"reinspect": VERSION, "of": of, "plan": plan.as_json()}))
            return plan
        try:
            said = json.loads(file.read_text())
            if (said["reinspect"], said["of"]) == (VERSION, of):
                return Plan.of_json(said["plan"])
        except (ValueError, KeyError, TypeError) as error:
            raise Unusable(f"{file} cannot be read ({error}): name a new output") from error
        raise Unusable(f"{self.folder} is of another archive, other settings or another program: name a new output")

    def _file(self, table: str, number: int) -> Path:
        return self.folder / table / f"part-{number:06d}.parquet"

    def has(self, number: int) -> bool:
        """Whether a partition is written whole."""
        return self._file("frames", number).exists()

    def put(self, number: int, made: Written) -> None:
        """Write a partition. Raises OSError, and then it is not there."""
        whole_file.write(self._file("seeds", number), made.seeds)
        whole_file.write(self._file("frames", number), made.frames)

    def counts(self) -> Counter[str]:
        """What came out, of all partitions."""
        from pyarrow import parquet

        counted: Counter[str] = Counter()
        for number in range(len(self.plan.parts())):
            counted.update(json.loads(parquet.read_schema(self._file("frames", number)).metadata[COUNTS]))
        return counted

    def finish(self) -> None:
        """Where it is to be one file, make it, the seeds' first; the partitions go."""
        if self._one_file:
            self._merge("seeds", self.output.with_suffix(".seeds.parquet"))
            self._merge("frames", self.output)
            shutil.rmtree(self.folder)

    def _merge(self, table: str, into: Path) -> None:
        from pyarrow import parquet

        whole = self.folder / f"{table}.whole"
        files = [self._file(table, number) for number in range(len(self.plan.parts()))]
        schema = parquet.read_schema(files[0]).remove_metadata()
        with parquet.ParquetWriter(whole, schema, compression="zstd") as writer:
            for file in files:
                writer.write_table(parquet.read_table(file).replace_schema_metadata(None))
        whole.replace(into)


TABLES = ("seeds", "frames")
