"""The PLC's commands: which there are, and how an attempt at one ended."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping

from inspector.calibration_file import CalibrationError
from inspector.handshake import Order
from inspector.handshake_table import Command, CommandResult
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
        log.error("PLC command %d: there is none; known: %s", order.command, ", ".join(map(_named, handlers)))
        return CommandResult.UNKNOWN_COMMAND
    handler = handlers.get(command)
    if handler is None:
        log.error("PLC command %s: this station has nothing to do it with", _named(command))
        return CommandResult.NOT_AVAILABLE
    try:
        handler(order.argument)
    except SettingsError as error:
        for problem in error.problems:
            log.error("PLC command %s, argument %d refused: %s", _named(command), order.argument, problem)
        return CommandResult.REFUSED
    except (CalibrationError, OSError) as error:
        log.error("PLC command %s, argument %d refused: %s", _named(command), order.argument, error)
        return CommandResult.REFUSED
    except Exception:
        log.exception("PLC command %s, argument %d fails", _named(command), order.argument)
        return CommandResult.INTERNAL
    log.info("PLC command %s, argument %d carried out", _named(command), order.argument)
    return CommandResult.DONE


def _named(command: Command) -> str:
    return f"{command.value} ({command.name})"
