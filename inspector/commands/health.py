"""What `inspector health` does: asks the registers as a PLC would, and says how the station is.

It tells a service that answers nothing, which a restart may mend, from one that answers and is not well, which says so
to everybody itself: a device that has failed is waited for, and no restart brings it back. It runs once a minute, so it
asks over a plain socket: the bridge's Modbus master costs more time than all of this.
"""

from __future__ import annotations

import socket
import struct
import time
from pathlib import Path

import typer

from inspector.faults import Fault
from inspector.model import State
from inspector.publish import address
from inspector.publish.registers import RESULT_ADDRESS, decode

EXIT_HEALTHY, EXIT_NOT_WELL, EXIT_NO_ANSWER, EXIT_SETTINGS_REFUSED = 0, 1, 69, 78

READ_INPUT_REGISTERS = 4
HEADER = struct.Struct(">HHHBBB")
"""Of an answer: transaction, protocol, length, unit, function, bytes that follow or, after an error, its code."""
WORDS = 6
"""The first registers, up to fault_code."""
DEADLINE_S = 5.0
"""The heartbeat rises once a second; a machine that is busy may be late."""
LOOK_S = 0.2


def run(config: Path | None, address_file: Path | None) -> int:
    """Print one line; the exit status says whether the service is healthy, not well, or answers nothing."""
    if address_file is None:
        assert config is not None
        return _run_by_settings(config)
    try:
        host, port, unit = address.told(address_file)
    except (OSError, ValueError) as error:
        typer.echo(f"not served: {error}")
        return EXIT_NO_ANSWER
    return _say(host, port, unit)


def _run_by_settings(config: Path) -> int:
    from inspector.settings import SettingsError, load

    try:
        plc = load(config, secrets=False).plc
    except SettingsError as error:
        typer.echo(f"settings refused: {error}", err=True)
        return EXIT_SETTINGS_REFUSED
    return _say(address.EVERYWHERE.get(plc.host, plc.host), plc.port, plc.unit_ids[0])


def _say(host: str, port: int, unit: int) -> int:
    status, said = look(host, port, unit)
    typer.echo(f"{host}:{port}: {said}")
    return status


def look(host: str, port: int, unit: int, deadline_s: float = DEADLINE_S) -> tuple[int, str]:
    """Exit status and sentence for the service whose registers are there."""
    try:
        with socket.create_connection((host, port), timeout=deadline_s) as service:
            try:
                return _well(service, unit, time.monotonic() + deadline_s)
            except ConnectionError:
                return EXIT_NOT_WELL, "it closes the connection: plc.allow lacks this machine's address"
    except OSError as error:
        return EXIT_NO_ANSWER, f"no answer: {error}"


def _well(service: socket.socket, unit: int, ends_s: float) -> tuple[int, str]:
    """Whether the heartbeat moves, and what state and fault say. Raises OSError."""
    first = shown = _read(service, unit)
    while shown["heartbeat"] == first["heartbeat"]:
        if time.monotonic() > ends_s:
            return EXIT_NO_ANSWER, "the heartbeat stands still"
        time.sleep(LOOK_S)
        shown = _read(service, unit)
    state, code = State(shown["state"]).name, shown["fault_code"]
    if code:
        fault = next((f for f in Fault if f == code), None)
        return EXIT_NOT_WELL, f"{state}, fault {code}" + (f": {fault.meaning}. {fault.remedy}" if fault else "")
    return EXIT_HEALTHY, state


def _read(service: socket.socket, unit: int) -> dict[str, int]:
    """The first registers by name. Raises OSError; what is no answer counts as a closed connection."""
    service.sendall(struct.pack(">HHHBBHH", 1, 0, 6, unit, READ_INPUT_REGISTERS, RESULT_ADDRESS, WORDS))
    *_, function, size = HEADER.unpack(_received(service, HEADER.size))
    if (function, size) != (READ_INPUT_REGISTERS, 2 * WORDS):
        raise ConnectionError(f"answered with function {function}")
    words = struct.unpack(f">{WORDS}H", _received(service, size))
    return {name: int(value or 0) for name, value in decode(words).items()}


def _received(service: socket.socket, size: int) -> bytes:
    data = b""
    while len(data) < size:
        if not (more := service.recv(size - len(data))):
            raise ConnectionResetError
        data += more
    return data
