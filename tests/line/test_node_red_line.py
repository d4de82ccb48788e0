"""The integrator's flow in a real Node-RED, against a real station: each result once, in order, as the registers say.

Node-RED with its Modbus nodes comes from npm: a minute and 130 MB, so this is for `make soak`.
"""

from __future__ import annotations

import contextlib
import json
import re
import signal
import subprocess
import threading
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from inspector.handshake_table import Answer, Control
from inspector.integrator import node_red
from inspector.publish.registers import CONTROL_ADDRESS
from inspector.sequence_file import AHEAD

pytestmark = [pytest.mark.long, pytest.mark.timeout(900)]
PEERS = Path(__file__).parents[1] / "peers"
SETTINGS = """module.exports = {uiHost: "127.0.0.1", uiPort: 0, flowFile: "flow.json", credentialSecret: false,
  telemetry: {enabled: false}, logging: {console: {level: "info"}}};
"""
OF_THEIR_MOMENT = ("heartbeat", "state", "status", "handshake", "result_age_ms")
"""Registers that go on changing while a result is shown."""


class NodeRed:
    """Node-RED with one flow; what its debug sidebar shows, and its buttons."""

    def __init__(self, node: str, modules: Path, folder: Path, wait_until: Callable[..., Any]) -> None:
        self._wait_until, self.told = wait_until, {name: [] for name in node_red.OUTPUTS[2:]}
        red = str(modules / "node_modules" / "node-red" / "red.js")
        command = [node, red, "--userDir", str(folder), "--settings", str(folder / "settings.js")]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        self.log: list[str] = []
        self._readers = [self._gather(self.process, self.log.append)]
        wait_until(lambda: any("Started flows" in line for line in self.log), f"flows; log: {self.log}", 120)
        said = (re.search(r"running at http://127\.0\.0\.1:(\d+)/", line) for line in self.log)
        self._port = next(int(found[1]) for found in said if found)
        sidebar = [node, str(PEERS / "node_red_debug.mjs"), str(self._port), str(modules)]
        self._sidebar = subprocess.Popen(sidebar, stdout=subprocess.PIPE, text=True)
        opened = threading.Event()

        def take(line: str) -> None:
            told = json.loads(line)
            if told["name"] == "open":
                opened.set()
            else:
                self.told[told["name"]].append(told["payload"])

        self._readers.append(self._gather(self._sidebar, take))
        assert opened.wait(60)

    @staticmethod
    def _gather(process: subprocess.Popen[str], take: Callable[[str], Any]) -> threading.Thread:
        def run() -> None:
            assert process.stdout
            for line in process.stdout:
                take(line.rstrip("\n"))

        thread = threading.Thread(target=run, daemon=True)
        thread.start()
        return thread

    def press(self, button: str, payload: int | None = None) -> None:
        """Press a button, as in the editor; with another payload than its own."""
        topic = next(topic for name, topic, *_ in node_red.buttons() if name == button)
        given = [{"p": "topic", "v": topic, "vt": "str"}, {"p": "payload", "v": str(payload), "vt": "num"}]
        body = json.dumps({} if payload is None else {"__user_inject_props__": given}).encode()
        address = f"http://127.0.0.1:{self._port}/inject/{node_red.node_id(button)}"
        request = urllib.request.Request(address, body, {"Content-Type": "application/json"})
        with urllib.request.urlopen(request, timeout=30) as answer:
            assert answer.status == 200

    def is_alive(self) -> bool:
        """Whether the flow says that the station is, in the context that the editor shows."""
        address = f"http://127.0.0.1:{self._port}/context/flow/{node_red.node_id('tab')}"
        with urllib.request.urlopen(address, timeout=30) as answer:
            kept = json.load(answer)["memory"]
        return "seed_inspector" in kept and '"alive":true' in kept["seed_inspector"]["msg"]

    def until(self, name: str, count: int) -> list[Any]:
        """What this debug node has shown, once it is so much."""
        self._wait_until(lambda: len(self.told[name]) >= count, f"{count} of {name}; log: {self.log}", 60)
        return self.told[name]

    def causes(self) -> list[str]:
        return [told["cause"] for told in self.told["Alarms"]]

    def close(self) -> None:
        for process in (self._sidebar, self.process):
            process.kill()
        for reader in self._readers:
            reader.join(30)
        for process in (self._sidebar, self.process):
            process.communicate()


@pytest.fixture(scope="module")
def modules(npm_peers: Callable[..., Path]) -> Path:
    return npm_peers(PEERS / "node-red", "node-red and node-red-contrib-modbus", 600)


@pytest.fixture
def node_red_with(
    modules: Path, peer: Callable[[str, str], str], tmp_path: Path, wait_until: Callable[..., Any]
) -> Iterator[Callable[[int], NodeRed]]:
    """``node_red_with(port)``: Node-RED at work with the flow; only the tab's port and SIMULATED are set otherwise."""
    node = peer("node", "nodejs")
    with contextlib.ExitStack() as stack:

        def start(port: int) -> NodeRed:
            folder = tmp_path / "node-red"
            folder.mkdir()
            flow = json.loads(node_red.flow())
            env = {each["name"]: each for each in flow[0]["env"]}
            env["STATION_PORT"]["value"], env["ACCEPT_SIMULATED"]["value"] = str(port), "true"
            (folder / "flow.json").write_text(json.dumps(flow))
            (folder / "settings.js").write_text(SETTINGS)
            started = NodeRed(node, modules, folder, wait_until)
            stack.callback(started.close)
            return started

        yield start


