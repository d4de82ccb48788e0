"""The integrator's page on the handshake: its rules, dialogues with what the registers show, and the table itself."""

from __future__ import annotations

import enum
from collections.abc import Iterable, Iterator, Sequence

from inspector.dialogues import DIALOGUES, Deed, Dialogue, Inspects, Obeys, Reconnects, Registers, Writes, played
from inspector.faults import Fault
from inspector.handshake import FIFO_RESULTS
from inspector.handshake_table import TABLE, Action, Answer, CommandResult, Control, Event, Step
from inspector.model import State, Verdict
from inspector.publish.registers import CONTROL_ADDRESS, OPERATOR_ADDRESS, RESULT_WORDS

WORDS: dict[str, type[enum.IntEnum | enum.IntFlag]] = {
    "handshake": Answer,
    "control": Control,
    "state": State,
    "fault_code": Fault,
    "verdict": Verdict,
    "command_result": CommandResult,
}
"""Registers whose numbers have names."""


def as_markdown() -> str:
    """The page."""
    return _PAGE.format(
        words=RESULT_WORDS,
        control=CONTROL_ADDRESS,
        operator=OPERATOR_ADDRESS,
        fifo=FIFO_RESULTS,
        dialogues="\n\n".join(_dialogue(dialogue) for dialogue in DIALOGUES),
        table=_table(("at", "when", "then", "what is done"), _rows()),
        steps=_meanings(Step),
        events=_meanings(Event),
        actions=_meanings(Action),
    )


def _dialogue(dialogue: Dialogue) -> str:
    """A dialogue as a Mermaid sequence diagram."""
    pace = "The PLC's TRIGGER begins each inspection." if dialogue.trigger == "plc" else "The camera sets the pace."
    lines = ["sequenceDiagram", "    participant P as PLC", "    participant S as Station"]
    before: Registers = {}
    for deed, shown in played(dialogue):
        if deed is not None:
            lines.append(f"    {_told(deed)}")
        changed = {name: value for name, value in shown.items() if value != before.get(name, 0)}
        lines.append(f"    S-->>P: {_values(changed) or 'as before'}")
        before = shown
    diagram = "\n".join(lines)
    return f"### {dialogue.title}\n{dialogue.text} {pace}\n\n```mermaid\n{diagram}\n```"


def _told(deed: Deed) -> str:
    """A deed as a line of a diagram."""
    match deed:
        case Writes():
            words = {name: int(getattr(deed, name)) for name in deed.__slots__}
            given = {name: value for name, value in words.items() if value or name == "control"}
            return f"P->>S: writes {_values(given)}"
        case Inspects():
            return f"Note over S: inspects, {deed.verdict.name if deed.verdict else 'and its program fails'}"
        case Obeys(outcome=CommandResult.DONE):
            return "Note over S: has carried out the command"
        case Obeys():
            return "Note over S: refuses the command"
        case Reconnects():
            return "Note over P: loses its connection, makes another"


def _values(values: Registers) -> str:
    return ", ".join(f"{name} = {_value(name, number)}" for name, number in values.items())


def _value(name: str, number: int) -> str:
    """A number as the wire has it, and its name."""
    names = WORDS.get(name)
    if names is None:
        return str(number)
    if issubclass(names, enum.IntFlag):
        bits = " ".join(str(bit.name) for bit in names if bit.value & number)
        return f"0x{number:04X} {bits}".rstrip()
    return f"{number} {names(number).name}"


def _rows() -> Iterator[tuple[str, str, str, str]]:
    for (step, event), (then, actions) in TABLE.items():
        yield step.name, event.name, then.name, ", ".join(action.name for action in actions)


def _meanings(kind: type[Step | Event | Action]) -> str:
    return _table(("name", "meaning"), ((member.name, member.value) for member in kind))


def _table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    return "\n".join("| " + " | ".join(line) + " |" for line in [header, ["---"] * len(header), *rows])


_PAGE = """\
# Handshake with the PLC

Made from `inspector/handshake_table.py` by `inspector handshake`; a test fails when this page is stale, and another one
plays each dialogue over the wire and compares every value shown here. Addresses and bits: `registers.md`.

A PLC that only polls needs none of this: `sequence` and `verdict` are enough. With the handshake it triggers, takes
every result once, and gives commands.

## Rules
1. Each cycle, read the result block ({words} registers at 0) in one request, and write the control block (from
   {control}) in one request. Write the numbers (sequence, panel id, command) together with the bit that they belong
   to, or before it.
2. Bits are looked at by their edges. A bit that stays high asks once; its answer stays until the bit drops.
3. RESULT_AVAILABLE: the block shows a result that was not acknowledged, which may be NOT_INSPECTED. Act on `verdict`
   only as `registers.md` says. Acknowledge by writing the block's `sequence` to acknowledged_sequence and raising
   RESULTS_ACK; drop it when RESULT_AVAILABLE is off.
4. With BUFFER_RESULTS (or `plc.buffer_results` in the station's settings) a result stays until it is acknowledged, and
   up to {fifo} wait behind it. What finds no room is lost, counted in `overruns` and flagged by OVERRUN.
5. While there is a fault every verdict reads NOT_INSPECTED, also that of a result that waits; it shows its own again
   when the fault is gone. Acknowledge it then, or at once if the panel is to be treated as not inspected.
6. `sequence` rises from result to result and never goes back: over a restart of the station as long as
   `plc.sequence_file` is set. Results that were waiting at a restart are lost, as the gap shows. After a crash of the
   station the gap may be larger than what was lost.
7. A PLC that has lost its memory finds the result that it has not acknowledged, with the same `sequence`. One that
   keeps the sequence it took last knows it again.
8. Edges of one write count in this order: RESULTS_ACK, CLEAR_FAULT, PANEL_END, PANEL_START, TRIGGER, EXECUTE.
9. The station begins with zeros in the control block. A TRIGGER that is still high then counts as a new one, and is
   missed until the station is ready.
10. The station must show a new `heartbeat` within two seconds, whatever it was asked.
11. People at the operator's page change the recipe too, clear faults and reset the statistics, by a block of their own
   (from {operator}) that no PLC writes. Their CLEAR_FAULT leaves TRIGGER_MISSED and OVERRUN to the PLC, and what they
   ask for shows in none of the PLC's answers: see `recipe_id`. Another recipe takes the
   last verdict back (NOT_INSPECTED) unless it is held: a PLC that must not miss one sets BUFFER_RESULTS, and one that
   decides the recipe alone `page.allow_commands: false`.

## Dialogues
What the PLC reads is shown as far as it has changed; in the first line, what is not shown is 0. Numbers are as on the
wire.

{dialogues}

## The table
Four lines of handshake run beside each other: TRIGGER, RESULT, COMMAND, PANEL. What is not in it changes nothing.

{table}

### Steps
{steps}

### Events
{events}

### Actions
{actions}
"""
