"""Results written into a PLC: in order, each once, over outages; the PLC is a libmodbus server, killed at will."""

from __future__ import annotations

import contextlib
import re
import subprocess
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_bridge import factory
from firmware_bridge.errors import NoReply, Refused
from firmware_bridge.wire.modbus import MAX_WRITE_REGISTERS, Table
from inspector.faults import Fault
from inspector.handshake_table import Answer
from inspector.model import Defect, Flag, Reason, Snapshot, State, Verdict
from inspector.publish import outbox
from inspector.publish.outbox import Outbox
from inspector.publish.plc_settings import PostSettings
from inspector.publish.registers import RESULT_WORDS, decode
from inspector.service import posting
from inspector.service.posting import Poster
from inspector.settings import SettingsError, load
from tests.line.test_daemon import Bench, bench

__all__ = ["bench"]

BASE, ACKNOWLEDGE = 40, 300
HEIGHTS = 10_000
QUICK: dict[str, Any] = {"deadline_s": 5.0, "retry_first_s": 0.01, "retry_longest_s": 0.05, "period_s": 0.05}


def result(sequence: int, verdict: Verdict = Verdict.PASS) -> Snapshot:
    """A result whose height is its sequence's last digits, so that a block mixed of two would show."""
    seed = Defect(0.0, 0.0, float(sequence % HEIGHTS), None, (0.0, 0.0), (0.0, 0.0), Flag(0))
    return Snapshot(state=State.READY, sequence=sequence, verdict=verdict, defects=(seed,), result_at_s=0.0)


@given(
    st.lists(st.sampled_from(("result", "result", "written", "other", "acknowledged", "wrong")), max_size=80),
    st.booleans(),
    st.integers(1, 4),
)
def test_results_arrive_once_in_order_or_are_counted(steps: list[str], acknowledges: bool, room: int) -> None:
    box = Outbox(room, acknowledges, Snapshot())
    made, arrived, shown = 0, [], [0]
    for step in steps:
        before = box
        match step:
            case "result":
                made += 1
                box = outbox.added(box, result(made))
            case "written":
                box = outbox.posted(box, box.shown.sequence)
            case "other":
                box = outbox.posted(box, box.shown.sequence + 1)
            case "acknowledged":
                box = outbox.acknowledged(box, box.shown.sequence)
            case "wrong":
                box = outbox.acknowledged(box, box.shown.sequence + 1)
        if before.under_way and (box.shown.sequence != before.shown.sequence or not box.under_way):
            assert step == ("acknowledged" if acknowledges else "written")
            assert before.written or not acknowledges
            arrived.append(before.shown.sequence)
        shown.append(outbox.view(box, replace(box.shown, sequence=made)).sequence)
    under_way = [box.shown.sequence] if box.under_way else []
    settled = arrived + under_way + [waiting.sequence for waiting in box.waiting]
    assert settled == sorted(set(settled))
    assert made - len(settled) == box.lost
    assert shown == sorted(shown)
    assert len(box.waiting) <= room


def test_no_verdict_is_posted_while_there_is_a_fault() -> None:
    box = outbox.added(Outbox(4, True, Snapshot()), result(1))
    live = replace(result(1), state=State.ERROR, fault_code=301)
    shown = outbox.view(box, live)
    assert (shown.verdict, shown.fault_code, shown.defects) == (Verdict.NOT_INSPECTED, 301, ())
    assert Reason.DEVICE_FAULT in shown.reasons
    assert outbox.view(box, replace(live, state=State.READY, fault_code=0)).verdict is Verdict.PASS


@dataclass
class FakeMaster:
    """Registers that keep what is written, and how; ``fails``: which writes are lost, by their number."""

    fails: dict[int, Exception] = field(default_factory=dict)
    registers: list[int] = field(default_factory=lambda: [0] * 500)
    writes: list[tuple[int, int]] = field(default_factory=list)
    opened: int = 0

    def open(self) -> None:
        self.opened += 1

    def close(self) -> None: ...

    def read(self, table: Table, address: int, count: int = 1) -> list[int]:
        assert table is Table.HOLDING_REGISTERS
        return self.registers[address : address + count]

    def write_many(self, address: int, values: list[int]) -> None:
        self.writes.append((address, len(values)))
        if error := self.fails.pop(len(self.writes), None):
            raise error
        self.registers[address : address + len(values)] = values

    @property
    def block(self) -> dict[str, Any]:
        return decode(self.registers[BASE : BASE + RESULT_WORDS])


