"""A PLC as a process of its own: polls a station's registers, runs the program that tends the booth, resets statistics.

`python -m inspector.lab.plc_client PORT` reads over Modbus TCP and prints a line of JSON for each order, which is its
wire to the crew. It shares nothing with the station but the registers: the few that it uses are named here as the
integrator's list has them. It ends when the station has gone.
"""

from __future__ import annotations

import json
import struct
import sys
import time
from collections.abc import Mapping

from firmware_bridge.errors import BridgeError
from firmware_bridge.links.modbus_master import ModbusMaster
from firmware_bridge.links.ports import open_tcp
from firmware_bridge.wire.modbus import Table
from inspector.lab.plc_program import PlcProgram

STATISTICS, WORDS = 2000, 125
READS: Mapping[str, tuple[int, str, float]] = {
    "statistics_sequence": (0, "H", 1),
    "statistics_status": (1, "H", 1),
    "action": (4, "H", 1),
    "confidence": (5, "H", 0.001),
    "statistics_age_ms": (8, "I", 1),
    "statistics_sequence_end": (124, "H", 1),
}
"""Offset, type and scale of the registers used; 32-bit values high word first."""
CONTROL, COMMAND, HANDSHAKE = 500, 504, 19
EXECUTE = 1 << 7
RESET_STATISTICS = 2
ENDED = 1 << 10 | 1 << 11
POLL_S, DEADLINE_S = 0.02, 2.0


class Station:
    """The station as this PLC knows it."""

    def __init__(self, host: str, port: int) -> None:
        self._master = ModbusMaster(
            "station", 1, lambda: open_tcp("station", host, port, DEADLINE_S), rtu=False, deadline_s=DEADLINE_S
        )
        self._master.open()

    def statistics(self) -> dict[str, float]:
        """The registers that the program uses, of one read of the whole area."""
        words = self._master.read(Table.INPUT_REGISTERS, STATISTICS, WORDS)
        data = struct.pack(f">{WORDS}H", *words)
        rows = READS.items()
        return {name: struct.unpack_from(">" + form, data, 2 * at)[0] * scale for name, (at, form, scale) in rows}

    def reset_statistics(self) -> None:
        """The command, by the handshake: EXECUTE, wait for its end, drop EXECUTE, wait for that to be seen."""
        self._master.write(Table.HOLDING_REGISTERS, COMMAND, RESET_STATISTICS)
        for execute in (EXECUTE, 0):
            self._master.write(Table.HOLDING_REGISTERS, CONTROL, execute)
            while bool(self._master.read(Table.INPUT_REGISTERS, HANDSHAKE)[0] & ENDED) is not bool(execute):
                time.sleep(POLL_S)


def run(host: str, port: int) -> None:
    """Tend the booth until the station has gone. Raises BridgeError then."""
    station, program = Station(host, port), PlcProgram()
    while True:
        deeds, reset = program.scan(station.statistics())
        for deed in deeds:
            print(json.dumps({"after": program.sequence, "order": deed.name}), flush=True)
        if reset:
            station.reset_statistics()
        time.sleep(POLL_S)


if __name__ == "__main__":
    try:
        run("127.0.0.1", int(sys.argv[1]))
    except (BridgeError, KeyboardInterrupt, BrokenPipeError):
        sys.exit(0)
