"""The loop shown live: a simulated booth, the real statistics and register server, and a PLC as a process of its own.

What the PLC orders comes back as lines on its standard output, as a crew would be called by radio. Beside the tended
booth runs its twin, of the same luck, that nobody tends.
"""

from __future__ import annotations

import contextlib
import json
import queue
import shlex
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from statistics import fmean
from typing import Any

from inspector.handshake_table import Command
from inspector.judge.spc.monitor import Monitor
from inspector.judge.spc.settings import StatisticsSettings
from inspector.loop.proof import RECIPE_ID, TendedBooth, panel_of
from inspector.model import Defect, Snapshot, State, Verdict
from inspector.publish import console
from inspector.publish.plc_server import PlcServer, PlcServerError
from inspector.publish.statistics_registers import STATISTICS_ADDRESS
from inspector.service.control import PlcControl
from inspector.service.plc_commands import carried_out

Orders = queue.SimpleQueue[dict[str, Any]]
EXIT_PORT_TAKEN = 69
LINE_PANELS = 50
"""A line is printed for so many panels."""
PLC_DEADLINE_S = 5.0


@dataclass(frozen=True, slots=True)
class Pace:
    """How many panels, and how many a second."""

    panels: int
    rate_hz: float


class LiveStation:
    """The PLC's side of a station: statistics, registers and commands, without camera and lamp."""

    def __init__(self, port: int) -> None:
        self._monitor = Monitor(StatisticsSettings())
        self._snapshot = Snapshot(state=State.CONTINUOUS_EXECUTION, recipe_id=RECIPE_ID, simulated=True)
        self._asked = threading.Event()
        self._control = PlcControl(self._snapshot, self._asked.set)
        self.server = PlcServer(port=port, on_control=self._control.write)

    def start(self) -> None:
        """Serve the registers. Raises PlcServerError."""
        self.server.start()
        self._control.serve(self.server, "high_first", False)

    def publish(self, booth: TendedBooth) -> Snapshot:
        """Paint one panel, publish its result and statistics, and do what the PLC asks."""
        painted, now_s = booth.paint(), time.monotonic()
        heights, places = painted.heights_um.tolist(), painted.places_mm.tolist()
        self._snapshot = replace(
            self._snapshot,
            sequence=self._snapshot.sequence + 1,
            verdict=Verdict.FAIL if heights else Verdict.PASS,
            defects=tuple(
                Defect(x, y, h, None, (0.0, 0.0), (0.0, 0.0)) for (x, y), h in zip(places, heights, strict=True)
            ),
            result_at_s=now_s,
            statistics=self._monitor.add(panel_of(painted, booth.settings, now_s)),
            statistics_sequence=self._snapshot.sequence + 1,
        )
        self._control.publish(self._snapshot)
        command = self._control.take_command()
        if command is not None:
            self._control.command_ended(carried_out(command, {Command.RESET_STATISTICS: self._reset}))
        return self._snapshot

    def wait(self, for_s: float) -> None:
        """Until the next panel, or until the PLC asks for something."""
        self._asked.wait(max(0.0, for_s))
        self._asked.clear()

    def _reset(self, baselines_too: int) -> None:
        if baselines_too:
            self._monitor.relearn()
        else:
            self._monitor.reset()


@contextlib.contextmanager
def plc_process(command: list[str]) -> Iterator[Orders]:
    """The PLC at work, and the orders that it gives; it is ended afterwards."""
    orders: Orders = queue.SimpleQueue()
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    lines = process.stdout

    def listen() -> None:
        for line in lines:
            orders.put(json.loads(line))

    listener = threading.Thread(target=listen, name="orders", daemon=True)
    listener.start()
    try:
        yield orders
    finally:
        process.terminate()
        try:
            process.wait(PLC_DEADLINE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        listener.join(PLC_DEADLINE_S)
        lines.close()


def run(tended: TendedBooth, twin: TendedBooth, deed_of: Callable[[str], Any], pace: Pace, port: int, plc: str) -> int:
    """Show it to its end; the exit status.

    ``plc``: the PLC's program, a command that is given the port; each of its orders is a line of JSON,
    {"after": sequence, "order": name of a deed}.
    """
    station = LiveStation(port)
    try:
        station.start()
    except PlcServerError as error:
        console.say(str(error))
        return EXIT_PORT_TAKEN
    console.say(console.how_to_poll("127.0.0.1", station.server.port).replace("-r 0 ", f"-r {STATISTICS_ADDRESS} "))
    try:
        with plc_process([*shlex.split(plc), str(station.server.port)]) as orders:
            ours, theirs = _show(station, tended, twin, deed_of, pace, orders)
    finally:
        station.server.stop()
    console.say(f"tended {ours:.2f}, untended {theirs:.2f} seeds a panel over {pace.panels} panels")
    return 0


def _show(
    station: LiveStation,
    tended: TendedBooth,
    twin: TendedBooth,
    deed_of: Callable[[str], Any],
    pace: Pace,
    orders: Orders,
) -> tuple[float, float]:
    """Seeds a panel of either booth, once all panels are painted."""
    ours: list[int] = []
    theirs: list[int] = []
    for n in range(1, pace.panels + 1):
        begun_s = time.monotonic()
        _obey(orders, tended, deed_of)
        shown = station.publish(tended)
        ours.append(len(shown.defects))
        theirs.append(len(twin.paint()))
        if n % LINE_PANELS == 0:
            _say(n, fmean(ours[-LINE_PANELS:]), fmean(theirs[-LINE_PANELS:]), shown)
        station.wait(1.0 / pace.rate_hz - (time.monotonic() - begun_s))
    return fmean(ours), fmean(theirs)


def _obey(orders: Orders, booth: TendedBooth, deed_of: Callable[[str], Any]) -> None:
    while not orders.empty():
        order = orders.get()
        console.say(f"  PLC, after panel {order['after']}: {order['order']}")
        booth.order(deed_of(order["order"]))


def _say(n: int, ours: float, theirs: float, shown: Snapshot) -> None:
    statistics = shown.statistics
    told = ""
    if statistics is not None and statistics.alarm:
        advice = f" -> {statistics.action_name} ({statistics.confidence:.0%})" if statistics.action else ""
        told = f"  {statistics.alarm_text}{advice}"
    console.say(f"panel {n:5}  tended {ours:5.2f}  untended {theirs:5.2f}  {'#' * round(4 * ours):24}{told}".rstrip())
