"""What goes wrong between station and lamp, made to happen at the wire: each ends as its row of the fault table says.

Over every profile and every wire it may be behind, with the service's own keeper on top: the code that the PLC gets,
the words of the log, said once, and the recovery without a restart.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from firmware_bridge.drivers.lamp import FostecLamp
from firmware_bridge.errors import BridgeError
from firmware_bridge.settings import LampSettings
from firmware_bridge.simulators.module_server import WireFault
from firmware_bridge.wire.profiles import PROFILES
from inspector.acquire.device_faults import fault_of
from inspector.acquire.keeper import Keeper, Retry
from inspector.commands.fault_table import ROWS, FaultRow

WIRES = [(name, tcp) for name, profile in PROFILES.items() for tcp in (False, True) if tcp or profile.has_serial]
DEADLINE_S = 0.25
RECOVERY_S = 20.0

SILENT = "the module is silent: no power, cut wire, wrong unit id or baud rate"
LATE = "the module answers late"
GARBLED = "the module's answer is garbled: noise, termination, two masters"
CUT = "the answer is cut short or its checksum is wrong"
FOREIGN = "another unit answers"
ASCII = "the module speaks its maker's protocol, as an ADAM-4000 does when it is new"
TRIPPED = "the module's watchdog has tripped, perhaps before its power was off and on"
STUCK = "an output does not follow: dead converter, wrong channel, wrong range"
REFUSED = "the module refuses a request: another module than its profile, another range"
GONE = "the adapter is unplugged, or its port is another's"

WIRE_FAULTS = [
    (SILENT, WireFault.SILENT),
    (LATE, WireFault.LATE),
    (GARBLED, WireFault.GARBAGE),
    (CUT, WireFault.TRUNCATED),
    (CUT, WireFault.BAD_CRC),
    (FOREIGN, WireFault.WRONG_UNIT),
]


def row(happening: str) -> FaultRow:
    """The table's row of this name."""
    (found,) = (row for row in ROWS if row.happening == happening)
    return found


class Station:
    """A lamp kept as the service keeps it, and the simulator it is on."""

    def __init__(self, server: Any, driver: Any, settings: LampSettings, caplog: pytest.LogCaptureFixture) -> None:
        self.server, self.caplog = server, caplog
        self.keeper = Keeper("lamp", FostecLamp(driver, settings), Retry(0.01, 0.1))

    def set(self, volts: float = 4.0) -> float:
        return self.keeper.use(lambda lamp: lamp.set_volts(volts))

    def fails_as(self, happening: str) -> None:
        """The lamp fails now, with the code and the words of the row."""
        expected = row(happening)
        with pytest.raises(BridgeError) as failure:
            self.set()
        assert fault_of(failure.value) is expected.fault
        pattern = ".*".join(map(re.escape, expected.log.split("…")))
        assert re.fullmatch(pattern, self.said[-1]), self.said

    @property
    def said(self) -> list[str]:
        """What the log says of the lamp, so far."""
        return [record.getMessage() for record in self.caplog.records if record.name == "inspector.outage"]

    def recovers(self, wait_until: Callable[..., Any]) -> None:
        """The lamp works again by itself; the outage was said once at its start and once at its end."""

        def works() -> bool:
            try:
                return self.set() == pytest.approx(4.0, abs=0.01)
            except BridgeError:
                return False

        wait_until(works, f"the lamp recovers; log: {self.said}", RECOVERY_S)
        assert len(self.said) == 2
        assert self.said[1].startswith("lamp works again after")


@pytest.fixture
def station(serve: Any, module_at: Any, caplog: pytest.LogCaptureFixture) -> Iterator[Callable[..., Station]]:
    """``station(profile, tcp=False, **settings)``: one at work, its lamp lit, on the profile's last channel."""
    caplog.set_level(logging.INFO)
    made: list[Station] = []

    def make(name: str, *, tcp: bool = False, symlink: Path | None = None, **settings: Any) -> Station:
        server = serve(name, tcp=tcp, symlink=symlink)
        address = str(symlink) if symlink else server.address
        driver = module_at(name, address, **{"deadline_s": DEADLINE_S} | settings)
        made.append(Station(server, driver, LampSettings(channel=PROFILES[name].channels - 1), caplog))
        made[-1].keeper.use(lambda lamp: lamp.open())
        return made[-1]

    yield make
    for one in made:
        one.keeper.close()


