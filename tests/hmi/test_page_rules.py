"""What the page may show and do, without a wire: verdicts, commands, history, texts, the door."""

from __future__ import annotations

import itertools
import re
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from inspector import handshake
from inspector.faults import Fault
from inspector.handshake import Handshake
from inspector.handshake_table import Action, Answer, CommandResult
from inspector.hmi import commands, gate, history, texts, texts_file, view
from inspector.hmi.commands import Asked, Deed, Outcome
from inspector.hmi.gate import Gate, NoPassword
from inspector.hmi.look import STILL_S, Look
from inspector.hmi.view import Known
from inspector.model import Snapshot, Verdict
from inspector.page_settings import PageSettings
from inspector.publish.registers import (
    OPERATOR_ADDRESS,
    Status,
    decode,
    decode_operator,
    encode_image,
)
from inspector.recipe import Recipe

ENGLISH = texts.english()
KNOWN = Known((Recipe(id=1, name="one"),), {100: "Ring the bell"}, ENGLISH)
STATIC = Path(view.__file__).parent / "static"


def block(words: list[int]) -> dict[str, Any]:
    return dict(decode(words, 0))


def unpacked(data: bytes) -> list[int]:
    return [int.from_bytes(data[i : i + 2], "big") for i in range(0, len(data), 2)]


areas = st.binary(min_size=250, max_size=250).map(unpacked)
TOLD = block([1] * 125) | {"result_age_ms": 5000, "defect_count": 3}


@given(st.sampled_from(Verdict), st.integers(0, 2047), st.sampled_from((0, 0, 301, 9999)), st.floats(0, 6))
def test_a_verdict_is_shown_only_while_everything_stands_behind_it(
    verdict: Verdict, status: int, fault: int, silent_s: float
) -> None:
    read = TOLD | {"verdict": int(verdict), "status": status, "fault_code": fault}
    look = Look(block=read, read_s=100.0 - silent_s, heartbeat_s=100.0 - silent_s)
    tree = view.shown(look, KNOWN, 100.0)
    stands = Status.RESULTS_VALID in Status(status) and Status.FAULT not in Status(status)
    expected = verdict.name if stands else "NOT_INSPECTED"
    assert tree["verdict"]["name"] == (expected if silent_s <= STILL_S else "NO_STATION")
    if tree["verdict"]["name"] == "NO_STATION":
        assert not {"seeds", "map", "statistics", "station", "state"} & set(tree)
    else:
        assert (tree["fault"] is None) is (fault == 0)


@given(areas, areas)
def test_whatever_the_registers_hold_is_shown(result: list[int], area: list[int]) -> None:
    seeds = decode([7] * 300, 1000)
    seed = {n: seeds[f"list_defect_1_{n}"] for n in ("x_mm", "y_mm", "height_um", "height_sigma_um", "flags")}
    look = Look(
        block=block(result),
        statistics=dict(decode(area, 2000)),
        defects=(seed,),
        listed_for=(1,),
        heartbeat_s=0.0,
    )
    tree = view.shown(look, KNOWN, 0.0)
    assert tree["verdict"]["name"] in (*Verdict.__members__, "NO_STATION")
    seen = history.result_of(block(result), 0.0)
    assert seen is None or seen.verdict in Verdict


@pytest.mark.parametrize("look", [Look(), Look(why="cable"), Look(block=block([0] * 125), reached_s=9.0, read_s=9.0)])
def test_a_station_whose_heartbeat_was_not_seen_to_move_has_no_verdict(look: Look) -> None:
    assert view.shown(look, KNOWN, 10.0)["verdict"]["name"] == "NO_STATION"


def test_every_fault_is_told_with_its_remedy() -> None:
    for fault in list(Fault)[1:]:
        read = block([0] * 125) | {"fault_code": int(fault)}
        told = view.shown(Look(block=read, heartbeat_s=0.0), KNOWN, 0.0)["fault"]
        assert (told["code"], told["meaning"], told["remedy"]) == (fault.value, fault.meaning, fault.remedy)