@pytest.fixture
def poster() -> Iterator[Callable[..., Poster]]:
    """``poster(master, stalled=..., after=..., **settings)``: a poster at work; it takes over from ``after``."""
    with contextlib.ExitStack() as stack:
        turn = threading.Lock()

        def start(
            master: Any, stalled: Callable[[], bool] = lambda: False, after: Poster | None = None, **settings: Any
        ) -> Poster:
            given = PostSettings(**({"host": "127.0.0.1", "address": BASE} | QUICK | settings))
            made = Poster(given, master, Snapshot(), turn=turn, stalled=stalled)
            if after is not None:
                made.take_over(after.stop())
            stack.callback(made.stop)
            made.start()
            return made

        yield start


def test_the_sequence_is_written_last_in_requests_of_at_most_123(
    poster: Callable[..., Poster], wait_until: Callable[..., Any]
) -> None:
    plc = FakeMaster()
    poster(plc).show(result(7), result(7))
    wait_until(lambda: plc.block["sequence"] == 7, "the result")
    assert [address for address, _ in plc.writes[:2]] == [BASE + 2, BASE]
    assert {count for _, count in plc.writes} == {MAX_WRITE_REGISTERS, RESULT_WORDS - MAX_WRITE_REGISTERS}
    assert plc.block["sequence_end"] == plc.block["largest_height_um"] == 7


