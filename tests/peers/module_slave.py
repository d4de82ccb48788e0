"""A Modbus RTU slave on pymodbus: module_slave.py PORT UNIT [ADDRESS=VALUE | FROM:TO]... as module_slave.c has it."""

from __future__ import annotations

import asyncio
import re
import sys

from pymodbus import FramerType
from pymodbus.server import ModbusSerialServer
from pymodbus.simulator import DataType, SimData, SimDevice

POINTS = 2048
READ_INPUTS, WRITE_ONE = 4, 6


class Module:
    """2048 points of each table, zero but for what the options say."""

    def __init__(self, unit: int, options: list[str]) -> None:
        self._sources = {target: source for source, target in pairs(options, ":")}
        self._written = dict(pairs(options, "="))
        holding = [self._written.get(address, 0) for address in range(POINTS)]
        bits = [SimData(0, values=[False] * POINTS, datatype=DataType.BITS) for _ in range(2)]
        registers = [SimData(0, values=values, datatype=DataType.REGISTERS) for values in (holding, [0] * POINTS)]
        self.device = SimDevice(unit, tuple([block] for block in (*bits, *registers)), action=self._copy)

    async def _copy(
        self, function: int, start: int, address: int, count: int, registers: list[int], values: list[int] | None
    ) -> None:
        """Called at each access: an input register FROM:TO shows what was written to its holding register."""
        if function == WRITE_ONE and values:
            self._written[address] = values[0]
        for asked in range(address, address + count) if function == READ_INPUTS else ():
            registers[asked - start] = self._written.get(self._sources.get(asked, -1), 0)


def pairs(options: list[str], sign: str) -> list[tuple[int, int]]:
    """The options with this sign between two numbers."""
    found = [re.fullmatch(rf"(\d+){sign}(\d+)", option) for option in options]
    return [(int(match[1]), int(match[2])) for match in found if match]


async def serve(port: str, module: Module) -> None:
    """Serve until the process is ended; say "ready" once the port is open."""
    server = ModbusSerialServer(
        module.device, framer=FramerType.RTU, port=port, baudrate=9600, ignore_missing_devices=True
    )
    serving = asyncio.create_task(server.serve_forever())
    while server.transport is None:
        await asyncio.sleep(0.01)
    print("ready", flush=True)
    await serving


if __name__ == "__main__":
    asyncio.run(serve(sys.argv[1], Module(int(sys.argv[2]), sys.argv[3:])))