@pytest.mark.parametrize(("name", "tcp"), WIRES)
@pytest.mark.parametrize(("happening", "fault"), WIRE_FAULTS, ids=[fault.value for _, fault in WIRE_FAULTS])
def test_wrong_answers(
    happening: str, fault: WireFault, name: str, tcp: bool, station: Any, wait_until: Callable[..., Any]
) -> None:
    if tcp and fault is WireFault.BAD_CRC:
        return  # a Modbus TCP frame has no checksum of its own to damage
    one = station(name, tcp=tcp)
    one.server.fault, one.server.late_s = fault, 1.5 * DEADLINE_S
    one.fails_as(happening)
    one.server.fault = WireFault.NONE
    one.recovers(wait_until)


@pytest.mark.parametrize("name", ["adam-4024", "adam-4021"])
def test_an_adam_as_it_is_shipped(name: str, station: Any, wait_until: Callable[..., Any]) -> None:
    one = station(name)
    one.keeper.close()
    one.server.module.ascii = True
    one.fails_as(ASCII)
    one.server.module.ascii = False
    one.recovers(wait_until)


@pytest.mark.parametrize("name", [name for name, p in PROFILES.items() if p.watchdog and p.watchdog.clear])
def test_a_tripped_watchdog(name: str, station: Any, wait_until: Callable[..., Any]) -> None:
    one = station(name, tcp=not PROFILES[name].has_serial, deadline_s=5.0)
    one.set()
    one.server.module.trip()
    one.fails_as(TRIPPED)
    one.recovers(wait_until)


@pytest.mark.parametrize("name", ["adam-4024", "adam-4021"])
def test_a_trip_that_only_the_makers_tool_clears(name: str, station: Any, wait_until: Callable[..., Any]) -> None:
    one = station(name, deadline_s=5.0)
    one.set()
    one.server.module.trip()
    one.fails_as(TRIPPED)
    with pytest.raises(BridgeError, match="clear it with the maker's tool"):
        one.set()
    one.server.module.set_value(PROFILES[name].watchdog.tripped, 0)
    one.recovers(wait_until)


@pytest.mark.parametrize(("name", "tcp"), WIRES)
def test_an_output_that_is_stuck(name: str, tcp: bool, station: Any, wait_until: Callable[..., Any]) -> None:
    one = station(name, tcp=tcp, deadline_s=5.0)
    one.server.module.stuck = True
    one.fails_as(STUCK)
    one.server.module.stuck = False
    one.recovers(wait_until)


def test_a_module_in_another_range(station: Any, wait_until: Callable[..., Any]) -> None:
    one = station("adam-4024", deadline_s=5.0)
    one.keeper.close()
    code = PROFILES["adam-4024"].setup[0].point.plus(3)
    one.server.module.set_value(code, 0x30)
    one.fails_as(REFUSED)
    one.server.module.set_value(code, 0x32)
    one.recovers(wait_until)


def test_an_adapter_that_comes_back_under_another_name(
    station: Any, serve: Any, tmp_path: Path, wait_until: Callable[..., Any]
) -> None:
    link = tmp_path / "by-id"
    one = station("ato-4ch", symlink=link, deadline_s=5.0)
    one.set()
    one.server.stop()
    one.fails_as(GONE)
    one.server = serve("ato-4ch", symlink=link)
    one.recovers(wait_until)


def test_every_happening_of_module_and_lamp_is_met_here() -> None:
    met = {SILENT, LATE, GARBLED, CUT, FOREIGN, ASCII, TRIPPED, STUCK, REFUSED, GONE}
    module = {row.happening for row in ROWS if int(row.fault) < 202} - {"the line babbles without end"}
    assert module == met, "the babbling line is met with the master's own tests"
