"""Every word that the page shows, by a key: one table, which a plant's own file may translate.

What the station's tables say (faults, rules, actions, reasons) is taken from them, as far as it speaks to people and
not of registers; the words here are the page's own.
"""

from __future__ import annotations

import enum
from collections.abc import Iterable, Mapping
from typing import Any

from inspector.faults import Fault
from inspector.handshake_table import COMMAND_MEANINGS, RESULT_MEANINGS
from inspector.line_statistics import ACTION_MEANINGS, RULE_MEANINGS
from inspector.model import Flag, Reason
from inspector.publish.registers_page import STATE_MEANINGS

Texts = Mapping[str, str]

_OWN: dict[str, str] = {
    "language": "en",
    "title": "Paint inspection",
    "verdict.PASS": "PASS",
    "verdict.FAIL": "FAIL",
    "verdict.NOT_INSPECTED": "NOT INSPECTED",
    "verdict.NO_STATION": "NO STATION",
    "link.connecting": "Connecting to the station",
    "link.down": "The station does not answer",
    "link.still": "The station's heartbeat stands still",
    "link.up": "Station answers",
    "link.remedy": "Treat panels as not inspected. Look whether the service runs: systemctl status inspector",
    "page.down": "This page's own program does not answer",
    "page.down.remedy": "What it showed last is hidden: it may be old. It goes on by itself when the program is back",
    "page.loading": "Loading",
    "card.fault": "Fault",
    "card.map": "Seeds on the panel",
    "card.station": "Station",
    "card.statistics": "Paint line",
    "card.history": "Recent results",
    "label.state": "State",
    "label.recipe": "Recipe",
    "label.lamp": "Lamp",
    "label.camera": "Camera",
    "label.exposure": "Exposure",
    "label.missed": "Missed triggers",
    "label.overruns": "Overruns",
    "label.late": "Late cycles",
    "label.waiting": "Held for the PLC",
    "label.passed": "Passed",
    "label.failed": "Failed",
    "label.not_inspected": "Not inspected",
    "label.per_panel": "Seeds a panel, recent",
    "label.ratio": "Against the usual",
    "label.trend": "Trend",
    "label.spread": "Lie",
    "label.median": "Median height",
    "label.p95": "95 % are below",
    "label.blind": "Not inspected, recent",
    "label.place": "Come back at",
    "label.sequence": "No.",
    "label.time": "Time",
    "label.verdict": "Verdict",
    "label.seeds": "Seeds",
    "value.seeds.none": "no seeds",
    "value.seeds.one": "1 seed",
    "value.seeds.many": "{count} seeds",
    "value.largest": "highest {height} µm",
    "value.unmeasured": "not measured",
    "value.panel": "Panel {panel}",
    "value.age.s": "{age} s ago",
    "value.age.min": "{age} min ago",
    "value.age.h": "{age} h ago",
    "value.no_result": "No result yet",
    "value.gap": "{count} not seen here",
    "value.works": "works",
    "value.fails": "does not work",
    "value.recipe": "{id}  {name}",
    "value.recipe.unknown": "{id}  (not in the settings as they are now)",
    "value.no_alarm": "No alarm",
    "value.no_statistics": "No statistics: too few panels yet, or the last one was not inspected",
    "value.confidence": "sure to {percent} %",
    "value.limit": "limit {height} µm",
    "note.simulated": "SIMULATED: not a real panel",
    "note.lamp_weak": "Change the bulb soon",
    "note.settings_refused": "New settings were refused; the old ones hold",
    "note.saturated": "Some value is beyond its register's range",
    "note.list_truncated": "More seeds than are listed",
    "note.offline": "The PLC has set the station offline",
    "rule.REPEATED_PLACE": "Defects at one place on panel after panel",
    "rule.HEIGHT_ABOVE": "Seeds are higher than usual",
    "rule.HEIGHT_BELOW": "Seeds are lower than usual",
    "rule.HEIGHT_PATTERN": "Mean heights in a pattern that chance seldom makes",
    "trend.UNKNOWN": "not known",
    "trend.STEADY": "steady",
    "trend.RISING": "rising",
    "trend.FALLING": "falling",
    "spread.UNKNOWN": "not known",
    "spread.RANDOM": "at random",
    "spread.CLUSTERED": "in clusters",
    "spread.EVEN": "evenly",
    "button.recipe": "Change recipe",
    "button.clear": "Clear fault",
    "button.reset": "Reset statistics",
    "button.cancel": "Cancel",
    "button.confirm": "Do it",
    "dialog.recipe": "Choose a recipe",
    "dialog.recipe.note": "Panels from now on are judged by it. A panel under way ends without a verdict.",
    "dialog.recipe.used": "in use",
    "dialog.recipe.stale": "The settings cannot be read just now ({why}); these were read last.",
    "dialog.clear": "Clear the fault?",
    "dialog.clear.note": "Devices that failed are tried again at once. A fault whose cause lasts comes back.",
    "dialog.reset": "Reset the statistics?",
    "dialog.reset.note": "Charts begin anew, as after a repair; what the line usually does stays known.",
    "dialog.password": "Password",
    "command.CHANGE_RECIPE": "Change to recipe {argument}",
    "command.RESET_STATISTICS": "Reset statistics",
    "command.CLEAR_FAULT": "Clear fault",
    "outcome.running": "is being carried out",
    "outcome.done": "COMPLETED",
    "outcome.failed": "FAILED, code {code}",
    "outcome.lost": "FAILED: the station has forgotten it, or another page has taken its place; see the recipe shown",
    "outcome.late": "FAILED: no end within {seconds} s; see the recipe shown",
    "outcome.refused": "FAILED: the station takes no commands from here; add the page's address to plc.allow_write",
    "refusal.busy": "Another command is being carried out",
    "refusal.down": "The station does not answer: nothing was sent",
    "refusal.token": "The page was reloaded meanwhile: try again",
    "refusal.foreign": "The request comes from another page",
    "refusal.password": "Wrong password",
    "refusal.locked": "Too many wrong passwords: wait {seconds} s",
    "refusal.no_password": "The password file cannot be read: no commands",
    "refusal.disabled": "Commands are switched off (page.allow_commands)",
    "refusal.wrong": "The request cannot be understood",
    "refusal.unreachable": "The page's program does not answer: it is not known whether the command was taken",
}


def english() -> dict[str, str]:
    """The whole table."""
    told: dict[str, str] = {}
    for fault in Fault:
        told |= {f"fault.{fault.value}": fault.meaning, f"fault.{fault.value}.remedy": fault.remedy}
    told |= {f"state.{state.name}": meaning for state, meaning in STATE_MEANINGS.items()}
    told |= _by_name("rule", RULE_MEANINGS) | _by_name("action", ACTION_MEANINGS)
    told |= _by_name("result", RESULT_MEANINGS) | _by_name("does", COMMAND_MEANINGS)
    told |= _in_words("reason", Reason) | _in_words("flag", Flag)
    return told | _OWN


def _by_name(prefix: str, meanings: Mapping[Any, str]) -> dict[str, str]:
    return {f"{prefix}.{member.name}": meaning for member, meaning in meanings.items()}


def _in_words(prefix: str, names: Iterable[enum.IntFlag]) -> dict[str, str]:
    return {f"{prefix}.{member.name}": str(member.name).replace("_", " ").lower() for member in names}
