"""The handshake with the line's PLC as one table: (step, event) -> step and actions; and the words both sides use.

Four lines of handshake run beside each other: triggers, results, commands, panels. Each is at one :class:`Step`; what
the PLC writes and what the station does become :class:`Event` s, and :data:`TABLE` says what follows. A pair that is
not in the table changes nothing. :mod:`inspector.handshake` carries it out.
"""

from __future__ import annotations

import enum


class Control(enum.IntFlag):
    """Bits that the PLC writes, register `control`."""

    TRIGGER = 1 << 0
    RESULTS_ACK = 1 << 1
    BUFFER_RESULTS = 1 << 2
    OFFLINE = 1 << 3
    CLEAR_FAULT = 1 << 4
    PANEL_START = 1 << 5
    PANEL_END = 1 << 6
    EXECUTE = 1 << 7


class Answer(enum.IntFlag):
    """Bits by which the station answers, register `handshake`."""

    ONLINE = 1 << 0
    TRIGGER_READY = 1 << 1
    TRIGGER_ACK = 1 << 2
    TRIGGER_MISSED = 1 << 3
    RESULT_AVAILABLE = 1 << 4
    BUFFERING = 1 << 5
    OVERRUN = 1 << 6
    ACK_MISMATCH = 1 << 7
    PANEL_ACTIVE = 1 << 8
    COMMAND_EXECUTING = 1 << 9
    COMMAND_COMPLETED = 1 << 10
    COMMAND_FAILED = 1 << 11


CONTROL_MEANINGS = {
    Control.TRIGGER: "Rising: inspect one panel (trigger kind plc); drop it when TRIGGER_ACK is there",
    Control.RESULTS_ACK: "Rising: the result whose sequence is in acknowledged_sequence has been taken",
    Control.BUFFER_RESULTS: "While set, each result is kept until it is acknowledged; else the newest is shown at once",
    Control.OFFLINE: "While set, the station stays ready but inspects nothing",
    Control.CLEAR_FAULT: "Rising: drop TRIGGER_MISSED and OVERRUN, try failed devices at once",
    Control.PANEL_START: "Rising: a panel begins, its id in control_panel_id; ends the one before",
    Control.PANEL_END: "Rising: the panel ends",
    Control.EXECUTE: "Rising: carry out command; drop it when COMMAND_COMPLETED or COMMAND_FAILED is there",
}
ANSWER_MEANINGS = {
    Answer.ONLINE: "The station inspects when it is triggered; off while OFFLINE is set",
    Answer.TRIGGER_READY: "A TRIGGER that rises now is taken. Off in a cycle, and while the lamp follows a new level",
    Answer.TRIGGER_ACK: "The TRIGGER was taken; stays until TRIGGER drops. Its result will come",
    Answer.TRIGGER_MISSED: "A TRIGGER came while TRIGGER_READY was off; nothing was inspected. Until CLEAR_FAULT",
    Answer.RESULT_AVAILABLE: "The block shows a result that was not yet acknowledged",
    Answer.BUFFERING: "Results are kept until they are acknowledged",
    Answer.OVERRUN: "The FIFO was full: a result is lost, as overruns and a gap in sequence say. Until CLEAR_FAULT",
    Answer.ACK_MISMATCH: "RESULTS_ACK came with another sequence than the one shown; until RESULTS_ACK drops",
    Answer.PANEL_ACTIVE: "Between PANEL_START and PANEL_END",
    Answer.COMMAND_EXECUTING: "The command is being carried out",
    Answer.COMMAND_COMPLETED: "The command was carried out; until EXECUTE drops",
    Answer.COMMAND_FAILED: "The command was not carried out, command_result says why; until EXECUTE drops",
}


OPERATOR_CONTROL = Control.CLEAR_FAULT | Control.EXECUTE
"""What people at the operator's page may ask for, beside a PLC: nothing that belongs to a panel or its result."""
OPERATOR_ANSWER = Answer.COMMAND_EXECUTING | Answer.COMMAND_COMPLETED | Answer.COMMAND_FAILED
"""What they are answered."""


