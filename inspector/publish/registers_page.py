"""The register map for people and tools: rows as text table, CSV, JSON, and the integrator's page in Markdown."""

from __future__ import annotations

import csv
import enum
import io
import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from inspector.faults import Fault
from inspector.handshake_table import (
    ANSWER_MEANINGS,
    COMMAND_MEANINGS,
    CONTROL_MEANINGS,
    OPERATOR_COMMANDS,
    RESULT_MEANINGS,
    Answer,
    Command,
    CommandResult,
    Control,
)
from inspector.line_statistics import ACTION_MEANINGS, RULE_MEANINGS, Spread, Trend
from inspector.model import Defect, Flag, Reason, Snapshot, State, Verdict
from inspector.publish import registers
from inspector.publish.registers import (
    CONTROL_REGISTERS,
    LIST_REGISTERS,
    OPERATOR_REGISTERS,
    REGISTERS,
    RESULT_REGISTERS,
    STATISTICS_REGISTERS,
    STATUS_MEANINGS,
    Register,
)
from inspector.publish.statistics_registers import (
    STATISTICS_ADDRESS,
    STATISTICS_STATUS_MEANINGS,
    STATISTICS_WORDS,
)
from inspector.publish.wire_fields import TYPES

COLUMNS = ("name", "address", "type", "words", "scale", "unit", "access", "meaning")

STATE_MEANINGS = {
    State.PREOPERATIONAL: "Starting: settings, devices or calibration are not ready",
    State.INITIALIZED: "Set up, devices not yet proven",
    State.READY: "Waiting for a trigger or a panel",
    State.SINGLE_EXECUTION: "Inspecting one panel",
    State.CONTINUOUS_EXECUTION: "Inspecting at its own pace",
    State.HALTED: "Stopped on purpose; nothing is inspected",
    State.ERROR: "See fault_code; recovers by itself when the cause is gone",
}

EXCEPTIONS = (
    (1, "Unknown function"),
    (2, "Some address is outside every area, or is not writable"),
    (3, "Count or value not allowed (a read takes 1 to 125 registers or 2000 bits; reserved bits are written as 0)"),
    (4, "A fault of the station's own; see its log"),
    (6, "Busy: too many PANEL_START and PANEL_END wait for the cycle. Nothing was written; write it again"),
    (11, "Unit id not served here (0, 1 and 255 are, unless configured)"),
)

EXAMPLE = Snapshot(
    state=State.CONTINUOUS_EXECUTION,
    sequence=42,
    verdict=Verdict.FAIL,
    reasons=Reason.HEIGHT_LIMIT,
    defects=(Defect(12.34, -5.6, 1827.6, 9.0, (0.0, 0.0), (0.0, 0.0)),),
    result_at_s=0.0,
    lamp_ok=True,
    camera_ok=True,
)


def as_rows(rows: Iterable[Register] = REGISTERS) -> list[dict[str, str | int | float]]:
    """One dict a register, with the keys of :data:`COLUMNS`."""
    return [{column: getattr(row, column) for column in COLUMNS} for row in rows]


def as_json() -> str:
    """A JSON list, one object a line."""
    return "[\n" + ",\n".join(json.dumps(row) for row in as_rows()) + "\n]\n"


def as_csv() -> str:
    """Comma separated, one header line."""
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(as_rows())
    return text.getvalue()


def as_table() -> str:
    """Columns padded with spaces, for a terminal."""
    lines = [COLUMNS, *(tuple(str(value) for value in row.values()) for row in as_rows())]
    widths = [max(len(line[i]) for line in lines) for i in range(len(COLUMNS))]
    return "".join("  ".join(c.ljust(w) for c, w in zip(line, widths, strict=True)).rstrip() + "\n" for line in lines)


