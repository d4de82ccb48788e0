"""The steps by which a controls engineer puts a station into service, as data, and their page. Pure.

A test carries every command out against a running station, in this order, and looks for what the page says must be
seen; what is done by hand it does at the station's devices.
"""

from __future__ import annotations

import enum
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from inspector.faults import Fault
from inspector.handshake import FIFO_RESULTS
from inspector.handshake_table import Answer, Command, CommandResult, Control
from inspector.model import Verdict
from inspector.publish.registers import CONTROL_FIELDS, MAP_VERSION, REGISTERS, RESULT_WORDS, Status

AT = {row.name: row for row in REGISTERS}
MBPOLL = "mbpoll -m tcp -a 1 -p PORT -0 -1"
SEQUENCE = "SEQUENCE"
"""Stands in a command for the `sequence` that was read last."""
_BITS: dict[str, type[enum.IntFlag]] = {"status": Status, "handshake": Answer}
_CODES: dict[str, type[enum.IntEnum]] = {"verdict": Verdict, "fault_code": Fault, "command_result": CommandResult}


@dataclass(frozen=True, slots=True)
class Look:
    """One register is read; all that is given must hold of it."""

    register: str
    among: tuple[int, ...] = ()
    """One of these."""
    on: int = 0
    """These bits are set."""
    off: int = 0
    """These are not."""
    than_before: Literal["", "other", "same", "not less", "one more"] = ""
    """How it compares with the same register when it was looked at last."""
    rounds_to: str = ""
    """Rounded, it is what this register showed last."""

    @property
    def command(self) -> str:
        """How mbpoll reads it."""
        row = AT[self.register]
        how = ":float -B" if row.type == "f32" else ":int -B" if row.words == 2 else ":hex" if self._bits else ""
        return f"{MBPOLL} -r {row.address} -t 3{how} HOST"

    @property
    def _bits(self) -> bool:
        return self.register in _BITS

    @property
    def sees(self) -> str:
        """What must be seen, in words."""
        return "; ".join(self._told()) or "any number: note it down"

    def _told(self) -> Iterator[str]:
        if self.among:
            yield " or ".join(self._value(value) for value in self.among)
        for bits, said in ((self.on, "set"), (self.off, "off")):
            if bits:
                yield f"{', '.join(str(bit.name) for bit in _BITS[self.register](bits))} {said} (0x{bits:04X})"
        if self.than_before:
            than = "as" if self.than_before == "same" else "than"
            yield f"{self.than_before} {than} before"
        if self.rounds_to:
            yield f"rounded, the same as {self.rounds_to}"

    def _value(self, value: int) -> str:
        return f"{value} {_CODES[self.register](value).name}" if self.register in _CODES else str(value)

    def holds(self, value: float, before: dict[str, float]) -> bool:
        """Whether ``value`` is what must be seen; ``before``: what registers showed last."""
        was = before.get(self.register, 0.0)
        compared = {
            "": True,
            "other": value != was,
            "same": value == was,
            "not less": value >= was,
            "one more": value == was + 1,
        }
        bits = int(value) if self._bits else 0
        return (
            (not self.among or value in self.among)
            and bits & self.on == self.on
            and not bits & self.off
            and compared[self.than_before]
            and (not self.rounds_to or round(value) == before[self.rounds_to])
        )


@dataclass(frozen=True, slots=True)
class Write:
    """The control block is written from its first register on, as far as there is something to say."""

    control: Control = Control(0)
    panel_id: int = 0
    command: int = 0
    argument: int = 0
    acknowledges: bool = False
    """With the sequence that was read last."""

    @property
    def words(self) -> tuple[int | str, ...]:
        """What is written; at least the first word."""
        halves = [half for long in (self.panel_id, self.argument) for half in divmod(long, 0x10000)]
        sequence = SEQUENCE if self.acknowledges else 0
        words: list[int | str] = [int(self.control), sequence, *halves[:2], self.command, 0, *halves[2:]]
        while len(words) > 1 and not words[-1]:
            words.pop()
        return tuple(words)

    @property
    def command_line(self) -> str:
        """How mbpoll writes it."""
        return f"{MBPOLL} -r {AT[CONTROL_FIELDS[0].name].address} -t 4 HOST {' '.join(map(str, self.words))}"

    @property
    def says(self) -> str:
        """What is asked for."""
        bits = ", ".join(str(bit.name) for bit in self.control)
        return bits or "nothing (all bits drop)"


