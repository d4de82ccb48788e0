"""A simulated module in a process of its own, and the port to it: driver, framing and port are the real ones."""

from __future__ import annotations

import contextlib
import select
import subprocess
import sys

from firmware_bridge.errors import DeviceGone
from firmware_bridge.links.ports import Port, open_serial, open_tcp
from firmware_bridge.wire.profiles import Profile

START_S, END_S = 5.0, 1.0
"""A process that takes longer to say its address, or to end, is given up, seconds. Starting takes 0.1 s when idle."""


def open_simulated(device: str, profile: Profile, unit: int) -> Port:
    """Start a simulator of the profile and open the port to it; closing the port ends the simulator.

    It ends too when this process does, however that comes: it watches a pipe that only this process holds. Raises
    DeviceGone.
    """
    process = _started(profile, unit)
    try:
        address = _address(device, process)
        if profile.has_serial:
            return open_serial(device, address, baud=115200, after_close=lambda: _end(process))
        host, _, port = address.rpartition(":")
        return open_tcp(device, host, int(port), START_S, after_close=lambda: _end(process))
    except BaseException:
        _end(process)
        raise


def _started(profile: Profile, unit: int) -> subprocess.Popen[bytes]:
    """In a session of its own, so that Ctrl-C reaches the service alone and the lamp can still be put out."""
    command = [sys.executable, "-m", "firmware_bridge.simulators.module"]
    options = ["--profile", profile.name, "--unit", str(unit), "--with-parent"]
    return subprocess.Popen(
        command + options, stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0, start_new_session=True
    )


def _address(device: str, process: subprocess.Popen[bytes]) -> str:
    assert process.stdout is not None
    ready, _, _ = select.select([process.stdout], [], [], START_S)
    address = process.stdout.readline().decode().strip() if ready else ""
    if not address:
        raise DeviceGone(device, "the simulator did not start", "run: inspector simulate-device module --help")
    return address


def _end(process: subprocess.Popen[bytes]) -> None:
    """Close its pipes, which ends it; end it the hard way if that does not. Reaps it."""
    for pipe in (process.stdin, process.stdout):
        if pipe:
            pipe.close()
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(END_S)
        return
    process.kill()
    process.wait()
