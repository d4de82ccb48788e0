"""The PLC's side as a Node-RED flow: a template for the logic, everything else from the tables. Pure."""

from __future__ import annotations

import enum
import hashlib
import json
import math
from collections.abc import Iterable, Iterator
from importlib.resources import files
from string import Template
from typing import Any

from inspector.faults import Fault
from inspector.handshake_table import Answer, Command, CommandResult, Control
from inspector.integrator.structured_text import CONTROL_WRITTEN, READ, WRITE
from inspector.model import Reason, State, Verdict
from inspector.publish.registers import (
    BLOCK_DEFECTS,
    CONTROL_ADDRESS,
    CONTROL_FIELDS,
    MAP_VERSION,
    RESULT_ADDRESS,
    RESULT_REGISTERS,
    RESULT_WORDS,
    Status,
)
from inspector.publish.wire_fields import EXACT_UNITS, TYPES

TICK_S = 0.05
HEARTBEAT_S = 2.0
MODBUS_NODES = "node-red-contrib-modbus"
"""The npm package whose nodes speak Modbus."""
TESTED_WITH = f"Node-RED 4.1.15, {MODBUS_NODES} 5.45.2 (with modbus-serial 8.0.25 for its fork of it) and Node.js 20"
SETTINGS = (
    ("STATION_HOST", "127.0.0.1", "str", "the station's address"),
    ("STATION_PORT", "502", "num", "its port, `plc.port`"),
    ("STATION_UNIT", "1", "num", "one of its `plc.unit_ids`"),
    ("LOW_WORD_FIRST", "false", "bool", "true with `plc.word_order: low_first`"),
    ("ACCEPT_SIMULATED", "false", "bool", "true for trials alone: SIMULATED is no alarm then, and its panels may pass"),
)
"""What a plant sets, in the properties of the flow's tab."""
Wires = Iterable[Iterable[str]]
"""For each output, the nodes that it leads to."""
OUTPUTS = ("Read", "Write", "Results", "Alarms", "Lost panels", "Commands")
ALARMS = {
    "": ("The station is alive and has no fault", "Nothing to do"),
    "NO_ANSWER": ("The station does not answer, or refuses", "Check STATION_HOST, STATION_PORT and plc.allow"),
    "HEARTBEAT": ("The station's heartbeat stands still", "Treat panels as not inspected; see the station's log"),
    "MAP_VERSION": ("The station has another register map", "Import the flow of the station's own version"),
    "TORN": ("The result block was not read in one request", "Let nothing between split the request"),
    "SIMULATED": ("Camera, lamp or module is not real", "Only for trials: set ACCEPT_SIMULATED"),
}
"""Causes of an alarm beside the station's own faults: meaning and remedy."""


def flow() -> str:
    """The flow, as Node-RED imports it."""
    return json.dumps([*_frame(), *_asking(), *_exchange(), *_telling()], indent=1) + "\n"


def function() -> str:
    """What the flow's function node carries out with each message."""
    template = Template(files("inspector.integrator").joinpath("node_red_station.template.js").read_text("utf-8"))
    return template.substitute(
        map_version=MAP_VERSION,
        command_names=", ".join(command.name for command in Command if command),
        tick_s=TICK_S,
        heartbeat_s=HEARTBEAT_S,
        constants="\n".join(f"const {name} = {json.dumps(value)};" for name, value in _constants()),
        block_defects=BLOCK_DEFECTS,
        read_function=READ,
        write_function=WRITE,
        result_address=RESULT_ADDRESS,
        result_words=RESULT_WORDS,
        control_address=CONTROL_ADDRESS,
    )


def _constants() -> Iterator[tuple[str, Any]]:
    yield "MAP_VERSION", MAP_VERSION
    yield "CONTROL_WORDS", CONTROL_WRITTEN
    yield "FIELDS", [(r.name, r.address, r.type, r.scale, r.unit in EXACT_UNITS) for r in RESULT_REGISTERS]
    yield "CONTROL_FIELDS", [(field.name, field.address, field.type) for field in CONTROL_FIELDS]
    yield "NOTHING", {name: wire.nothing for name, wire in TYPES.items() if not math.isnan(wire.nothing)}
    codes: tuple[tuple[str, Iterable[enum.IntEnum | enum.IntFlag]], ...] = (
        ("STATE", State),
        ("STATUS", Status),
        ("VERDICT", Verdict),
        ("REASON", Reason),
        ("ANSWER", Answer),
        ("CONTROL", Control),
        ("COMMAND", Command),
        ("COMMAND_RESULT", CommandResult),
        ("FAULT", Fault),
    )
    for name, members in codes:
        yield name, {member.name: member.value for member in members}
    yield "FAULT_TEXTS", {fault.name: (fault.meaning, fault.remedy) for fault in Fault if fault}
    yield "ALARM_TEXTS", ALARMS


def node_id(name: str) -> str:
    """An id as the editor makes them, the same each time."""
    return hashlib.sha256(f"seed inspector {name}".encode()).hexdigest()[:16]


def _node(
    kind: str, name: str, at: tuple[int, int], wires: Iterable[Iterable[str]] = (), **more: Any
) -> dict[str, Any]:
    """A node of the tab, wired to others by their names."""
    wired = [[node_id(target) for target in targets] for targets in wires]
    return {
        "id": node_id(name),
        "type": kind,
        "z": node_id("tab"),
        "name": name,
        "x": at[0],
        "y": at[1],
        "wires": wired,
    } | more