@dataclass(frozen=True, slots=True)
class Run:
    """A command at the station; FILE is its settings file."""

    command: str
    sees: str


@dataclass(frozen=True, slots=True)
class ByHand:
    """Something that a person does; ``act`` is its name for whoever carries the page out."""

    text: str
    act: str = ""


Check = Look | Write | Run | ByHand


@dataclass(frozen=True, slots=True)
class Step:
    """A heading of the page and what is checked under it."""

    title: str
    text: str
    checks: tuple[Check, ...]


_C, _A, _S = Control, Answer, Status
_NONE = Control(0)
PANEL = 0x0001_0002
"""Its two registers differ, so that a wrong order shows."""
_SWAPPED = 0x0002_0001
_ENDED = _A.COMMAND_COMPLETED | _A.COMMAND_FAILED
_JUDGED = (int(Verdict.PASS), int(Verdict.FAIL))
_READY = Look("handshake", on=_A.ONLINE | _A.TRIGGER_READY)


def _triggered(panel_id: int, keep: Control = _NONE) -> tuple[Check, ...]:
    """A panel is triggered by the rules."""
    return (
        _READY,
        Write(keep | _C.TRIGGER, panel_id),
        Look("handshake", on=_A.TRIGGER_ACK),
        Write(keep, panel_id),
        Look("handshake", on=_A.RESULT_AVAILABLE, off=_A.TRIGGER_ACK),
    )


def _acknowledged(keep: Control = _NONE) -> tuple[Check, ...]:
    return (
        Look("sequence"),
        Write(keep | _C.RESULTS_ACK, acknowledges=True),
        Look("handshake", off=_A.RESULT_AVAILABLE),
        Write(keep),
    )


def _commanded(command: Command, argument: int, ended: Answer, result: CommandResult) -> tuple[Check, ...]:
    return (
        Write(_C.EXECUTE, command=command, argument=argument),
        Look("handshake", on=ended, off=_ENDED & ~ended),
        Look("command_result", among=(result,)),
        Write(),
        Look("handshake", off=_ENDED),
    )


def _pulled(what: str, act: str, faults: tuple[Fault, ...]) -> tuple[Check, ...]:
    return (
        ByHand(f"Pull {what}.", f"pull {act}"),
        Look("fault_code", among=tuple(map(int, faults))),
        Look("status", on=_S.FAULT, off=_S.READY | _S.RESULTS_VALID),
        Look("verdict", among=(int(Verdict.NOT_INSPECTED),)),
        Look("heartbeat"),
        Look("heartbeat", than_before="other"),
        ByHand("Put it back.", f"put back {act}"),
        Write(_C.CLEAR_FAULT),
        Look("fault_code", among=(int(Fault.NONE),)),
        Write(),
        _READY,
    )


