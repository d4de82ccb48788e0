"""What goes wrong on a line and what is then true: happening, code, what the PLC sees, what the log says, recovery.

In what the log says, "…" stands for what differs from case to case.
"""

from __future__ import annotations

from dataclasses import dataclass

from inspector import snapshots
from inspector.faults import Fault
from inspector.model import Reason, Snapshot, State
from inspector.snapshots import FRAME_FAULTS, Times

HEADINGS = ("what happens", "code", "what the PLC sees", "what the log says", "how it recovers")


@dataclass(frozen=True, slots=True)
class FaultRow:
    """One thing that goes wrong. ``log`` is the line that starts the outage; each outage is said once."""

    happening: str
    fault: Fault
    log: str
    recovery: str
    in_frame: bool = False
    """True: found in a frame that was taken as asked; the devices work."""

    @property
    def code(self) -> str:
        """Number and name, as the registers' page has them."""
        return f"{int(self.fault)} {self.fault.name}"

    @property
    def plc_sees(self) -> str:
        """What the registers show within one cycle."""
        return _PLC_SEES.get(self.fault) or _result_shown(self.fault, self.in_frame)


_REOPENED = "the port is opened again with back-off until the module answers; no restart"
_CAMERA_REOPENED = "the camera is opened again with back-off until a frame comes; no restart"
_NEXT_FRAME = "with the next good frame"

ROWS = (
    FaultRow(
        "the adapter is unplugged, or its port is another's",
        Fault.MODULE_GONE,
        "lamp fails: module: …; …",
        f"{_REOPENED}. Named by /dev/serial/by-id it is found under whatever name it comes back",
    ),
    FaultRow(
        "the module is silent: no power, cut wire, wrong unit id or baud rate",
        Fault.MODULE_SILENT,
        "lamp fails: module: no answer in … s, … of unit …; check power, unit id, baud rate and wiring…",
        _REOPENED,
    ),
    FaultRow(
        "the module speaks its maker's protocol, as an ADAM-4000 does when it is new",
        Fault.MODULE_SILENT,
        "lamp fails: module: no answer in … s, …; an ADAM-4000 leaves its maker speaking ASCII: set protocol Modbus …",
        f"a person sets the protocol; then {_REOPENED}",
    ),
    FaultRow(
        "the module answers late",
        Fault.MODULE_SILENT,
        "lamp fails: module: no answer in … s, …",
        f"what it still owes is waited out, so that it is not taken for the next answer; then {_REOPENED}",
    ),
    FaultRow(
        "the module's answer is garbled: noise, termination, two masters",
        Fault.MODULE_REPLY_WRONG,
        "lamp fails: module: wrong answer: … bytes that are no answer to …; check unit ids, termination and shield",
        _REOPENED,
    ),
    FaultRow(
        "the answer is cut short or its checksum is wrong",
        Fault.MODULE_REPLY_WRONG,
        "lamp fails: module: wrong answer: … bytes that are no answer to …; check unit ids, termination and shield",
        _REOPENED,
    ),
    FaultRow(
        "another unit answers",
        Fault.MODULE_REPLY_WRONG,
        "lamp fails: module: wrong answer: …; check unit ids, termination and shield",
        _REOPENED,
    ),
    FaultRow(
        "the line babbles without end",
        Fault.MODULE_REPLY_WRONG,
        "lamp fails: module: … babbles; check termination, A/B wiring and baud rate",
        _REOPENED,
    ),
    FaultRow(
        "the module refuses a request: another module than its profile, another range",
        Fault.MODULE_REFUSED,
        "lamp fails: module: …; …",
        f"a person sets the profile or the module right; then {_REOPENED}",
    ),
    FaultRow(
        "the module's watchdog has tripped, perhaps before its power was off and on",
        Fault.MODULE_WATCHDOG_TRIPPED,
        "lamp fails: module: watchdog tripped (… is set): the module is at its safe value and ignores writes; …",
        "opening the module clears the trip where the profile can (docs/modules.md); else the maker's tool does",
    ),
    FaultRow(
        "an output does not follow: dead converter, wrong channel, wrong range",
        Fault.LAMP_READBACK,
        "lamp fails: lamp: set to … V, reads back … V (tolerance … V); check the module's range, profile and channel",
        "the level is set and read back again in every try; no restart",
    ),
    FaultRow(
        "the lamp is not warm, after a start or an outage",
        Fault.LAMP_WARMING_UP,
        "nothing: no fault of a device; the terminal's line counts down",
        "when it has been lit for lamp.warm_up_s without a break",
    ),
    FaultRow(
        "the lamp is weak: the reference patch stays dark at the highest level allowed",
        Fault.LAMP_WEAK,
        "light fails: …; and well before, once, a warning: fault 203: The lamp is too weak to keep its level. …",
        "when the patch is as bright as it should be: a new bulb",
    ),
    FaultRow(
        "the lamp is dead, or the lens cap is on",
        Fault.FRAME_BLACK,
        "frame fails: …",
        _NEXT_FRAME,
        in_frame=True,
    ),
    FaultRow(
        "light from elsewhere, or too long an exposure",
        Fault.FRAME_OVERLIT,
        "frame fails: …",
        _NEXT_FRAME,
        in_frame=True,
    ),
    FaultRow("a frame of another size", Fault.FRAME_WRONG_SHAPE, "frame fails: …", _NEXT_FRAME, in_frame=True),
    FaultRow(
        "a frame whose pixels are not grey values of 8 or 16 bits",
        Fault.CAMERA_FRAME_WRONG,
        "frame fails: …",
        _NEXT_FRAME,
        in_frame=True,
    ),
    FaultRow("the camera, its port or its folder is gone", Fault.CAMERA_GONE, "camera fails: …", _CAMERA_REOPENED),
    FaultRow(
        "the camera gives no frame in time; a camera that waits for its line's signal is no fault",
        Fault.CAMERA_TIMEOUT,
        "camera fails: …",
        _CAMERA_REOPENED,
    ),
    FaultRow(
        "the frame is short or damaged, or an old one comes again",
        Fault.CAMERA_FRAME_WRONG,
        "camera fails: …",
        _CAMERA_REOPENED,
    ),
    FaultRow(
        "the camera refuses a setting",
        Fault.CAMERA_REFUSED,
        "camera fails: …",
        f"a person sets it within the camera's range; then {_CAMERA_REOPENED}",
    ),
    FaultRow(
        "the exposure read back, or the frame's own, is not the one set",
        Fault.EXPOSURE_READBACK,
        "camera fails: camera: …",
        "the exposure is set and read back again with every frame",
    ),
    FaultRow(
        "the cycle hangs",
        Fault.CYCLE_STALLED,
        "Inspection cycle has not turned for … s: the PLC is told",
        "by itself when it turns again; else systemd's watchdog restarts the service",
    ),
    FaultRow(
        "an error in the program",
        Fault.INTERNAL,
        "inspection fails: …, with its traceback",
        "with the next frame that is inspected",
    ),
    FaultRow(
        "new settings are refused at a reload",
        Fault.SETTINGS_REFUSED,
        "settings refused: …, a line for each problem",
        "when a reload takes settings over",
    ),
    FaultRow(
        "new settings do not bring a station to Ready that was (cycle.rollback_after_s)",
        Fault.SETTINGS_REFUSED,
        "with the new settings the station did not become ready within … s …: the last good ones are in force again",
        "the last good settings are in force by themselves; the bit stays until a reload takes settings over",
    ),
    FaultRow(
        "the settings are refused at a start",
        Fault.SETTINGS_REFUSED,
        "settings refused: …, a line for each problem; fault 503: the last good settings are used; …",
        "when a reload takes settings over. Without last good ones the service ends with status 78",
    ),
    FaultRow(
        "the disk is full, read-only, gone or too slow for the results",
        Fault.STORE_DEGRADED,
        "results' store fails: …. Check the disk: space, health, mount",
        "results wait in memory, in order; the oldest images are deleted for them; tried again with back-off",
    ),
    FaultRow(
        "the results' store is damaged, or was taken away",
        Fault.STORE_DAMAGED,
        "fault 602: … (…); it is kept as …. Save the file; check the disk",
        "a new store is begun at once; the bit goes with CLEAR_FAULT",
    ),
)


