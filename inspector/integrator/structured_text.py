"""The PLC's side as an IEC 61131-3 function block: a template for the logic, everything else from the tables. Pure."""

from __future__ import annotations

import enum
from collections.abc import Iterable
from importlib.resources import files
from string import Template
from typing import Any

from inspector.handshake_table import Answer, Command, CommandResult, Control
from inspector.model import Verdict
from inspector.publish.registers import (
    BLOCK_DEFECTS,
    CONTROL_ADDRESS,
    CONTROL_FIELDS,
    DEFECT_FIELDS,
    DEFECT_WORDS,
    FIRST_BLOCK_DEFECT,
    MAP_VERSION,
    RESULT_ADDRESS,
    RESULT_FIELDS,
    RESULT_WORDS,
    Status,
)
from inspector.publish.wire_fields import TYPES, Field

READ, WRITE = 3, 16
"""Functions that every maker's client has."""
CONTROL_WRITTEN = max(field.address + TYPES[field.type].words for field in CONTROL_FIELDS)
_ENDED = Answer.COMMAND_COMPLETED | Answer.COMMAND_FAILED
_CONTROL_NAMES = {
    "control": "wControl",
    "acknowledged_sequence": "uiAcknowledged",
    "control_panel_id": "udiWrittenPanel",
    "command": "uiWantedCommand",
    "command_argument": "udiWantedArgument",
}
"""What of the block goes into each field of the control block."""


def function_block() -> str:
    """The whole source."""
    template = Template(files("inspector.integrator").joinpath("FB_SeedInspector.template.st").read_text("utf-8"))
    return template.substitute(
        map_version=MAP_VERSION,
        read_function=READ,
        write_function=WRITE,
        result_address=RESULT_ADDRESS,
        result_words=RESULT_WORDS,
        last_read=RESULT_WORDS - 1,
        control_address=CONTROL_ADDRESS,
        control_words=CONTROL_WRITTEN,
        last_written=CONTROL_WRITTEN - 1,
        control_at=CONTROL_FIELDS[0].address,
        block_defects=BLOCK_DEFECTS,
        defect_fields=_members(DEFECT_FIELDS),
        result_fields=_members(RESULT_FIELDS),
        constants="\n".join(f"  {line}" for line in _constants()),
        decoded="\n".join(f"  {line}" for line in _decoded()),
        encoded="\n".join(f"  {line}" for line in _encoded()),
    )


def _members(fields: Iterable[Field[Any]]) -> str:
    return "\n".join(f"  {f.name} : {_type(f)}; (* {f.unit}: {f.meaning} *)" for f in fields)


def _type(field: Field[Any]) -> str:
    if field.scale != 1 or field.type == "f32":
        return "REAL"
    if field.unit == "bits":
        return "WORD"
    return {"u16": "UINT", "i16": "INT", "u32": "UDINT"}[field.type]


def _constants() -> Iterable[str]:
    yield f"MAP_VERSION : UINT := {MAP_VERSION};"
    yield "NO_BITS : WORD := 16#0000;"
    flags: tuple[tuple[str, type[enum.IntFlag]], ...] = (("STATUS", Status), ("ANSWER", Answer), ("CONTROL", Control))
    for prefix, kind in flags:
        yield from (f"{prefix}_{bit.name} : WORD := 16#{bit.value:04X};" for bit in kind)
    yield f"ANSWERS_COMMAND_ENDED : WORD := 16#{_ENDED.value:04X};"
    codes: tuple[tuple[str, type[enum.IntEnum]], ...] = (
        ("VERDICT", Verdict),
        ("COMMAND", Command),
        ("RESULT", CommandResult),
    )
    for prefix, names in codes:
        yield from (f"{prefix}_{code.name} : UINT := {code.value};" for code in names)


def _decoded() -> Iterable[str]:
    for field in RESULT_FIELDS:
        yield f"stLive.{field.name} := {_value(field, field.address)};"
    for slot in range(BLOCK_DEFECTS):
        at = FIRST_BLOCK_DEFECT + slot * DEFECT_WORDS
        for each in DEFECT_FIELDS:
            yield f"stLive.defects[{slot + 1}].{each.name} := {_value(each, at + each.address)};"


def _value(field: Field[Any], at: int) -> str:
    word = f"awRead[{at}]"
    if TYPES[field.type].words == 2:
        long = f"F_SeedUdint(wFirst := {word}, wSecond := awRead[{at + 1}], bLowWordFirst := bLowWordFirst)"
        return f"F_SeedReal(udiBits := {long})" if field.type == "f32" else long
    if field.unit == "bits":
        return word
    integer = "INT" if field.type == "i16" else "UINT"
    number = f"WORD_TO_{integer}({word})"
    return number if field.scale == 1 else f"{integer}_TO_REAL({number}) * {field.scale:.10f}".rstrip("0")


