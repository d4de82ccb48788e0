"""The sequence never goes back: not over a stop, not over a kill, as far as the disk allows."""

from __future__ import annotations

import logging
import os
import signal
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Event
from typing import Any

import pytest

from firmware_bridge import whole_file
from firmware_bridge.simulators.module_server import ModuleServer
from inspector import sequence_file
from inspector.sequence_file import AHEAD, SequenceFile
from inspector.service import front
from inspector.settings import load
from inspector.signals import Signals

CONFIG = Path(__file__).parents[2] / "config"


def test_the_file_is_always_ahead_of_the_results_and_exact_at_the_end(tmp_path: Path) -> None:
    file = tmp_path / "sequence.json"
    kept = SequenceFile(file)
    assert kept.first == 0
    for sequence in range(1, 3 * AHEAD):
        kept.reached(sequence)
        assert sequence <= SequenceFile(file).first <= sequence + AHEAD
    kept.ends(3 * AHEAD)
    assert SequenceFile(file).first == 3 * AHEAD


def test_another_file_takes_over_with_the_next_result(tmp_path: Path) -> None:
    kept = SequenceFile(tmp_path / "one.json")
    kept.reached(1)
    kept.move(tmp_path / "two.json")
    kept.reached(2)
    assert SequenceFile(tmp_path / "two.json").first >= 2


@pytest.mark.parametrize("text", ["", "7", "{}", '{"sequence": "x"}', '{"sequence": null}'])
def test_a_file_that_says_nothing_is_told_and_counting_begins_anew(
    text: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    file = tmp_path / "sequence.json"
    file.write_text(text)
    assert SequenceFile(file).first == 0
    assert "sequence.json: cannot be used" in caplog.text


def test_a_disk_that_takes_nothing_is_told_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.ERROR)
    kept = SequenceFile(tmp_path / "gone" / "sequence.json")
    for sequence in range(1, 3 * AHEAD):
        kept.reached(sequence)
    assert [r.getMessage().count("cannot be written") for r in caplog.records] == [1]


def test_a_disk_that_hangs_holds_no_result_up_for_long(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    file, let_go, write = tmp_path / "sequence.json", Event(), whole_file.write

    def hang(path: Path, content: str | bytes) -> None:
        let_go.wait(20)
        write(path, content)

    monkeypatch.setattr(whole_file, "write", hang)
    monkeypatch.setattr(sequence_file, "WAIT_S", 0.001)
    kept = SequenceFile(file)
    for sequence in range(1, 2 * AHEAD):
        kept.reached(sequence)
    assert not file.exists()
    assert [r.getMessage().count("the disk does not answer") for r in caplog.records] == [1]
    let_go.set()
    monkeypatch.setattr(sequence_file, "WAIT_S", 20)
    kept.ends(2 * AHEAD)
    assert SequenceFile(file).first == 2 * AHEAD


def test_a_disk_that_hangs_at_the_start_is_told_and_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    file = tmp_path / "sequence.json"
    os.mkfifo(file)  # who reads it waits
    told = Event()
    monkeypatch.setattr(front, "LATE_S", 0.0)
    monkeypatch.setattr(caplog.handler, "emit", lambda line: (caplog.records.append(line), told.set()))
    settings = load(CONFIG / "demo.yaml")
    plc = settings.plc.model_copy(update={"port": 0, "sequence_file": file})

    def comes_back() -> bool:
        was_told = told.wait(20)
        file.write_text('{"sequence": 7}')
        return was_told

    with ThreadPoolExecutor() as pool:
        back = pool.submit(comes_back)
        begun = front.Front(settings.model_copy(update={"plc": plc, "recipe_choice_file": None}), Signals())
        assert back.result()
    assert begun.snapshot.sequence == 7
    assert [record.getMessage().partition(";")[0] for record in caplog.records] == [
        f"{file}: the disk does not answer, and registers are not served before it does"
    ]


@pytest.mark.parametrize("end", [signal.SIGTERM, signal.SIGKILL])
def test_after_an_end_of_any_kind_the_sequence_goes_on(
    end: signal.Signals, station: Any, module: Callable[[], ModuleServer], service: Callable[..., Any]
) -> None:
    module()
    station.settings["plc"]["sequence_file"] = "sequence.json"
    station.write()
    first = service()
    shown = first.until_inspecting(2)
    first.send(end)
    first.ended()
    second = service()
    begun = second.until(lambda r: r["recipe_id"], "registers")
    assert begun["sequence"] >= shown["sequence"]
    assert begun["verdict"] == 0 or begun["sequence"] > shown["sequence"]
    assert second.until_inspecting(shown["sequence"])["sequence"] > shown["sequence"]