def as_markdown() -> str:
    """The integrator's page."""
    return _PAGE.format(
        version=registers.MAP_VERSION,
        block_words=registers.RESULT_WORDS,
        block_defects=registers.BLOCK_DEFECTS,
        control_address=registers.CONTROL_ADDRESS,
        control_words=registers.CONTROL_WORDS,
        list_address=registers.LIST_ADDRESS,
        list_end=registers.LIST_ADDRESS + registers.LIST_END,
        list_defects=registers.LIST_DEFECTS,
        first_listed=registers.LIST_ADDRESS + registers.FIRST_LIST_DEFECT,
        defect_words=registers.DEFECT_WORDS,
        types=_types(),
        ready_coil=_coil("handshake", Answer.TRIGGER_READY),
        trigger_coil=_coil("control", Control.TRIGGER),
        result=_markdown_table(COLUMNS, (tuple(row.values()) for row in as_rows(RESULT_REGISTERS))),
        control=_markdown_table(COLUMNS, (tuple(row.values()) for row in as_rows(CONTROL_REGISTERS))),
        listing=_markdown_table(COLUMNS, (tuple(row.values()) for row in as_rows(_shortened_list()))),
        statistics_address=STATISTICS_ADDRESS,
        statistics_words=STATISTICS_WORDS,
        statistics=_markdown_table(COLUMNS, (tuple(row.values()) for row in as_rows(STATISTICS_REGISTERS))),
        statistics_bits=_bit_table("statistics_status", STATISTICS_STATUS_MEANINGS),
        rules=_meanings(RULE_MEANINGS),
        actions=_meanings(ACTION_MEANINGS),
        trends=_codes(Trend),
        spreads=_codes(Spread),
        verdicts=_codes(Verdict),
        states=_markdown_table(("code", "name", "meaning"), ((s.value, s.name, STATE_MEANINGS[s]) for s in State)),
        status=_bit_table("status", STATUS_MEANINGS),
        answers=_bit_table("handshake", ANSWER_MEANINGS),
        operator_address=registers.OPERATOR_ADDRESS,
        operator_commands=" and ".join(command.name for command in OPERATOR_COMMANDS),
        operator=_markdown_table(COLUMNS, (tuple(row.values()) for row in as_rows(OPERATOR_REGISTERS))),
        asked=_bit_table("control", CONTROL_MEANINGS),
        commands=_markdown_table(
            ("code", "name", "meaning"), ((c.value, c.name, COMMAND_MEANINGS[c]) for c in Command)
        ),
        outcomes=_markdown_table(
            ("code", "name", "meaning"), ((c.value, c.name, RESULT_MEANINGS[c]) for c in CommandResult)
        ),
        reasons=_bits(Reason),
        flags=_bits(Flag),
        faults=_markdown_table(
            ("code", "name", "meaning", "remedy"), ((f.value, f.name, f.meaning, f.remedy) for f in Fault)
        ),
        exceptions=_markdown_table(("code", "when"), EXCEPTIONS),
        example=_example(),
    )


FORMATS = {"table": as_table, "csv": as_csv, "json": as_json, "markdown": as_markdown}


def _shortened_list() -> list[Register]:
    """The defect list's registers with the first defect alone: the others follow from it."""
    second = registers.LIST_ADDRESS + registers.FIRST_LIST_DEFECT + registers.DEFECT_WORDS
    end = registers.LIST_ADDRESS + registers.LIST_END
    return [row for row in LIST_REGISTERS if row.address < second or row.address == end]


def _markdown_table(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(str(cell) for cell in line) + " |" for line in lines)


def _bit(flag: enum.IntFlag) -> int:
    return int(flag).bit_length() - 1


def _bits(kind: type[enum.IntFlag]) -> str:
    return _markdown_table(("bit", "name"), ((_bit(flag), flag.name) for flag in kind))


def _coil(register: str, bit: enum.IntFlag) -> int:
    """The number by which a register's bit is read alone."""
    return registers.REGISTER_BITS * next(row.address for row in REGISTERS if row.name == register) + _bit(bit)


def _bit_table(register: str, meanings: Mapping[Any, str]) -> str:
    rows = ((_bit(bit), _coil(register, bit), bit.name, meaning) for bit, meaning in meanings.items())
    return _markdown_table(("bit", "coil", "name", "meaning"), rows)


def _meanings(meanings: Mapping[Any, str]) -> str:
    """Codes with what each means."""
    return _markdown_table(("code", "name", "meaning"), ((m.value, m.name, text) for m, text in meanings.items()))


def _codes(kind: type[enum.IntEnum]) -> str:
    return _markdown_table(("code", "name"), ((member.value, member.name) for member in kind))


def _types() -> str:
    rows = ((name, t.words, f"{t.lowest:.10g} to {t.highest:.10g}", f"{t.nothing:.10g}") for name, t in TYPES.items())
    return _markdown_table(("type", "registers", "measured values", "no value"), rows)


def _example() -> str:
    """The head of an answer, in bytes and in words, packed by the same code that serves it."""
    block = registers.encode(EXAMPLE, now_s=1.5, heartbeat=7)
    words = 14
    values = registers.decode([int.from_bytes(block[i : i + 2], "big") for i in range(0, 2 * words, 2)])
    told = "\n".join(f"{name} = {value}" for name, value in values.items())
    head = bytes.fromhex("0001 0000 00fd 01 04 fa") + block[: 2 * words]
    return f"request  00 01 00 00 00 06 01 04 00 00 00 7d\nanswer   {head.hex(' ')} ...\n\n{told}"


