"""The files of `deploy/plc`: what each is called, what it is for, and who makes it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from firmware_bridge import whole_file
from inspector import lifecycle
from inspector.commands import handshake_page
from inspector.integrator import byte_examples, commissioning, node_red, structured_text
from inspector.publish import registers_page
from inspector.publish.registers import MAP_VERSION


@dataclass(frozen=True, slots=True)
class Made:
    """A file of the package."""

    name: str
    purpose: str
    make: Callable[[], str]


FILES = (
    Made("registers.md", "Every register, bit and code, and how to poll", registers_page.as_markdown),
    Made("registers.csv", "The registers alone, for import into an engineering tool", registers_page.as_csv),
    Made("states.md", "The station's states, as the register `state` shows them", lifecycle.markdown),
    Made("handshake.md", "Trigger, results, commands: rules, dialogues, state table", handshake_page.as_markdown),
    Made("bytes.md", "Whole messages, each byte explained", byte_examples.as_markdown),
    Made(
        "FB_SeedInspector.st",
        "IEC 61131-3 function block and data types: polls, decodes, triggers, takes results, changes the recipe",
        structured_text.function_block,
    ),
    Made("structured_text.md", "How that block is bound to a PLC's Modbus client", structured_text.binding_page),
    Made("node-red-flow.json", "A Node-RED flow that does the same and raises alarms, see below", node_red.flow),
    Made("commissioning.md", "Putting the station into service: steps, commands, what to see", commissioning.page),
)


def index() -> str:
    """The package's README."""
    rows = "\n".join(f"| [{made.name}]({made.name}) | {made.purpose} |" for made in FILES)
    settings = "\n".join(f"| {name} | {value} | {meaning} |" for name, value, _, meaning in node_red.SETTINGS)
    return _INDEX.format(
        version=MAP_VERSION,
        rows=rows,
        nodes=node_red.MODBUS_NODES,
        tested=node_red.TESTED_WITH,
        settings=settings,
    )


ALL = (Made("README.md", "", index), *FILES)


def write(folder: Path) -> list[Path]:
    """Write every file into ``folder``, each whole or not at all. Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    for made in ALL:
        whole_file.write(folder / made.name, made.make())
    return [folder / made.name for made in ALL]


_INDEX = """\
# For the controls engineer

All that a PLC's program needs to know of the paint inspection station, register map version {version}. Every file here
is made from the station's own tables by `inspector plc-package --output deploy/plc`; do not edit them.

| file | what it is for |
| --- | --- |
{rows}

In short: poll 125 registers at address 0, Modbus TCP, function 3 or 4. A panel is good only while the heartbeat moves,
the status says RESULTS_VALID and not FAULT, and the verdict is 1. Zero is never a good panel.

## Node-RED
The flow needs the nodes of the npm package `{nodes}`: in the editor, Manage palette, Install; or, in
Node-RED's user directory, `npm install {nodes}`. Then import `node-red-flow.json`, double-click its
tab, set what differs, and deploy:

| in the tab's properties | as it comes | what it is |
| --- | --- | --- |
{settings}

Buttons trigger a panel, begin and end one, change the recipe, clear faults; your own nodes send the same messages to
*Inspection*, whose head says what it takes and gives. The status under it shows state, last verdict and height; the
debug sidebar shows results, alarms, lost panels and ended commands; the flow's context `seed_inspector` holds all
registers. A panel is good only in a message of *Inspection*'s third output with `payload.verdict` PASS.

So that no result is taken twice over a restart of Node-RED either, let its settings keep context in files:
`contextStorage: {{default: {{module: "localfilesystem"}}}}`.

Tested with {tested};
by hand also with Node-RED 5.0.7, its nodes' 5.60.2 (with the same) and Node.js 22. Try trigger, fault and recipe with
your own versions before production, by commissioning.md.
"""
