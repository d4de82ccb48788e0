"""The Node-RED flow's own code, carried out by Node.js message by message against the station's own handshake.

The same flow in a Node-RED that nobody here wrote: line/test_node_red_line.py, `make soak`.
"""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from paper_line import PaperLine

from inspector.dialogues import Obeys
from inspector.faults import Fault
from inspector.handshake_table import Answer, Command, CommandResult
from inspector.integrator import node_red
from inspector.model import Defect, Reason, Snapshot, Verdict
from inspector.publish import registers
from inspector.publish.wire_fields import WordOrder

PEER = Path(__file__).parents[1] / "peers" / "function_node.mjs"
FLOW: list[dict[str, Any]] = json.loads(node_red.flow())
Say = Callable[..., dict[str, Any]]


class Bench(PaperLine):
    """The flow's function in Node.js, a Modbus client, and a station on paper; time is what the ticks make it."""

    def __init__(self, say: Say, trigger_by_plc: bool = True, order: WordOrder = "high_first") -> None:
        super().__init__(trigger_by_plc, order)
        self._say, self.link, self.status = say, True, ""
        self.told: dict[str, list[Any]] = {name: [] for name in node_red.OUTPUTS[2:]}
        self.errors: list[str] = []
        self.shown: dict[str, Any] = {}

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / node_red.TICK_S)):
            self.tick()

    def until(self, condition: Callable[[], Any], seconds: float = 5.0) -> None:
        for _ in range(round(seconds / node_red.TICK_S)):
            if condition():
                return
            self.tick()
        pytest.fail(f"not within {seconds} s: {self.shown}")

    def tick(self) -> None:
        self.passes(node_red.TICK_S)
        self.says("tick")

    def says(self, topic: str, payload: Any = "", **more: Any) -> None:
        """A message to the function, and what the Modbus nodes make of what it sends."""
        said = self._say({"topic": topic, "payload": payload, **more})
        self.errors += said["errors"]
        self.shown, self.status = said["shown"], said["status"] or self.status
        reads, writes, *told = said["out"]
        for name, messages in zip(node_red.OUTPUTS[2:], told, strict=True):
            self.told[name] += [message["payload"] for message in messages]
        for message in (*reads, *writes):
            if self.link:
                self.says(message["topic"], self._answer(message["payload"]), exchange=message["exchange"])

    def _answer(self, asked: dict[str, Any]) -> Any:
        if asked["fc"] == 3:
            assert (asked["address"], asked["quantity"]) == (registers.RESULT_ADDRESS, registers.RESULT_WORDS)
            return self.image()
        assert (asked["fc"], asked["address"]) == (16, registers.CONTROL_ADDRESS)
        assert asked["quantity"] == len(asked["value"])
        self.written(asked["value"])
        return asked

    @property
    def results(self) -> list[tuple[str, int, int]]:
        return [(told["verdict"], told["sequence"], told["panel_id"]) for told in self.told["Results"]]

    @property
    def alarms(self) -> list[str]:
        return [told["cause"] for told in self.told["Alarms"]]

    @property
    def lost(self) -> list[int]:
        return [told["panel_id"] for told in self.told["Lost panels"]]

    def ready(self) -> bool:
        return bool(self.shown) and bool(self.shown["alive"])


@pytest.fixture
def bench(peer: Callable[[str, str], str], tmp_path: Path) -> Iterator[Callable[..., Bench]]:
    """``bench(trigger_by_plc, order, **environment)``: the function and a station; the tab's settings may be others."""
    node, running = peer("node", "nodejs"), []
    code = tmp_path / "function.js"
    code.write_text(node_red.function())

    def start(trigger_by_plc: bool = True, order: WordOrder = "high_first", **environment: str) -> Bench:
        given = {name: value for name, value, *_ in node_red.SETTINGS} | environment
        given["LOW_WORD_FIRST"] = str(order == "low_first").lower()
        command = [node, str(PEER), str(code), json.dumps(given)]
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1)
        running.append(process)

        def say(message: dict[str, Any]) -> dict[str, Any]:
            assert process.stdin
            assert process.stdout
            process.stdin.write(json.dumps(message) + "\n")
            answer: dict[str, Any] = json.loads(process.stdout.readline())
            return answer

        return Bench(say, trigger_by_plc, order)

    yield start
    for process in running:
        process.kill()
        process.communicate()