@pytest.fixture
def triggered(station: Any) -> Any:
    """A station without hardware that the PLC triggers, with two recipes, whose results are buffered."""
    recipes = station.folder / "recipes"
    recipes.mkdir()
    for number in (1, 2):
        (recipes / f"{number}.yaml").write_text(yaml.safe_dump({"id": number, "name": f"recipe {number}"}))
    station.settings |= {
        "camera": {"kind": "replay", "paths": ["frames"], "rate_hz": 20, "deadline_s": 1},
        "module": {"profile": "tm-da1p1r1", "link": {"kind": "simulated"}, "deadline_s": 1.0},
        "cycle": {"trigger": {"kind": "plc"}},
        "plc": {"port": 0, "buffer_results": True, "sequence_file": "sequence.json"},
        "recipes": "recipes",
        "recipe": 1,
    }
    station.write()
    return station


def of_result(registers: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in registers.items() if name not in OF_THEIR_MOMENT}


def test_a_real_node_red_takes_each_result_once_and_tells_a_stopped_station(
    triggered: Any, service: Callable[..., Any], node_red_with: Callable[[int], NodeRed], wait_until: Callable[..., Any]
) -> None:
    running = service()
    port = running.port
    running.until(lambda r: Answer.TRIGGER_READY in Answer(r["handshake"]), "ready for triggers")
    red = node_red_with(port)
    plc = running.plc()
    wait_until(red.is_alive, "the flow sees a heartbeat", 60)

    for count in range(1, 7):
        red.press("Trigger, next panel")
        taken = red.until("Results", count)[-1]
        assert (taken["sequence"], taken["panel_id"]) == (count, count)
        assert of_result(taken["registers"]) == pytest.approx(of_result(plc.read()))
    said = [re.match(r"#(\d+) .*?(PASS|FAIL|NOT_INSPECTED)", line).groups() for line in running.lines_to(6)]
    assert said == [(str(told["sequence"]), told["verdict"]) for told in red.told["Results"]]
    assert {verdict for _, verdict in said} == {"PASS", "FAIL"}
    assert any(told["heights_um"] for told in red.told["Results"])
    plc.until(wait_until, lambda r: Answer.RESULT_AVAILABLE not in Answer(r["handshake"]), "all acknowledged")

    # While the other side is held up, results wait; then they are taken, each once and in order.
    red.process.send_signal(signal.SIGSTOP)
    for panel in (101, 102, 103):
        plc.until(wait_until, lambda r: Answer.TRIGGER_READY in Answer(r["handshake"]), "ready")
        assert plc.write(CONTROL_ADDRESS, Control.TRIGGER | Control.BUFFER_RESULTS, 0, 0, panel) == 0
        assert plc.write(CONTROL_ADDRESS, Control.BUFFER_RESULTS, 0, 0, panel) == 0
    plc.until(wait_until, lambda r: r["results_waiting"] == 2, "three results")
    red.process.send_signal(signal.SIGCONT)
    assert [told["panel_id"] for told in red.until("Results", 9)[6:]] == [101, 102, 103]

    red.press("Change to recipe 2")
    assert red.until("Commands", 1) == [{"command": "CHANGE_RECIPE", "argument": 2, "done": True, "result": "DONE"}]
    red.press("Change to recipe 2", 9)
    assert red.until("Commands", 2)[1] == {
        "command": "CHANGE_RECIPE", "argument": 9, "done": False, "result": "REFUSED"}  # fmt: skip
    assert plc.read()["recipe_id"] == 2

    # A station that hangs, and one that has stopped.
    before = len(red.told["Alarms"])
    running.send(signal.SIGSTOP)
    assert red.until("Alarms", before + 1)[-1]["alarm"] is True
    running.send(signal.SIGCONT)
    assert red.until("Alarms", before + 2)[-1]["alarm"] is False
    running.send(signal.SIGTERM)
    assert running.ended() == 0
    assert red.until("Alarms", before + 3)[-1]["alarm"] is True
    assert red.told["Alarms"][-1]["cause"] in ("NO_ANSWER", "HEARTBEAT")

    triggered.settings["plc"]["port"] = port
    triggered.write()
    again = service()
    assert again.port == port
    again.until(lambda r: Answer.TRIGGER_READY in Answer(r["handshake"]), "ready for triggers")
    wait_until(lambda: not red.told["Alarms"][-1]["alarm"], f"no alarm: {red.causes()}", 60)
    red.press("Trigger, next panel")
    last = red.until("Results", 10)[-1]
    assert 9 < last["sequence"] <= 10 + AHEAD
    assert [told["sequence"] for told in red.told["Results"][:9]] == list(range(1, 10))
    assert len(red.told["Results"]) == 10
    assert red.told["Lost panels"] == []
