"""The files of `deploy/plc`: what each is called, what it is for, and who makes it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from firmware_bridge import whole_file
from inspector import handshake_page
from inspector.integrator import byte_examples, structured_text
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
    Made("handshake.md", "Trigger, results, commands: rules, dialogues, state table", handshake_page.as_markdown),
    Made("bytes.md", "Whole messages, each byte explained", byte_examples.as_markdown),
    Made(
        "FB_SeedInspector.st",
        "IEC 61131-3 function block and data types: polls, decodes, triggers, takes results, changes the recipe",
        structured_text.function_block,
    ),
    Made("structured_text.md", "How that block is bound to a PLC's Modbus client", structured_text.binding_page),
)


def index() -> str:
    """The package's README."""
    rows = "\n".join(f"| [{made.name}]({made.name}) | {made.purpose} |" for made in FILES)
    return _INDEX.format(version=MAP_VERSION, rows=rows)


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
"""