@pytest.mark.parametrize("order", ["high_first", "low_first"])
def test_a_triggered_panel_is_taken_once_with_its_id(bench: Callable[..., Bench], order: WordOrder) -> None:
    at = bench(order=order)
    at.until(at.ready)
    for number, verdict in ((70_001, Verdict.PASS), (70_002, Verdict.FAIL)):
        at.says("TRIGGER", number)
        at.until(lambda: at.station.trigger)
        at.inspects(verdict)
        at.run(1.0)
        assert at.results[-1][::2] == (verdict.name, number)
        assert Answer.RESULT_AVAILABLE not in Answer(at.station.registers["handshake"])
    at.says("TRIGGER")
    at.until(lambda: at.station.trigger)
    at.inspects()
    at.run(1.0)
    assert [panel for *_, panel in at.results] == [70_001, 70_002, 70_003]
    assert (at.lost, at.alarms) == ([], [])
    assert "#3 PASS, panel 70003" in at.status


def test_results_wait_while_the_link_is_gone_and_what_the_full_fifo_lost_is_counted(
    bench: Callable[..., Bench],
) -> None:
    at = bench(trigger_by_plc=False)
    at.until(at.ready)
    at.run(0.5)
    at.link = False
    for _ in range(12):
        at.inspects()
    at.run(3.0)
    assert (at.results, at.alarms) == ([], ["NO_ANSWER"])
    at.link = True
    at.run(4.0)
    at.inspects()
    at.run(1.0)
    assert [sequence for _, sequence, _ in at.results] == [*range(1, 10), 13]
    assert [told["lost_before"] for told in at.told["Results"]] == [0] * 9 + [3]
    assert at.alarms == ["NO_ANSWER", ""]


def test_a_flow_that_starts_again_takes_no_result_twice(bench: Callable[..., Bench]) -> None:
    at = bench(trigger_by_plc=False)
    at.until(at.ready)
    at.run(0.5)
    at.inspects()
    at.inspects()
    at.until(lambda: at.results)
    at._say({"topic": "restart"})
    at.run(3.0)
    assert [sequence for _, sequence, _ in at.results] == [1, 2]


def test_a_heartbeat_that_stands_still_raises_the_alarm_and_ends_all_passes(bench: Callable[..., Bench]) -> None:
    at = bench(trigger_by_plc=False)
    at.until(at.ready)
    at.beating = False
    at.run(2.5)
    assert (at.alarms, at.shown["alive"], at.shown["fault"]) == (["HEARTBEAT"], False, "HEARTBEAT")
    assert at.told["Alarms"][0]["alarm"] is True
    at.inspects()
    at.run(3.0)
    assert at.results == []
    at.beating = True
    at.run(2.0)
    assert ([verdict for verdict, *_ in at.results], at.alarms) == (["PASS"], ["HEARTBEAT", ""])
    assert at.told["Alarms"][1]["alarm"] is False


@pytest.mark.parametrize(("words", "cause"), [((0,) * 125, "MAP_VERSION"), ((), "NO_ANSWER")])
def test_zeroed_registers_are_never_alive(bench: Callable[..., Bench], words: tuple[int, ...], cause: str) -> None:
    at = bench()
    at.image = lambda: words  # type: ignore[method-assign]  # a zeroed PLC image, or none
    at.run(5.0)
    assert (at.shown["alive"], at.results, at.alarms) == (False, [], [cause])


def test_a_torn_block_is_not_used(bench: Callable[..., Bench]) -> None:
    at = bench(trigger_by_plc=False)
    at.until(at.ready)
    whole = at.image
    at.inspects()
    at.image = lambda: (*whole()[:-1], 7)  # type: ignore[method-assign]  # a torn image, read in two
    at.run(1.0)
    assert (at.results, at.alarms) == ([], ["TORN"])


@pytest.mark.parametrize(("accepted", "said"), [("false", "NOT_INSPECTED"), ("true", "PASS")])
def test_a_simulated_station_passes_nothing_unless_asked_to(
    bench: Callable[..., Bench], accepted: str, said: str
) -> None:
    at = bench(trigger_by_plc=False, ACCEPT_SIMULATED=accepted)
    at.station.live = replace(at.station.live, simulated=True)
    at.until(at.ready)
    at.inspects()
    at.run(1.0)
    assert [verdict for verdict, *_ in at.results] == [said]


def test_a_verdict_of_zero_is_not_inspected(bench: Callable[..., Bench]) -> None:
    at = bench(trigger_by_plc=False)
    at.until(at.ready)
    at.inspects(Verdict.NOT_INSPECTED)
    at.run(1.0)
    assert [verdict for verdict, *_ in at.results] == ["NOT_INSPECTED"]