class Command(enum.IntEnum):
    """What the PLC may have done by `command` and EXECUTE."""

    NONE = 0
    CHANGE_RECIPE = 1
    RESET_STATISTICS = 2
    DISCARD_RESULTS = 3


class CommandResult(enum.IntEnum):
    """How the last command ended, register `command_result`."""

    NONE = 0
    DONE = 1
    UNKNOWN_COMMAND = 2
    BUSY = 3
    NOT_AVAILABLE = 4
    REFUSED = 5
    INTERNAL = 6


OPERATOR_COMMANDS = (Command.CHANGE_RECIPE, Command.RESET_STATISTICS)
"""Those that people may give too: a result that the PLC has not taken is for the PLC to forget."""

COMMAND_MEANINGS = {
    Command.NONE: "Nothing: EXECUTE fails with UNKNOWN_COMMAND",
    Command.CHANGE_RECIPE: "Inspect by the recipe whose id is in command_argument; the old one stays if that fails",
    Command.RESET_STATISTICS: "Begin the statistics anew, as after a repair; command_argument 1: their baselines too",
    Command.DISCARD_RESULTS: "Forget the results that were not acknowledged; they count as overruns",
}
RESULT_MEANINGS = {
    CommandResult.NONE: "No command yet, or it is being carried out",
    CommandResult.DONE: "Carried out",
    CommandResult.UNKNOWN_COMMAND: "There is no such command",
    CommandResult.BUSY: "EXECUTE rose again before the command before had ended; that one is carried out",
    CommandResult.NOT_AVAILABLE: "The station has nothing to do it with (recipes, statistics), or only the PLC may ask",
    CommandResult.REFUSED: "The argument is wrong or the recipe is not whole; the station's log names the place",
    CommandResult.INTERNAL: "A fault in the station's program; see its log",
}


class Step(enum.Enum):
    """Where a line of the handshake stands: triggers, results, commands, panels."""

    TRIGGER_LOW = "TRIGGER is low"
    TRIGGER_TAKEN = "TRIGGER was taken and is still high"
    TRIGGER_REFUSED = "TRIGGER was missed and is still high"
    RESULT_NONE = "every result was acknowledged"
    RESULT_OFFERED = "a result is shown and not yet acknowledged"
    RESULT_TAKEN = "RESULTS_ACK is high, nothing is offered until it drops"
    COMMAND_NONE = "no command"
    COMMAND_RUNS = "a command is being carried out"
    COMMAND_LEFT = "the same, and EXECUTE has dropped"
    COMMAND_CROWDED = "the same, and EXECUTE has risen again"
    COMMAND_DONE = "the command has ended, EXECUTE is still high"
    PANEL_NONE = "between panels"
    PANEL_BEGUN = "within a panel"


class Event(enum.Enum):
    """What the PLC writes, seen by its edges, and what the station does."""

    TRIGGER_WHEN_READY = "TRIGGER rises while TRIGGER_READY is set"
    TRIGGER_WHEN_NOT_READY = "TRIGGER rises while TRIGGER_READY is off"
    TRIGGER_DROPS = "TRIGGER drops"
    RESULT_WAITS = "a result is in the FIFO"
    ACK_OF_SHOWN = "RESULTS_ACK rises with the sequence shown"
    ACK_OF_OTHER = "RESULTS_ACK rises with another sequence"
    ACK_DROPS = "RESULTS_ACK drops"
    DISCARD = "the command DISCARD_RESULTS is carried out"
    EXECUTE_RISES = "EXECUTE rises"
    EXECUTE_DROPS = "EXECUTE drops"
    COMMAND_ENDS = "the station has carried the command out, or could not"
    PANEL_STARTS = "PANEL_START rises"
    PANEL_ENDS = "PANEL_END rises"


