"""Commands of the PLC's and of the operator's page: which there are, and how an attempt at one ended."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping

from inspector.calibration_file import CalibrationError
from inspector.handshake import Order
from inspector.handshake_table import OPERATOR_COMMANDS, RESULT_MEANINGS, Command, CommandResult
from inspector.settings import SettingsError

log = logging.getLogger(__name__)

Handlers = Mapping[Command, Callable[[int], None]]
"""What carries a command out, given its argument; raises SettingsError, CalibrationError or OSError to refuse it."""


def carried_out(order: Order, handlers: Handlers) -> CommandResult:
    """Carry out a command; how it ended. What was refused, and why, is in the log."""
    try:
        command = Command(order.command)
    except ValueError:
        command = Command.NONE
    if command is Command.NONE:
        known = ", ".join(map(_named, handlers))
        log.error("%s command %d: there is none; known: %s", order.asker, order.command, known)
        return CommandResult.UNKNOWN_COMMAND
    what = f"{order.asker} command {_named(command)}, argument {order.argument}"
    handler = handlers.get(command)
    if handler is None or (order.by_operator and command not in OPERATOR_COMMANDS):
        log.error("%s refused: %s", what, RESULT_MEANINGS[CommandResult.NOT_AVAILABLE])
        return CommandResult.NOT_AVAILABLE
    try:
        handler(order.argument)
    except SettingsError as error:
        for problem in error.problems:
            log.error("%s refused: %s", what, problem)
        return CommandResult.REFUSED
    except (CalibrationError, OSError) as error:
        log.error("%s refused: %s", what, error)
        return CommandResult.REFUSED
    except Exception:
        log.exception("%s fails", what)
        return CommandResult.INTERNAL
    log.info("%s carried out", what)
    return CommandResult.DONE


def _named(command: Command) -> str:
    return f"{command.value} ({command.name})"