class Wire:
    """The operator's block of a station, over a wire that loses requests and answers."""

    def __init__(self) -> None:
        self.state, self.words, self.executed = Handshake(), (0,) * 16, 0
        self.waiting = 0

    def write(self, sent: tuple[int, ...]) -> None:
        written = (*sent, *self.words[len(sent) :])
        if written == self.words:
            return
        self.words = written
        self.state, orders = handshake.written(self.state, decode_operator(written), 0.0)
        self.waiting += sum(order.action is Action.RUN_COMMAND for order in orders)

    def obey(self) -> None:
        if self.waiting:
            self.waiting, self.executed = self.waiting - 1, self.executed + 1
            self.state = handshake.command_ended(self.state, CommandResult.DONE)

    def restart(self) -> None:
        self.state, self.words, self.waiting = Handshake(), (0,) * 16, 0

    def read(self) -> dict[str, Any]:
        side = handshake.operator_side(self.state, self.words)
        image = encode_image(Snapshot(operator=side), 0.0, 0)
        data = dict(image.areas)[OPERATOR_ADDRESS]
        return dict(decode(unpacked(data), OPERATOR_ADDRESS))


@given(
    st.lists(st.sampled_from(("arrives", "is lost", "obey")), max_size=40),
    st.sampled_from((Deed.CHANGE_RECIPE, Deed.RESET_STATISTICS)),
    st.booleans(),
)
def test_a_command_is_carried_out_once_however_often_its_requests_are_lost(
    story: list[str], deed: Deed, left_over: bool
) -> None:
    wire = Wire()
    if left_over:  # of a page that died
        wire.write((0x80, 0, 0, 0, 1, 0, 0, 9))
    before = wire.executed + wire.waiting
    asked = Asked(1, deed, 1, 0.0)
    for event in (*story, *("arrives", "obey", "obey") * 8):
        if event == "obey":
            wire.obey()
        elif not asked.over:
            asked, sent = commands.step(asked, wire.read(), 1.0)
            if sent is not None and event == "arrives":  # whether its answer does too makes no difference
                wire.write(sent)
    assert (asked.outcome, asked.code) == (Outcome.DONE, CommandResult.DONE)
    assert wire.executed - before == 1


def test_a_station_that_restarts_within_a_command_is_not_taken_for_one_that_has_done_it() -> None:
    wire, asked = Wire(), Asked(1, Deed.CHANGE_RECIPE, 2, 0.0)
    for _ in range(2):
        asked, sent = commands.step(asked, wire.read(), 1.0)
        if sent is not None:
            wire.write(sent)
    assert Answer(wire.read()["operator_handshake"]) == Answer.COMMAND_EXECUTING
    wire.restart()
    asked, _ = commands.step(asked, wire.read(), 2.0)
    assert asked.outcome is Outcome.LOST


def test_a_station_that_never_answers_is_asked_for_a_while_only() -> None:
    wire, asked = Wire(), Asked(1, Deed.CHANGE_RECIPE, 2, 0.0)
    for now_s in (1.0, 2.0, 3.0, commands.DEADLINE_S + 1):
        asked, sent = commands.step(asked, wire.read(), now_s)
        wire.write(sent or wire.words[:8])
    assert asked.outcome is Outcome.LATE
    assert wire.words == (0,) * 16


@settings(max_examples=10)
@given(st.lists(st.integers(0, 5), min_size=90, max_size=110))
def test_the_history_keeps_what_was_seen_and_counts_what_was_not(steps: list[int]) -> None:
    kept: tuple[history.Seen, ...] = ()
    sequence, numbers = 0, []
    for step in steps:
        sequence += step
        read = block([0] * 125) | {"sequence_u32": sequence, "result_age_ms": 0, "verdict": 1}
        kept = history.after(kept, history.result_of(read, 0.0))
        numbers += [sequence] if not numbers or numbers[-1] != sequence else []
    assert [seen.sequence for seen in kept] == numbers[::-1][: history.KEPT]
    for newer, older in itertools.pairwise(kept):
        assert newer.unseen == newer.sequence - older.sequence - 1