class Action(enum.Enum):
    """What is done on the way from one step to the next."""

    BEGIN_CYCLE = "a cycle begins"
    COUNT_MISSED = "missed_triggers rises by one, TRIGGER_MISSED is set"
    OFFER_NEXT = "the oldest result of the FIFO is shown"
    FLAG_MISMATCH = "ACK_MISMATCH is set"
    DROP_MISMATCH = "ACK_MISMATCH drops"
    CLEAR_FAULTS = "devices that failed are tried at once, and what only a new result would end is forgotten"
    RUN_COMMAND = "the command is carried out"
    KEEP_OUTCOME = "command_result shows how it ended"
    REFUSE_AS_BUSY = "command_result shows BUSY"
    START_PANEL = "results carry this panel's id"
    END_PANEL = "the panel is complete; one that was not begun has no verdict"


_A, _E, _S = Action, Event, Step
TABLE: dict[tuple[Step, Event], tuple[Step, tuple[Action, ...]]] = {
    (_S.TRIGGER_LOW, _E.TRIGGER_WHEN_READY): (_S.TRIGGER_TAKEN, (_A.BEGIN_CYCLE,)),
    (_S.TRIGGER_LOW, _E.TRIGGER_WHEN_NOT_READY): (_S.TRIGGER_REFUSED, (_A.COUNT_MISSED,)),
    (_S.TRIGGER_TAKEN, _E.TRIGGER_DROPS): (_S.TRIGGER_LOW, ()),
    (_S.TRIGGER_REFUSED, _E.TRIGGER_DROPS): (_S.TRIGGER_LOW, ()),
    (_S.RESULT_NONE, _E.RESULT_WAITS): (_S.RESULT_OFFERED, (_A.OFFER_NEXT,)),
    (_S.RESULT_NONE, _E.ACK_OF_SHOWN): (_S.RESULT_TAKEN, ()),
    (_S.RESULT_NONE, _E.ACK_OF_OTHER): (_S.RESULT_TAKEN, ()),
    (_S.RESULT_OFFERED, _E.ACK_OF_SHOWN): (_S.RESULT_TAKEN, ()),
    (_S.RESULT_OFFERED, _E.ACK_OF_OTHER): (_S.RESULT_OFFERED, (_A.FLAG_MISMATCH,)),
    (_S.RESULT_OFFERED, _E.ACK_DROPS): (_S.RESULT_OFFERED, (_A.DROP_MISMATCH,)),
    (_S.RESULT_OFFERED, _E.DISCARD): (_S.RESULT_NONE, (_A.DROP_MISMATCH,)),
    (_S.RESULT_TAKEN, _E.ACK_DROPS): (_S.RESULT_NONE, ()),
    (_S.COMMAND_NONE, _E.EXECUTE_RISES): (_S.COMMAND_RUNS, (_A.RUN_COMMAND,)),
    (_S.COMMAND_RUNS, _E.EXECUTE_DROPS): (_S.COMMAND_LEFT, ()),
    (_S.COMMAND_RUNS, _E.COMMAND_ENDS): (_S.COMMAND_DONE, (_A.KEEP_OUTCOME,)),
    (_S.COMMAND_LEFT, _E.COMMAND_ENDS): (_S.COMMAND_NONE, (_A.KEEP_OUTCOME,)),
    (_S.COMMAND_LEFT, _E.EXECUTE_RISES): (_S.COMMAND_CROWDED, ()),
    (_S.COMMAND_CROWDED, _E.EXECUTE_DROPS): (_S.COMMAND_LEFT, ()),
    (_S.COMMAND_CROWDED, _E.COMMAND_ENDS): (_S.COMMAND_DONE, (_A.REFUSE_AS_BUSY,)),
    (_S.COMMAND_DONE, _E.EXECUTE_DROPS): (_S.COMMAND_NONE, ()),
    (_S.PANEL_NONE, _E.PANEL_STARTS): (_S.PANEL_BEGUN, (_A.START_PANEL,)),
    (_S.PANEL_NONE, _E.PANEL_ENDS): (_S.PANEL_NONE, (_A.END_PANEL,)),
    (_S.PANEL_BEGUN, _E.PANEL_STARTS): (_S.PANEL_BEGUN, (_A.END_PANEL, _A.START_PANEL)),
    (_S.PANEL_BEGUN, _E.PANEL_ENDS): (_S.PANEL_NONE, (_A.END_PANEL,)),
}