_PAGE = """\
# Registers of the paint inspection station

Map version {version}, from `inspector registers --format markdown`. The whole list, for import: `registers.csv`.

## How to poll
Modbus TCP, function 3 or 4 (both answer alike: holding registers mirror input registers), unit id 0, 1 or 255. Read
{block_words} registers at address 0 in one request: that is one complete result, never a mixture of two. All addresses
here are zero-based, as on the wire; a manual's 30001 or 40001 is address 0. To look with a public tool:

    mbpoll -m tcp -p PORT -0 -r 0 -c {block_words} -t 3 -1 HOST       # -t 4: the same through function 3
    mbpoll -m tcp -p PORT -0 -r 12 -t 3:float -B -1 HOST     # largest_height_um_f32, high word first

1. `heartbeat` must change within two seconds; else the station is dead: treat the panel as not inspected.
2. `status` must have READY, must not have FAULT, and on a production line must not have SIMULATED.
3. A changed `sequence` is a new result. Act on `verdict` only while RESULTS_VALID is set: 1 is good, everything else is
   not. A gap in `sequence` is a result you did not see.
4. `result_age_ms` says how old the result is; a stopped line is not a fault, only an old result.

Who may connect is set in the station's settings; unless they say otherwise, only programs on the station itself.
Idle connections are closed: poll at least as often as the settings' idle time-out, or reconnect.

## When the station writes
With `plc.post` in its settings the station also writes the result block into holding registers of the PLC, by function
16, beside being served. It needs {block_words} registers in one row, and writes the first two of them last.

1. A new result is there when `sequence` differs from the one taken last and equals `sequence_end`. Take it whole, then
   put its `sequence` into the acknowledge register, if one is set: the next result comes only then. Keep that register
   over a restart.
2. Without an acknowledge register the next result follows at once, and a slow program misses some, as gaps show.
3. While nothing is new the block is written again each `period_s`: `heartbeat` must change within two seconds.
4. Results wait in a queue while the PLC is away and come in their order. What finds no room is lost, counted in
   `overruns`; `results_waiting` and the handshake bits RESULT_AVAILABLE and OVERRUN are the queue's own.

## Conventions
value = register * scale, in the unit given. Units `id`, `tick`, `code` and `bits` mark exact numbers, which wrap; all
others saturate at the range's end and set SATURATED_VALUE. 32-bit values lie high word first unless the settings say
`low_first`. Registers not named inside an area are reserved and read 0. Those of access R are read-only.

{types}

## Single bits
For programs that work with coils: bit b of register r is coil and discrete input 16 * r + b. Functions 1 and 2 read the
bits of every register here, both alike; 5 and 15 write those of the control block and leave its other bits as they are.
The tables of bits below name each one's number (`coil`). Bits read one by one are not of one result: read the block.

    mbpoll -m tcp -p PORT -0 -r {ready_coil} -t 1 -1 HOST         # TRIGGER_READY
    mbpoll -m tcp -p PORT -0 -r {trigger_coil} -t 0 HOST 1          # TRIGGER

## Result block, address 0
The {block_defects} highest defects come highest first; unused places are 0. A defect whose height could not be measured
counts as the highest.

{result}

## Control block, address {control_address}
What the PLC writes, by functions 5, 6, 15, 16, 22 and 23: {control_words} registers, all 0 when the station starts,
read back as written. Reserved bits and words must be 0. A PLC that only polls need not write anything: with zeros the
station inspects by its own triggers. One client should write, and no more: the block has no owner. People have a block
of their own, at {operator_address}.

{control}

## Operator's block, address {operator_address}
What the operator's page (`inspector page`) writes: its first {control_words} registers, which lie as the control
block's do, with the bits CLEAR_FAULT and EXECUTE and the commands {operator_commands}; the answers follow.
The two blocks know nothing of each other: a PLC that writes its whole block each cycle neither drops nor repeats what
people ask for, and these can neither trigger nor take a result. Commands of both are carried out one after the other,
in the order in which they came; `recipe_id` says which recipe a result was found by. A PLC never writes here.

A recipe changed by people may come just behind a result, or between TRIGGER_READY and TRIGGER. To a PLC that buffers,
or has acknowledged a result before, the one it has not acknowledged stays as it was found; to others its verdict is
taken back to NOT_INSPECTED. A TRIGGER that comes while the lamp follows its new level is missed, and flagged.

{operator}

## Control bits
{asked}

## Handshake bits
{answers}

## Commands
{commands}

### Command results
{outcomes}

## Defect list, address {list_address}
All defects of the same result, up to {list_defects}, highest first. Defect n begins at address
{first_listed} + {defect_words} * (n - 1); only the first is shown here. The list takes more than one read: read
{list_address} first and {list_end} last, and read again if the two differ.

{listing}

## Statistics, address {statistics_address}
How the paint line is doing after the newest result, for a control loop: one read of {statistics_words} registers. What
is not known yet has no value. `action` is advice and no command; act on it while VALID is set, the age is what your
line's pace makes it, and `confidence` is enough for you. Command RESET_STATISTICS begins the charts anew, as after a
repair (its argument 1: also the baselines, when the line is in order as it is now). How each number comes about, and
how soon a change is found: `docs/loop.md`.

{statistics}

### Statistics bits
{statistics_bits}

### Alarm rules
{rules}

### Actions
{actions}

### Trends
{trends}

### Spreads
{spreads}

## Verdicts
{verdicts}

## States
{states}

## Status bits
{status}

## Reason bits
{reasons}

## Defect flags
{flags}

## Fault codes
{faults}

## Modbus exceptions
An answer is never short or empty: it is whole, or an exception (function + 128, then the code).

{exceptions}

## Worked example
```
{example}
```
"""