def test_every_text_of_the_files_is_in_the_table() -> None:
    page = (STATIC / "page.html").read_text()
    assert not set(re.findall(r"\{\{([\w.]+)\}\}", page)) - set(ENGLISH) - {"station"}
    assert not re.search(r"<script>|\son\w+=|style=|https?://(?!www\.w3\.org/)", page)
    ids = set(re.findall(r'id="([\w-]+)"', page))
    script = (STATIC / "page.js").read_text()
    used = set(re.findall(r'\b(?:at|put|showRows)\("([\w-]+)"', script)) - {"text-"}
    assert used
    assert used <= ids


def test_a_plants_own_texts_replace_those_of_the_table_and_no_others(tmp_path: Path) -> None:
    file = tmp_path / "de.yaml"
    file.write_text(yaml.safe_dump({"verdict.FAIL": "AUSSCHUSS", "fault.301": "Die Kamera fehlt"}))
    told, problems = texts_file.load(file)
    assert not problems
    assert (told["verdict.FAIL"], told["fault.301"]) == ("AUSSCHUSS", "Die Kamera fehlt")
    file.write_text(yaml.safe_dump({"verdict.MAYBE": "?", "value.panel": "Teil", "button.cancel": 3}))
    assert len(texts_file.load(file)[1]) == 3
    assert texts_file.load(tmp_path / "none.yaml")[1]


@pytest.mark.parametrize(
    ("hosts", "admitted"),
    [
        (("localhost:8080",), True),
        (("127.0.0.1",), True),
        (("[::1]:8080",), True),
        (("Panel.Plant:80",), True),
        (("evil.example",), False),
        (("127.0.0.1.evil.example:8080",), False),
        (("localhost", "evil.example"), False),
        ((), False),
        (("",), False),
    ],
)
def test_the_page_answers_to_its_names_alone(hosts: tuple[str, ...], admitted: bool) -> None:
    assert Gate(("panel.plant",), None).admits_host(hosts) is admitted


@pytest.mark.parametrize(
    ("headers", "own"),
    [
        ({"Host": "localhost:80"}, True),
        ({"Host": "localhost:80", "Origin": "http://localhost:80", "Sec-Fetch-Site": "same-origin"}, True),
        ({"Host": "localhost:80", "Origin": "http://localhost:81"}, False),
        ({"Host": "localhost:80", "Origin": "null"}, False),
        ({"Host": "localhost:80", "Origin": ""}, False),
        ({"Host": "localhost:80", "Sec-Fetch-Site": "cross-site"}, False),
        ({"Host": "localhost:80", "Sec-Fetch-Site": "same-site"}, False),
    ],
)
def test_a_command_comes_from_the_page_itself(headers: dict[str, str], own: bool) -> None:
    assert Gate((), None).is_own(headers) is own


def test_passwords_are_kept_as_no_text_and_guessed_at_five_times(tmp_path: Path) -> None:
    file, now_s = tmp_path / "password", [0.0]
    door = Gate((), file, lambda: now_s[0])
    with pytest.raises(NoPassword):
        door.is_password("")
    file.write_text("open sesame")
    with pytest.raises(NoPassword):
        door.is_password("open sesame")
    with pytest.raises(ValueError, match="4 letters"):
        gate.keep(file, "abc")
    file.unlink()
    gate.keep(file, "Lack & Füller")
    assert file.stat().st_mode & 0o077 == 0
    assert "Lack" not in file.read_text()
    assert door.is_password("Lack & Füller")
    assert [door.is_password("wrong") for _ in range(5)] == [False] * 5
    assert not door.is_password("Lack & Füller")
    now_s[0] += door.locked_s()
    assert door.is_password("Lack & Füller")


def test_a_page_that_others_reach_is_guarded_or_commands_nothing(tmp_path: Path) -> None:
    with pytest.raises(ValidationError, match="allow_commands"):
        PageSettings(host="0.0.0.0")
    for guard in ({"password_file": tmp_path / "password"}, {"allow_commands": False}, {"host": "::1"}):
        assert PageSettings(**({"host": "0.0.0.0"} | guard))  # type: ignore[arg-type]  # of several types
