"""A command of the page's, carried through the operator's block: what is written next, from what is read. Pure.

First the block is at rest, then EXECUTE rises together with command and argument, then the answer is awaited, then
EXECUTE drops. A write whose answer is lost may have arrived: the next look tells, and the same words written again are
no edge, so nothing is done twice.
"""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from inspector.handshake_table import Answer, Command, CommandResult, Control

DEADLINE_S = 30.0
"""A station that has not carried a command out by then is asked no longer."""
ENDED = Answer.COMMAND_COMPLETED | Answer.COMMAND_FAILED
AT_REST = (0,) * 8


class Deed(enum.Enum):
    """What people may ask for; each name is the wire's."""

    CHANGE_RECIPE = Command.CHANGE_RECIPE
    RESET_STATISTICS = Command.RESET_STATISTICS
    CLEAR_FAULT = Command.NONE


class Phase(enum.Enum):
    """How far a command has come."""

    RESTING = "the block is brought to rest"
    ASKED = "EXECUTE is raised"
    AWAITED = "the station has it"
    OVER = "it has ended"


class Outcome(enum.Enum):
    """How it ended."""

    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"
    LOST = "lost"
    LATE = "late"
    REFUSED = "refused"


@dataclass(frozen=True, slots=True)
class Asked:
    """A command on its way. ``number`` tells it from others of this page; ``asked_s`` is the caller's clock."""

    number: int
    deed: Deed
    argument: int
    asked_s: float
    phase: Phase = Phase.RESTING
    outcome: Outcome = Outcome.RUNNING
    code: CommandResult = CommandResult.NONE

    @property
    def words(self) -> tuple[int, ...]:
        """The block while this is asked; 32 bits high word first, see :func:`step`."""
        bit = Control.CLEAR_FAULT if self.deed is Deed.CLEAR_FAULT else Control.EXECUTE
        return (int(bit), 0, 0, 0, int(self.deed.value), 0, self.argument >> 16, self.argument & 0xFFFF)

    @property
    def over(self) -> bool:
        """Whether there is nothing left to do."""
        return self.phase is Phase.OVER


def step(asked: Asked, block: Mapping[str, Any], now_s: float) -> tuple[Asked, tuple[int, ...] | None]:
    """The command after a look at the operator's block, and what is to be written into it, None: nothing. The command
    has then gone on, whether or not the write succeeds."""
    if now_s > asked.asked_s + DEADLINE_S:
        return _over(asked, Outcome.LATE), AT_REST
    answers, bits = Answer(int(block["operator_handshake"])), int(block["operator_control"])
    if asked.phase is Phase.RESTING:
        if bits:
            return asked, AT_REST
        if answers:
            return asked, None  # of a command that was left: its end is waited for
        return replace(asked, phase=Phase.ASKED), asked.words
    is_ours = (bits, block["operator_command"], block["operator_argument"]) == (
        asked.words[0],
        asked.words[4],
        asked.argument,
    )
    if asked.phase is Phase.ASKED and not is_ours:
        return asked, asked.words
    if not is_ours:
        return _over(asked, Outcome.LOST), None
    if asked.deed is Deed.CLEAR_FAULT:
        return _over(asked, Outcome.DONE), AT_REST
    if not answers & ENDED:
        return replace(asked, phase=Phase.AWAITED), None
    code = CommandResult(int(block["operator_command_result"]))
    outcome = Outcome.DONE if Answer.COMMAND_COMPLETED in answers else Outcome.FAILED
    return _over(replace(asked, code=code), outcome), AT_REST


def overdue(asked: Asked, now_s: float) -> Asked:
    """The command while the station is away: it goes on when that is back, if that is soon."""
    late = not asked.over and now_s > asked.asked_s + DEADLINE_S
    return _over(asked, Outcome.LATE) if late else asked


def refused(asked: Asked) -> Asked:
    """The station does not take what is written."""
    return _over(asked, Outcome.REFUSED)


def _over(asked: Asked, outcome: Outcome) -> Asked:
    return replace(asked, phase=Phase.OVER, outcome=outcome)