def as_markdown() -> str:
    """The manual's page."""
    lines = [" | ".join(HEADINGS), " | ".join(["---"] * len(HEADINGS)), *(" | ".join(_cells(row)) for row in ROWS)]
    remedies = (f"| {fault.value} {fault.name} | {fault.meaning} | {fault.remedy} |" for fault in Fault if fault)
    return _PAGE.format(remedies="\n".join(remedies), table="\n".join(f"| {line} |" for line in lines))


def as_table() -> str:
    """Paragraphs for a terminal: its lines are too short for five columns."""
    rows = (zip(HEADINGS, _cells(row), strict=True) for row in ROWS)
    return "\n".join("".join(f"{heading:>18}: {cell}\n" for heading, cell in row) for row in rows)


FORMATS = {"table": as_table, "markdown": as_markdown}


def _cells(row: FaultRow) -> tuple[str, ...]:
    return row.happening, row.code, row.plc_sees, row.log, row.recovery


def _result_shown(fault: Fault, in_frame: bool) -> str:
    """The registers after a cycle that met the fault, taken from what fills them."""
    running = Snapshot(state=State.CONTINUOUS_EXECUTION)
    shown = snapshots.not_inspected(running, fault, Times(0.0, 0.0, 0.0))
    if not in_frame:
        return f"NOT_INSPECTED ({_names(shown.reasons)}), fault_code {int(fault)}, state {shown.state.name}"
    reason = next(reason for reason, code in FRAME_FAULTS.items() if code is fault)
    return f"NOT_INSPECTED ({_names(reason)}), fault_code {int(fault)}, state {running.state.name}"


def _names(reasons: Reason) -> str:
    return ", ".join(reason.name for reason in reasons if reason.name)


INSPECTION_GOES_ON = frozenset({Fault.SETTINGS_REFUSED, Fault.STORE_DEGRADED, Fault.STORE_DAMAGED})
"""Faults that take no verdict back: what was inspected was inspected rightly."""
_PLC_SEES = {
    Fault.CYCLE_STALLED: "NOT_INSPECTED, fault_code 501, state ERROR; the heartbeat goes on",
    Fault.SETTINGS_REFUSED: "inspection goes on as before; status bit SETTINGS_REFUSED",
    Fault.STORE_DEGRADED: "inspection goes on; status bit STORE_DEGRADED while a result shown may not be on the disk",
    Fault.STORE_DAMAGED: "inspection goes on; status bit STORE_DAMAGED",
}
"""Where it is not the result of a cycle."""

_PAGE = """\
# What goes wrong, and what is then true

Made from `inspector/faults.py` and `inspector/commands/fault_table.py` by `inspector faults --format markdown`; a test
fails when this page is stale.

## What to do

| code | meaning | what to do |
| --- | --- | --- |
{remedies}

## How it shows and how it ends

In each case the PLC sees it within one cycle and never an old PASS. The log says an outage once when it starts, as
below ("…" stands for what differs), and once when it ends: "lamp works again after 12.3 s". Registers are served
throughout, and one device's outage leaves the others as they are. A stopped line is no fault.

{table}
"""