def test_a_cycle_that_fails_is_not_inspected_and_the_fault_is_cleared(bench: Callable[..., Bench]) -> None:
    at = bench()
    at.until(at.ready)
    at.says("TRIGGER", 5)
    at.until(lambda: at.station.trigger)
    at.inspects(None)
    at.run(0.5)
    assert ([verdict for verdict, *_ in at.results], at.alarms) == (["NOT_INSPECTED"], ["INTERNAL"])
    assert at.told["Alarms"][0]["remedy"] == Fault.INTERNAL.remedy
    at.says("CLEAR_FAULT")
    at.run(0.5)
    assert at.alarms == ["INTERNAL", ""]


def test_a_panel_that_is_not_inspected_is_told(bench: Callable[..., Bench]) -> None:
    """By a trigger that comes before the one before has ended, and one whose result never comes."""
    at = bench()
    at.until(at.ready)
    at.says("TRIGGER", 5)
    at.says("TRIGGER", 6)
    assert at.lost == [6]
    at.run(13.0)
    assert (at.lost, at.results) == ([6, 5], [])


def test_a_panel_of_several_frames_begins_and_ends(bench: Callable[..., Bench]) -> None:
    at = bench()
    at.until(at.ready)
    at.says("PANEL_START", 70_000)
    at.until(lambda: Answer.PANEL_ACTIVE in Answer(at.shown["live"]["handshake"]))
    at.says("TRIGGER", 1)
    at.until(lambda: at.station.trigger)
    at.inspects()
    at.run(0.5)
    assert at.results == [("PASS", 1, 70_000)]
    at.says("PANEL_END")
    at.until(lambda: Answer.PANEL_ACTIVE not in Answer(at.shown["live"]["handshake"]))


@pytest.mark.parametrize("outcome", [CommandResult.DONE, CommandResult.REFUSED])
def test_a_recipe_is_changed_or_the_refusal_told(bench: Callable[..., Bench], outcome: CommandResult) -> None:
    at = bench()
    at.until(at.ready)
    at.says("CHANGE_RECIPE", 70_003)
    at.until(lambda: at.station.command)
    assert at.station.command
    assert at.station.command.argument == 70_003
    at.says("CHANGE_RECIPE", 4)
    at.station.does(Obeys(outcome))
    at.run(1.0)
    told = [(each["argument"], each["done"], each["result"]) for each in at.told["Commands"]]
    assert told == [(4, False, "BUSY"), (70_003, outcome is CommandResult.DONE, outcome.name)]


@pytest.mark.parametrize(("topic", "payload"), [("TRIGGER", "one"), ("TRIGGER", -1), ("CHANGE_RECIPE", 0.5), ("X", 1)])
def test_what_cannot_be_asked_is_refused_by_name(bench: Callable[..., Bench], topic: str, payload: Any) -> None:
    at = bench()
    at.until(at.ready)
    at.says(topic, payload)
    assert len(at.errors) == 1
    assert topic in at.errors[0]
    at.run(0.5)
    assert (at.station.trigger, at.station.command) == (None, None)


def test_the_function_decodes_as_the_register_table_does(bench: Callable[..., Bench]) -> None:
    orders: tuple[WordOrder, ...] = ("high_first", "low_first")
    at = {order: bench(order=order) for order in orders}

    @settings(max_examples=15)
    @given(st.floats(0, 60_000, width=32), st.integers(0, 2**32 - 1), st.sampled_from(orders), st.floats(-300, 300))
    def holds(height_um: float, number: int, order: WordOrder, x_mm: float) -> None:
        seed = Defect(x_mm, -x_mm, height_um, None, (0.0, 0.0), (0.0, 0.0))
        live = Snapshot(panel_id=number, overruns=number, defects=(seed,), reasons=Reason.HEIGHT_LIMIT)
        at[order].station.live = live
        expected = registers.decode(at[order].image(), word_order=order)
        at[order].says("tick")
        read = at[order].shown["live"]
        assert read.keys() == expected.keys()
        assert read == pytest.approx(expected)

    holds()


def test_the_page_names_what_the_flow_was_tested_with() -> None:
    peers = json.loads((PEER.parent / "node-red" / "package.json").read_text())
    named = [*peers["dependencies"].values(), *(peer.split("@")[-1] for peer in peers["overrides"].values())]
    assert [version for version in named if version not in node_red.TESTED_WITH] == []
    assert node_red.MODBUS_NODES in peers["dependencies"]


def test_the_flow_is_wired_to_nodes_that_are_there() -> None:
    ids = [node["id"] for node in FLOW]
    assert len(ids) == len(set(ids))
    wired = {target for node in FLOW for targets in node.get("wires", ()) for target in targets}
    assert wired <= set(ids)
    topics = {node["topic"] for node in FLOW if node["type"] == "inject"}
    assert topics >= {command.name for command in Command if command}