STEPS = (
    Step(
        "Settings and network",
        "At the station, then from a computer with the PLC's address.",
        (
            Run("inspector config check FILE", "the settings are right"),
            Run("inspector recipe check --config FILE", "every recipe is right"),
            Look("map_version", among=(MAP_VERSION,)),
            ByHand(
                "From an address that is in `plc.allow` and not in `plc.allow_write`, write the control block: mbpoll"
                " must say `Illegal function`. From one that is not in `plc.allow`: no answer at all."
            ),
        ),
    ),
    Step(
        "The station is alive and real",
        f"The PLC's own program must see the same numbers in its {RESULT_WORDS} registers, and tell within two seconds"
        " that a heartbeat stands still. SIMULATED must be off on a production line; so far ACCEPT_SIMULATED, or"
        " `bAcceptSimulated`, is FALSE.",
        (
            Look("heartbeat"),
            Look("heartbeat", than_before="other"),
            Look("status", on=_S.READY | _S.LAMP_OK, off=_S.FAULT | _S.SIMULATED),
            Look("fault_code", among=(int(Fault.NONE),)),
        ),
    ),
    Step(
        "Trigger and result",
        "With `cycle.trigger.kind: plc`, and a panel with seeds in view.",
        (
            Look("sequence"),
            *_triggered(PANEL),
            Look("sequence", than_before="one more"),
            Look("status", on=_S.RESULTS_VALID, off=_S.FAULT),
            Look("verdict", among=_JUDGED),
            *_acknowledged(),
        ),
    ),
    Step(
        "Word order",
        f"The PLC's own program must show these numbers too. {_SWAPPED} instead of {PANEL}, or a height that makes no"
        " sense, is the other order: set `plc.word_order`, or the PLC's conversion. mbpoll's -B is high word first.",
        (
            Look("panel_id", among=(PANEL,)),
            Look("largest_height_um"),
            Look("largest_height_um_f32", rounds_to="largest_height_um"),
        ),
    ),
    Step(
        "Results that are kept",
        f"Two panels before the first is acknowledged; up to {FIFO_RESULTS} wait. See that the PLC's program takes each"
        " once.",
        (
            *_triggered(1, _C.BUFFER_RESULTS),
            *_triggered(2, _C.BUFFER_RESULTS),
            Look("results_waiting", among=(1,)),
            Look("panel_id", among=(1,)),
            *_acknowledged(_C.BUFFER_RESULTS),
            Look("handshake", on=_A.RESULT_AVAILABLE),
            Look("panel_id", among=(2,)),
            Look("results_waiting", among=(0,)),
        ),
    ),
    Step(
        "A PLC that starts again",
        "A result waits; the PLC's program begins with zeros, and finds the same result.",
        (
            Look("sequence"),
            Write(),
            Look("handshake", on=_A.RESULT_AVAILABLE),
            Look("sequence", than_before="same"),
            *_acknowledged(),
            ByHand("Switch the PLC off and on while a result waits: its program takes that result once."),
        ),
    ),
    Step(
        "A trigger that is missed",
        "OFFLINE makes sure that the station is not ready. The PLC's program must treat that panel as not inspected.",
        (
            Look("missed_triggers"),
            Write(_C.OFFLINE),
            Look("handshake", off=_A.ONLINE | _A.TRIGGER_READY),
            Write(_C.OFFLINE | _C.TRIGGER, 3),
            Look("handshake", on=_A.TRIGGER_MISSED, off=_A.TRIGGER_ACK),
            Look("missed_triggers", than_before="one more"),
            Write(_C.CLEAR_FAULT),
            Look("handshake", on=_A.TRIGGER_READY, off=_A.TRIGGER_MISSED),
            Write(),
        ),
    ),
    Step(
        "Panel start and end",
        "Results between the two carry the panel's id. With `panel.frames.kind: plc` the one result comes at the end:"
        " then leave out the trigger's own result, and look for it after PANEL_END.",
        (
            Write(_C.PANEL_START, PANEL),
            Look("handshake", on=_A.PANEL_ACTIVE),
            *_triggered(9, _C.PANEL_START),
            Look("panel_id", among=(PANEL,)),
            Write(_C.PANEL_END),
            Look("handshake", off=_A.PANEL_ACTIVE),
            *_acknowledged(),
        ),
    ),
    Step(
        "Recipe",
        "Recipe 2 stands for one of the station's (`inspector recipe list --config FILE`), 65000 for one that it does"
        " not have: that one is refused, and the old one stays.",
        (
            *_commanded(Command.CHANGE_RECIPE, 2, _A.COMMAND_COMPLETED, CommandResult.DONE),
            Look("recipe_id", among=(2,)),
            *_commanded(Command.CHANGE_RECIPE, 65_000, _A.COMMAND_FAILED, CommandResult.REFUSED),
            Look("recipe_id", among=(2,)),
            _READY,
        ),
    ),
    Step(
        "Faults",
        "The PLC's program must let no panel pass meanwhile. CLEAR_FAULT has the device tried at once, instead of after"
        " its back-off.",
        (
            *_pulled("the module's cable", "module", (Fault.MODULE_GONE, Fault.MODULE_SILENT)),
            *_triggered(10),
            ByHand("Pull the camera's cable and trigger a panel.", "pull camera"),
            Write(_C.TRIGGER, 11),
            Look("fault_code", among=(int(Fault.CAMERA_GONE), int(Fault.CAMERA_TIMEOUT))),
            Look("verdict", among=(int(Verdict.NOT_INSPECTED),)),
            ByHand("Put it back.", "put back camera"),
            Write(_C.CLEAR_FAULT),
            Look("fault_code", among=(int(Fault.NONE),)),
            Write(),
            *_acknowledged(),
            *_triggered(12),
            Look("verdict", among=_JUDGED),
            *_acknowledged(),
        ),
    ),
    Step(
        "A station that starts again",
        "With `plc.sequence_file` and `statistics_file` set. While it is off, the PLC's program must raise its alarm.",
        (
            Look("sequence"),
            Look("statistics_panels"),
            ByHand("Restart the service: `systemctl restart inspector`.", "restart"),
            _READY,
            Look("sequence", than_before="not less"),
            Look("verdict", among=(int(Verdict.NOT_INSPECTED),)),
            *_triggered(13),
            Look("sequence", than_before="not less"),
            Look("statistics_panels", than_before="not less"),
            *_acknowledged(),
        ),
    ),
    Step(
        "Posting",
        "Only with `plc.post`.",
        (
            ByHand(
                "The PLC's own registers from `plc.post.address` show the same `sequence` and `sequence_end`, and a"
                " heartbeat that moves. Pull the PLC's network cable, trigger three panels, put it back: all three"
                " come, in their order, each once."
            ),
        ),
    ),
    Step(
        "Hand over",
        "The control block is zero, no bit is left set by hand; the PLC's program takes over.",
        (
            Write(),
            Look("status", on=_S.READY, off=_S.FAULT | _S.SIMULATED | _S.SETTINGS_REFUSED),
            _READY,
            ByHand("The PLC's program lets a panel pass only with verdict 1, and none while the station is off."),
        ),
    ),
)


