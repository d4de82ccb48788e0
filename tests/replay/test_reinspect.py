"""`inspector reinspect`: the same tables from one process, all cores and a cluster, whatever interrupts or kills it."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import recorded_sessions
from pyarrow import parquet
from typer.testing import CliRunner

from firmware_bridge.wire import session
from inspector.change_options import Asked, Unusable
from inspector.cli.app import app
from inspector.replay import reinspect, state
from inspector.replay import tables as table_columns
from inspector.replay.tables import Written

pytestmark = pytest.mark.xdist_group("cluster")
FRAMES = 3 * len(recorded_sessions.FRAMES)


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An archive of three sessions, one with a frame damaged and a line spoilt."""
    folder = tmp_path_factory.mktemp("archive")
    version, images = recorded_sessions.version(folder), recorded_sessions.images()
    for name in ("b", "a", "c"):
        recording = recorded_sessions.Recording(folder / "frames" / name)
        for image in images:
            recording.panel(version, [image])
    (folder / "frames" / "c" / "000002.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    index = folder / "frames" / "c" / session.INDEX
    lines = index.read_text().splitlines()
    index.write_text("\n".join([*lines[:2], "[]", *lines[2:]]) + "\n")
    return folder


def made(output: Path, archive: Path, *, jobs: int = 1, scheduler: str | None = None, part_bytes: int = 1) -> int:
    return reinspect.run(archive, Asked(method="thesis"), output, scheduler, jobs, part_bytes)


def tables(output: Path) -> dict[str, bytes]:
    """All files of an output folder but the plan."""
    return {str(file.relative_to(output)): file.read_bytes() for file in sorted(output.rglob("*.parquet"))}


@pytest.fixture(scope="module")
def alone(archive: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """What one process makes of the archive."""
    output = tmp_path_factory.mktemp("alone") / "out"
    assert made(output, archive) == 1
    return tables(output)


def test_every_frame_and_seed_has_its_row_in_order(archive: Path, tmp_path: Path) -> None:
    words = ["reinspect", str(archive), "--output", str(tmp_path / "all.parquet"), "--jobs", "1"]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 1
    assert f"{FRAMES - 1} frames compared: {FRAMES - 1} the same" in done.output
    assert "2 not compared" in done.output
    assert sorted(file.name for file in tmp_path.iterdir()) == ["all.parquet", "all.seeds.parquet"]
    frames = parquet.read_table(tmp_path / "all.parquet").to_pylist()
    assert [(row["session"], row["file"]) for row in frames if row["file"]] == [
        (f"frames/{name}", f"{n:06d}.png") for name in "abc" for n in range(1, 5)
    ]
    problems = [row["problem"] for row in frames if row["problem"]]
    assert [bool(re.search(what, why)) for what, why in zip(("line 3", "damaged"), problems, strict=True)] == [True] * 2
    found = json.loads((archive / "frames" / "a" / session.INDEX).read_text().splitlines()[1])
    seeds = parquet.read_table(tmp_path / "all.seeds.parquet").to_pylist()
    first = seeds[0]
    assert (first["session"], first["file"], first["seed"]) == ("frames/a", "000001.png", 0)
    assert first["then_height_um"] == first["now_height_um"] == found["result"]["defects"][0]["height_um"]
    assert first["then_direct_x_px"] == found["result"]["defects"][0]["direct_px"][0]
    assert frames[0]["then_seeds"] == len(found["result"]["defects"])


def test_columns_say_what_they_are(alone: dict[str, bytes], tmp_path: Path) -> None:
    for table, columns in (("frames", table_columns.FRAMES), ("seeds", table_columns.SEEDS)):
        file = tmp_path / f"{table}.parquet"
        file.write_bytes(alone[f"{table}/part-000000.parquet"])
        schema = parquet.read_schema(file)
        assert schema.names == [column.name for column in columns]
        assert [schema.field(c.name).metadata[b"says"].decode() for c in columns] == [c.says for c in columns]


class Interrupted(Exception):
    """As by Ctrl-C."""


@pytest.mark.parametrize("after", [0, 5])
def test_an_interrupted_run_goes_on_where_it_was(
    archive: Path, alone: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, after: int
) -> None:
    put, output, numbers = reinspect._Folder.put, tmp_path / "out", []

    def interrupted(folder: Any, number: int, written: Written) -> None:
        if len(numbers) == after:
            raise Interrupted
        numbers.append(number)
        put(folder, number, written)

    with monkeypatch.context() as patch:
        patch.setattr(reinspect._Folder, "put", interrupted)
        with pytest.raises(Interrupted):
            made(output, archive)
    whole = tables(output)
    assert len(whole) == 2 * after
    (output / "seeds" / "part-000005.parquet").write_bytes(b"as of a run that was killed between the two files")
    came_since = Path(shutil.copytree(archive / "frames" / "a", archive / "frames" / "d"))
    try:
        assert made(output, archive) == 1
    finally:
        shutil.rmtree(came_since)
    assert tables(output) == alone


def test_what_a_run_found_is_never_mixed_with_anothers(archive: Path, tmp_path: Path, capsys: Any) -> None:
    assert made(tmp_path / "out", archive, part_bytes=1 << 20) == 1
    before = tables(tmp_path / "out")
    assert reinspect.run(archive, Asked(), tmp_path / "out") == 2
    assert "of another archive, other settings" in capsys.readouterr().err
    assert tables(tmp_path / "out") == before
    (tmp_path / "one.parquet").touch()
    assert made(tmp_path / "one.parquet", archive) == 2
    assert "name a new file" in capsys.readouterr().err


def test_without_its_packages_it_says_which(archive: Path, tmp_path: Path, monkeypatch: Any, capsys: Any) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    assert made(tmp_path / "out", archive) == 2
    assert "seed-inspector[cluster]" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@dataclass
class Cluster:
    """A Dask scheduler and its workers, each a process."""

    address: str
    workers: list[subprocess.Popen[bytes]]


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory, wait_until: Callable[..., Any]) -> Iterator[Cluster]:
    from distributed import LocalCluster

    folder, program = tmp_path_factory.mktemp("cluster"), Path(sys.executable).with_name("dask")
    crashing = Path(recorded_sessions.__file__).parent / "crashing"
    scheduling: Any = LocalCluster
    with ExitStack() as stack:
        scheduler = stack.enter_context(
            scheduling(n_workers=0, host="127.0.0.1", scheduler_port=0, dashboard_address=None)
        )
        command = [
            program,
            "worker",
            scheduler.scheduler_address,
            "--host",
            "127.0.0.1",
            "--no-nanny",
            "--no-dashboard",
        ]
        workers = []
        for _ in range(2):
            log = stack.enter_context((folder / "worker.log").open("ab"))
            env = os.environ | {"PYTHONPATH": str(crashing)}
            worker = subprocess.Popen([*command, "--nthreads", "1"], stdout=log, stderr=log, cwd=folder, env=env)
            stack.callback(worker.wait)
            stack.callback(worker.kill)
            workers.append(worker)
        wait_until(lambda: len(scheduler.scheduler_info["workers"]) == 2, "two workers", 60)
        yield Cluster(scheduler.scheduler_address, workers)


def test_all_cores_and_a_cluster_make_the_same_tables(
    archive: Path, alone: dict[str, bytes], cluster: Cluster, tmp_path: Path
) -> None:
    assert made(tmp_path / "two", archive, jobs=2) == 1
    assert tables(tmp_path / "two") == alone
    assert made(tmp_path / "cluster", archive, scheduler=cluster.address) == 1
    assert tables(tmp_path / "cluster") == alone


def test_a_frame_that_crashes_its_process_costs_no_worker_and_is_told_by_name(
    archive: Path, cluster: Cluster, tmp_path: Path
) -> None:
    shutil.copytree(archive / "frames" / "a", tmp_path / "crashes")
    assert made(tmp_path / "out.parquet", tmp_path / "crashes", scheduler=cluster.address, part_bytes=1 << 20) == 1
    frames = parquet.read_table(tmp_path / "out.parquet").to_pylist()
    assert len(frames) == len(recorded_sessions.FRAMES)
    assert [(row["file"], "SIGSEGV" in row["problem"]) for row in frames if row["problem"]] == [("000002.png", True)]
    assert [worker.poll() for worker in cluster.workers] == [None, None]


def test_workers_of_another_release_are_refused(
    archive: Path, cluster: Cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    theirs = state.program_release()
    monkeypatch.setattr(state, "release", lambda _: "0.0.1")
    assert made(tmp_path / "out", archive, scheduler=cluster.address) == 2
    said = capsys.readouterr().err
    assert said.count(f"has {theirs}") == 2
    assert "release, 0.0.1" in said
    assert tables(tmp_path / "out") == {}
    with pytest.raises(Unusable, match="tcp://a has none that can be asked"):
        reinspect._refuse_others({"tcp://a": AttributeError("program_release"), "tcp://b": "0.0.1"})


def test_what_a_worker_of_another_release_made_that_joined_later_is_not_taken(
    archive: Path, cluster: Cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    refuse, asked = reinspect._refuse_others, list[object]()

    def before_they_joined(told: dict[str, object]) -> None:
        asked.append(told)
        if len(asked) > 1:
            refuse(told)

    monkeypatch.setattr(state, "release", lambda _: "0.0.1")
    monkeypatch.setattr(reinspect, "_refuse_others", before_they_joined)
    assert made(tmp_path / "out", archive, scheduler=cluster.address) == 2
    assert "release, 0.0.1: tcp://127.0.0.1:" in capsys.readouterr().err
    assert tables(tmp_path / "out") == {}


def test_a_worker_that_is_killed_costs_what_it_was_at(
    archive: Path, alone: dict[str, bytes], cluster: Cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    put = reinspect._Folder.put

    def killing(folder: Any, number: int, written: Written) -> None:
        if cluster.workers[0].poll() is None:
            cluster.workers[0].send_signal(signal.SIGKILL)
            cluster.workers[0].wait()
        put(folder, number, written)

    monkeypatch.setattr(reinspect._Folder, "put", killing)
    assert made(tmp_path / "out", archive, scheduler=cluster.address) == 1
    assert cluster.workers[0].returncode == -signal.SIGKILL
    assert tables(tmp_path / "out") == alone


def test_a_cluster_that_is_not_there_is_said(
    archive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.setattr(reinspect, "WORKERS_WITHIN_S", 0.2)
    assert made(tmp_path / "out", archive, scheduler="tcp://127.0.0.1:1") == 2
    assert "tcp://127.0.0.1:1" in capsys.readouterr().err
    shutil.rmtree(tmp_path / "out")