def _frame() -> Iterator[dict[str, Any]]:
    """The tab with its settings, and the Modbus client that takes its place from them."""
    env = [{"name": name, "value": value, "type": kind} for name, value, kind, _ in SETTINGS]
    yield {
        "id": node_id("tab"),
        "type": "tab",
        "label": "Paint inspection",
        "disabled": False,
        "info": _INFO,
        "env": env,
    }
    yield {
        "id": node_id("client"),
        "type": "modbus-client",
        "z": node_id("tab"),
        "name": "Station",
        "clienttype": "tcp",
        "tcpHost": "${STATION_HOST}",
        "tcpPort": "${STATION_PORT}",
        "tcpType": "DEFAULT",
        "unit_id": "${STATION_UNIT}",
        "bufferCommands": True,
        "commandDelay": 1,
        "clientTimeout": 1000,
        "reconnectOnTimeout": True,
        "reconnectTimeout": 1000,
        "parallelUnitIdsAllowed": True,
        "stateLogEnabled": False,
        "queueLogEnabled": False,
        "failureLogEnabled": False,
        "showErrors": False,
        "showWarnings": False,
        "showLogs": False,
    }


def buttons() -> Iterator[tuple[str, str, str, str]]:
    """The flow's buttons: name, topic, payload and its type."""
    yield "Trigger, next panel", Control.TRIGGER.name or "", "", "str"
    yield "Panel 1000 begins", Control.PANEL_START.name or "", "1000", "num"
    yield "Panel ends", Control.PANEL_END.name or "", "", "str"
    yield "Clear fault", Control.CLEAR_FAULT.name or "", "", "str"
    yield "Offline", Control.OFFLINE.name or "", "true", "bool"
    yield "Online", Control.OFFLINE.name or "", "false", "bool"
    yield "Change to recipe 2", Command.CHANGE_RECIPE.name, "2", "num"
    yield "Reset statistics", Command.RESET_STATISTICS.name, "0", "num"
    yield "Discard results", Command.DISCARD_RESULTS.name, "0", "num"


def _inject(name: str, topic: str, payload: str, kind: str, y: int, **more: Any) -> dict[str, Any]:
    defaults = {"props": [{"p": "payload"}, {"p": "topic", "vt": "str"}], "repeat": "", "crontab": "", "once": False}
    given = {"onceDelay": 0.1, "topic": topic, "payload": payload, "payloadType": kind}
    return _node("inject", name, (160, y), [["Inspection"]], **defaults, **given) | more


def _asking() -> Iterator[dict[str, Any]]:
    yield _node("comment", "Host and port: double-click the tab. What is asked of the station:", (260, 40))
    yield _inject("Clock", "tick", "", "str", 100, repeat=str(TICK_S), once=True)
    for row, button in enumerate(buttons()):
        yield _inject(*button, y=160 + 40 * row)


def _exchange() -> Iterator[dict[str, Any]]:
    told = [[name] for name in OUTPUTS]
    start = "context.set('station', undefined);"
    parts = {"func": function(), "outputs": len(OUTPUTS), "initialize": start, "finalize": "", "libs": [], "timeout": 0}
    yield _node("function", "Inspection", (430, 300), told, **parts)
    shared: dict[str, Any] = {"showStatusActivities": True, "showErrors": True, "showWarnings": False}
    shared |= {"server": node_id("client"), "emptyMsgOnFail": False, "keepMsgProperties": True, "delayOnStart": False}
    shared |= {"startDelayTime": ""}
    reading = {"logIOActivities": False, "useIOFile": False, "ioFile": "", "useIOForPayload": False}
    reading |= {"enableDeformedMessages": False}
    back = [["Inspection"], []]
    yield _node("modbus-flex-getter", "Read", (660, 140), back, **shared, **reading)
    yield _node("modbus-flex-write", "Write", (660, 200), back, **shared)
    yield _node(
        "catch", "No answer", (660, 80), [["Inspection"]], scope=[node_id("Read"), node_id("Write")], uncaught=False
    )


def _telling() -> Iterator[dict[str, Any]]:
    shown: dict[str, Any] = {"active": True, "tosidebar": True, "console": False, "tostatus": False}
    shown |= {"complete": "payload", "targetType": "msg", "statusVal": "", "statusType": "auto"}
    for row, name in enumerate(OUTPUTS[2:]):
        yield _node("debug", name, (660, 280 + 60 * row), **shown)


_INFO = f"""\
The paint inspection station, register map version {MAP_VERSION}. Needs the nodes of `{MODBUS_NODES}`.

Set in this tab's properties: STATION_HOST, STATION_PORT; LOW_WORD_FIRST as the station's `plc.word_order`.
ACCEPT_SIMULATED is for trials: on a production line it stays false.

Wire your own nodes to the outputs of *Inspection*: a panel is good only in a message of its third output whose
`payload.verdict` is PASS, and only the panel `payload.panel_id`. Triggers are messages with topic TRIGGER and the
panel's id as payload. What was read last is the flow's context `seed_inspector`.
"""