def page() -> str:
    """The page."""
    return _PAGE + "".join(_section(number, step) for number, step in enumerate(STEPS, 1))


def _section(number: int, step: Step) -> str:
    lines = "\n".join(f"- [ ] {number}.{place} {_told(check)}" for place, check in enumerate(step.checks, 1))
    return f"\n## {number}. {step.title}\n{step.text}\n\n{lines}\n"


def _told(check: Check) -> str:
    match check:
        case Look():
            return f"Read {check.register}: **{check.sees}**  \n  `{check.command}`"
        case Write():
            return f"Write {check.says}{_numbers(check)}  \n  `{check.command_line}`"
        case Run():
            return f"**{check.sees}**, exit status 0  \n  `{check.command}`"
        case ByHand():
            return f"By hand: {check.text}"


def _numbers(written: Write) -> str:
    names = {"panel": written.panel_id, "command": written.command, "argument": written.argument}
    told = [f"{name} {number}" for name, number in names.items() if number]
    told += ["the sequence as read"] if written.acknowledges else []
    return f" ({', '.join(told)})" if told else ""


_PAGE = f"""\
# Putting the station into service

For the controls engineer, in this order, each box once. mbpoll is a free Modbus client (Debian: apt install mbpoll).
HOST and PORT are the station's, FILE is its settings file, {SEQUENCE} the number that was read last as `sequence`. Run
the commands from where writes are allowed (`plc.allow_write`), while the PLC's program does not write. Registers are
named in `registers.md`, the rules are in `handshake.md`. What must be seen comes within a second, unless a device has
to be waited for; -t 3:hex shows bits as a hexadecimal number. With `plc.word_order: low_first` leave out -B, and swap
the two numbers of a panel's id and of an argument.

A test of the station's program carries these commands out against a running station, in this order.
"""