def test_a_failed_write_is_done_again_from_its_beginning(
    poster: Callable[..., Poster], wait_until: Callable[..., Any], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    plc = FakeMaster({3: NoReply("plc", "silent"), 6: Refused("plc", "no"), 9: ZeroDivisionError("a bug")})
    at_work = poster(plc)
    for sequence in range(1, 5):
        at_work.show(result(sequence), result(sequence))
    wait_until(lambda: plc.block["sequence"] == 4, "all")
    assert plc.opened == 4
    told = [record.getMessage() for record in caplog.records]
    assert sum("fails" in text for text in told) == sum("works again" in text for text in told) == 3


def test_a_stalled_inspection_is_a_fault_at_the_plc(
    poster: Callable[..., Poster], wait_until: Callable[..., Any]
) -> None:
    plc, stalled = FakeMaster(), threading.Event()
    poster(plc, stalled.is_set).show(result(1), result(1))
    wait_until(lambda: plc.block["verdict"] == Verdict.PASS, "a pass")
    stalled.set()
    wait_until(lambda: plc.block["fault_code"] == Fault.CYCLE_STALLED, "a fault")
    assert (plc.block["verdict"], plc.block["state"]) == (0, State.ERROR)


def test_a_full_queue_loses_the_newest_counts_them_and_says_so_once(
    poster: Callable[..., Poster], wait_until: Callable[..., Any], caplog: pytest.LogCaptureFixture
) -> None:
    plc = FakeMaster()
    at_work = poster(plc, acknowledge_address=ACKNOWLEDGE, queue=2)
    for sequence in range(1, 6):
        at_work.show(result(sequence), result(sequence))
    seen = []
    for sequence in (1, 2, 3):
        wait_until(lambda n=sequence: (plc.block["sequence"], plc.block["overruns"]) == (n, 2), f"result {sequence}")
        seen.append((plc.block["results_waiting"], plc.block["overruns"]))
        assert {Answer.RESULT_AVAILABLE, Answer.OVERRUN} <= set(Answer(plc.block["handshake"]))
        plc.registers[ACKNOWLEDGE] = sequence
    assert seen == [(2, 2), (1, 2), (0, 2)]
    wait_until(lambda: Answer.RESULT_AVAILABLE not in Answer(plc.block["handshake"]), "nothing under way")
    at_work.show(result(6), result(6))
    wait_until(lambda: plc.block["sequence"] == 6, "the next")
    assert len([r for r in caplog.records if "wait for the PLC" in r.getMessage()]) == 1


def test_a_plc_that_does_not_answer_does_not_hold_up_the_end(
    poster: Callable[..., Poster], wait_until: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(posting, "STOP_DEADLINE_S", 0.05)
    plc, asked, answers = FakeMaster(), threading.Event(), threading.Event()

    def write_many(address: int, values: list[int]) -> None:
        asked.set()
        assert answers.wait(20)
        FakeMaster.write_many(plc, address, values)

    monkeypatch.setattr(plc, "write_many", write_many)
    at_work = poster(plc)
    at_work.show(result(1), result(1))
    assert asked.wait(20)
    assert at_work.stop().shown.sequence in (0, 1)
    at_work.show(result(2), result(2))
    answers.set()
    wait_until(lambda: len(plc.writes) == 2, "the block under way")
    assert plc.block["sequence"] in (0, 1)


def test_another_poster_goes_on_with_what_was_left(
    poster: Callable[..., Poster], wait_until: Callable[..., Any]
) -> None:
    first, second = FakeMaster(), FakeMaster()
    at_work = poster(first, acknowledge_address=ACKNOWLEDGE)
    for sequence in (1, 2, 3):
        at_work.show(result(sequence), result(sequence))
    wait_until(lambda: first.block["sequence"] == 1, "the first")
    poster(second, after=at_work)
    wait_until(lambda: second.block["sequence"] == 3, "the last")
    assert second.writes[:6] == [(BASE + 2, 123), (BASE, 2)] * 3


def test_a_poster_that_was_given_up_has_ended_before_another_begins(
    poster: Callable[..., Poster], wait_until: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The PLC answers the old one's request only once another is at work: no block is of both, and none goes back."""
    monkeypatch.setattr(posting, "STOP_DEADLINE_S", 0.05)
    plc, asked, answers = FakeMaster(), threading.Event(), threading.Event()
    begun, seen = threading.Event(), list[tuple[int, int]]()

    class OnThisPlc(FakeMaster):
        def open(self) -> None:
            begun.set()

        def write_many(self, address: int, values: list[int]) -> None:
            plc.write_many(address, values)
            seen.append((plc.block["sequence"], plc.block["sequence_end"]))

    class SlowlyOnThisPlc(OnThisPlc):
        def open(self) -> None: ...

        def write_many(self, address: int, values: list[int]) -> None:
            asked.set()
            assert answers.wait(20)
            super().write_many(address, values)

    old = poster(SlowlyOnThisPlc())
    old.show(result(1), result(1))
    assert asked.wait(20)
    at_work = poster(OnThisPlc(), after=old)
    at_work.show(result(2), result(2))
    assert not begun.wait(0.3)
    answers.set()
    wait_until(lambda: plc.block["sequence"] == 2, "the new one's result")
    whole = [sequence for sequence, end in seen[1::2] if sequence == end]
    assert len(whole) == len(seen) // 2
    assert whole == sorted(whole)


class Plc:
    """The libmodbus PLC as a process; ``taken`` are its lines of results over all its lives."""

    def __init__(self, program: str, acknowledge: int) -> None:
        self._program, self._acknowledge, self.port = program, acknowledge, 0
        self.taken: list[tuple[int, ...]] = []
        self.live: list[tuple[int, ...]] = []
        self.start()

    def start(self) -> None:
        last = self.taken[-1][0] if self.taken else 0
        words = [str(n) for n in (self.port, BASE, self._acknowledge, last)]
        self.process = subprocess.Popen([self._program, *words], stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        self.port = int(self.process.stdout.readline().split()[1])
        self._reader = threading.Thread(target=self._read, args=(self.process.stdout,), daemon=True)
        self._reader.start()

    def _read(self, stream: Any) -> None:
        for line in stream:
            numbers = tuple(map(int, re.findall(r"\d+", line)))
            (self.live if line.startswith("live") else self.taken).append(numbers)

    def kill(self) -> None:
        self.process.kill()
        self.process.wait(20)
        self._reader.join(20)
        assert self.process.stdout is not None
        self.process.stdout.close()


@pytest.fixture
def plc(compiled_peer: Callable[..., str]) -> Iterator[Callable[..., Plc]]:
    """``plc(acknowledge)``: a PLC at work."""
    with contextlib.ExitStack() as stack:

        def start(acknowledge: int = ACKNOWLEDGE) -> Plc:
            made = Plc(compiled_peer("plc_registers"), acknowledge)
            stack.callback(made.kill)
            return made

        yield start


def posting_to(plc: Plc, **settings: Any) -> tuple[Any, dict[str, Any]]:
    return factory.build_plc_master("127.0.0.1", plc.port, 1, 5.0), {"port": plc.port} | settings


@pytest.mark.parametrize("acknowledge", [ACKNOWLEDGE, -1], ids=["acknowledged", "written"])
def test_a_plc_killed_again_and_again_has_each_result_once_and_in_order(
    acknowledge: int, plc: Callable[..., Plc], poster: Callable[..., Poster], wait_until: Callable[..., Any]
) -> None:
    """Also where `sequence` wraps: the 57th result has 0."""
    at_line = plc(acknowledge)
    master, settings = posting_to(at_line, acknowledge_address=None if acknowledge < 0 else acknowledge, queue=200)
    at_work = poster(master, **settings)
    made: list[int] = []
    for life in range(6):
        batch = list(range(65_480 + len(made), 65_500 + len(made)))
        made += batch
        for sequence in batch:
            verdict = Verdict.FAIL if sequence % 3 else Verdict.PASS
            at_work.show(result(sequence, verdict), result(sequence, verdict))
        some = len(made) - 20 + 3 * life
        wait_until(lambda some=some: len(at_line.taken) > some, "some results")
        at_line.kill()
        at_line.start()
    wait_until(lambda: at_line.taken[-1][0] == made[-1] % 0x10000, "the last result")
    assert [taken[:4] for taken in at_line.taken] == [
        (n % 0x10000, Verdict.FAIL if n % 3 else Verdict.PASS, n % HEIGHTS, 0) for n in made
    ]


def test_the_service_posts_what_it_finds_also_after_new_settings(
    plc: Callable[..., Plc], bench: Callable[..., Bench], wait_until: Callable[..., Any]
) -> None:
    at_line = plc()
    post = {"host": "127.0.0.1", "port": at_line.port, "address": BASE, "acknowledge_address": ACKNOWLEDGE} | QUICK
    station = bench(plc={"port": 0, "sequence_file": "sequence.json", "post": post})
    station.says = {2: Verdict.FAIL}
    station.camera.permits.release(3)
    wait_until(lambda: len(at_line.taken) == 3, "three results")
    assert [taken[:2] for taken in at_line.taken] == [(1, 1), (2, 2), (3, 1)]
    post["period_s"] = 0.04
    station.station.write()
    station.signals.request_reload()
    station.camera.permits.release(2)
    wait_until(lambda: len(at_line.taken) == 5, "two more")
    assert [taken[0] for taken in at_line.taken] == [1, 2, 3, 4, 5]
    station.stop()
    wait_until(lambda: at_line.live[-1][0] == State.HALTED, "that the station went off")


@pytest.mark.parametrize(
    ("post", "said"),
    [
        ({"host": "plc", "address": 65500}, "plc.post.address: 65500"),
        ({"host": "plc", "acknowledge_address": 124}, "lies in the block"),
        ({"host": "plc", "acknowledge_address": 300}, "needs sequence_file"),
    ],
)
def test_settings_that_could_not_work_are_refused(post: dict[str, Any], said: str, station: Any) -> None:
    station.settings["plc"]["post"] = post
    with pytest.raises(SettingsError, match=re.escape(said)):
        load(station.write())