def _encoded() -> Iterable[str]:
    for field in CONTROL_FIELDS:
        value = _CONTROL_NAMES[field.name]
        if TYPES[field.type].words == 1:
            yield f"awWrite[{field.address}] := {value if field.unit == 'bits' else f'UINT_TO_WORD({value})'};"
            continue
        high, low = (f"UINT_TO_WORD(UDINT_TO_UINT({value} {half} 65536));" for half in ("/", "MOD"))
        yield "IF bLowWordFirst THEN"
        yield f"  awWrite[{field.address}] := {low}"
        yield f"  awWrite[{field.address + 1}] := {high}"
        yield "ELSE"
        yield f"  awWrite[{field.address}] := {high}"
        yield f"  awWrite[{field.address + 1}] := {low}"
        yield "END_IF"


def binding_page() -> str:
    """How a maker's Modbus client is bound to the block."""
    return _BINDING.format(
        read=READ,
        write=WRITE,
        words=RESULT_WORDS,
        control=CONTROL_ADDRESS,
        control_words=CONTROL_WRITTEN,
        s7_result=40001 + RESULT_ADDRESS,
        s7_control=40001 + CONTROL_ADDRESS,
        change=Command.CHANGE_RECIPE.name,
    )


_BINDING = """\
# The function block and your Modbus client

`FB_SeedInspector.st` holds two data types, two functions and the block, in plain IEC 61131-3: import the text or paste
each part into an object of its own. It is tested by a parser of the language and by carrying it out, call by call,
against the station's handshake; not on your PLC: try trigger, fault and recipe with it before production.

Call it once a cycle. It asks for one exchange at a time: while `bExchange` is TRUE, do what `uiFunction` says ({read}:
read `uiWords` registers from `uiAddress` into `awRead`; {write}: write `uiWords` registers of `awWrite` to
`uiAddress`), hold `bExchangeDone` or `bExchangeError` TRUE when it has ended, and FALSE again once `bExchange` is
FALSE. There are two exchanges only: {words} registers read from 0, and {control_words} written to {control}. Unit id
1; addresses are zero-based.

## In your program
```
Station(bEnable := TRUE, bTrigger := PartInPlace, udiPanelId := PartNumber, awRead := Registers,
        bExchangeDone := ClientDone, bExchangeError := ClientError);
IF Station.bNewResult THEN
  IF Station.bPass AND Station.stResult.panel_id = PartNumber THEN
    PartIsGood := TRUE;
  END_IF
END_IF
IF Station.bPanelLost OR Station.bFault THEN
  PartIsGood := FALSE;  (* not inspected *)
END_IF
```
`PartIsGood` starts FALSE with each part. Another recipe: `uiCommand := {change}` (its number is a constant of the
block), `udiArgument` the recipe's id, `bExecute` TRUE until `bCommandDone` or `bCommandFailed`.

- `bPass`, `bFail`, `bNotInspected` are TRUE in one call only, together with `bNewResult`: nothing stale can be read.
- Results come at any time, also of a panel that was given up (`bPanelLost`): compare `stResult.panel_id`.
- In a fault a waiting result is taken as not inspected, rather than kept for later.
- Make `udiLastTaken` retentive, and set `plc.sequence_file` in the station's settings: then a result is taken once
  also over a restart of either side.
- A command that has to wait longer than `tCommand`, or a trigger than `tTrigger`, is given up: choose both by your
  line.

## CODESYS
Device tree: Modbus TCP Master, Modbus TCP Server with two channels, both with a rising edge as trigger: function
{read}, offset 0, length {words}; function {write}, offset {control}, length {control_words}. `bExchange` triggers the
one that `uiFunction` names; map its registers to `awRead` and `awWrite`. Done and error come from the channel's status
bits, or from a function block of the Modbus library that carries the channel out.

## TwinCAT 3 (TF6250, library Tc2_ModbusSrv)
`FB_MBReadRegs` and `FB_MBWriteRegs`: `nUnitID` 1, `nQuantity` := `uiWords`, `nMBAddr` := `uiAddress`, `cbLength` twice
`uiWords`, the data's address of `awRead` or `awWrite`, `bExecute` := `bExchange` of the one that `uiFunction` names.
Done is NOT `bBusy` AND NOT `bError` after it was busy; hold it until `bExchange` falls. Call the other with `bExecute`
FALSE.

## SIMATIC S7-1200 and S7-1500
One `MB_CLIENT`; `REQ` := `bExchange`. Reading: `MB_MODE` 0, `MB_DATA_ADDR` {s7_result}, `MB_DATA_LEN` {words},
`MB_DATA_PTR` at `awRead`. Writing: `MB_MODE` 1, `MB_DATA_ADDR` {s7_control}, `MB_DATA_LEN` {control_words}, at
`awWrite`. `DONE` and `ERROR` stand for one call: latch them until `bExchange` falls. In SCL, data types become PLC
data types, constants the block's own, and `TON` is `TON_TIME`. `MB_CLIENT` connects to `plc.port`; the registers' data
block is not optimised.
"""
