"""Digital points, and what a module does when the station is gone: safe and power-on values, watchdog, trips, power."""

from __future__ import annotations

from typing import Any

import pytest
from memory_line import Clock, MemoryLine

from firmware_bridge import errors
from firmware_bridge.drivers.lamp import FostecLamp
from firmware_bridge.drivers.modbus_module import ModbusModule
from firmware_bridge.links.modbus_master import ModbusMaster
from firmware_bridge.settings import LampSettings
from firmware_bridge.simulators.module_server import WireFault
from firmware_bridge.wire.module_setup import Safety, held, most_requests
from firmware_bridge.wire.profiles import PROFILES, manual

UNIT = 3
ICP = "tm-da1p1r1"
WIRES = [(name, tcp) for name, profile in PROFILES.items() for tcp in (False, True) if tcp or profile.has_serial]
SAFETY = Safety(safe_v=1.5, power_on_v=0.5, watchdog_s=2.0)


@pytest.fixture(params=WIRES, ids=lambda wire: f"{wire[0]}-{'tcp' if wire[1] else 'rtu'}")
def opened(request: pytest.FixtureRequest, serve: Any, module_at: Any) -> Any:
    """Profile, simulator and open driver of every profile over every wire."""
    name, tcp = request.param
    server = serve(name, tcp=tcp)
    driver = module_at(name, server.address, deadline_s=5.0)
    driver.open()
    return PROFILES[name], server, driver


def in_memory(name: str, safety: Safety = SAFETY) -> tuple[MemoryLine, ModbusModule]:
    """A module on a line in memory, and its driver."""
    line = MemoryLine(PROFILES[name], UNIT, Clock())
    master = ModbusMaster("module", UNIT, line.open_port, rtu=True, deadline_s=0.5, clock=line.clock)
    return line, ModbusModule(PROFILES[name], master, safety=safety)


def test_digital_inputs_are_read_as_they_stand(opened: Any) -> None:
    profile, server, driver = opened
    points = profile.digital_inputs.points if profile.digital_inputs else ()
    assert driver.read_inputs() == (False,) * len(points)
    for channel, point in enumerate(points):
        server.module.set_value(point, 1)
        assert driver.read_inputs() == tuple(c <= channel for c in range(len(points)))


def test_digital_outputs_are_switched_and_read_back(opened: Any) -> None:
    profile, _, driver = opened
    count = profile.digital_outputs.count if profile.digital_outputs else 0
    for channel in range(count):
        driver.write_output(channel, True)
        assert driver.read_outputs()[channel]
        driver.write_output(channel, False)
        assert not driver.read_outputs()[channel]
    for channel in (-1, count):
        with pytest.raises(errors.OutOfRange, match=f"no digital output {channel}"):
            driver.write_output(channel, True)


def test_a_digital_output_that_does_not_follow_is_an_error(serve: Any, module_at: Any) -> None:
    server = serve(ICP)
    driver = module_at(ICP, server.address, deadline_s=5.0)
    driver.open()
    server.module.stuck = True
    with pytest.raises(errors.ReadBackWrong, match="set on, reads back off"):
        driver.write_output(0, True)
    server.module.trip()
    with pytest.raises(errors.WatchdogTripped):
        driver.write_output(0, True)


def test_safety_is_set_once_and_checked_at_every_opening() -> None:
    line, driver = in_memory(ICP)
    driver.open()
    values = {one.held.meaning: (one.value, one.right) for one in driver.found()}
    assert values["safe value, output 0"] == (1500, True)
    assert values["power-on value, output 0"] == (500, True)
    assert values["watchdog time"] == (20, True)
    assert values["watchdog on"] == (1, True)
    line.requests.clear()
    driver.open()
    assert not [request for request in line.requests if request[1] in (5, 6)], "memory that wears out is written once"
    line.module.set_value(manual(40097), 9000)
    driver.open()
    assert all(one.right for one in driver.found())


def test_a_setting_that_does_not_hold_is_named() -> None:
    line, driver = in_memory(ICP)
    line.module.write_registers = lambda address, data: None  # type: ignore[method-assign]  # takes all, keeps nothing
    with pytest.raises(errors.ReadBackWrong, match="safe value, output 0: wrote 1500 to 40097, reads back 0"):
        driver.open()


def test_the_watchdog_is_switched_on_last() -> None:
    wanted = [one.meaning for one in held(PROFILES[ICP], [0], SAFETY)]
    assert wanted[-1] == "watchdog on"
    assert wanted.index("watchdog time") < wanted.index("watchdog on")


def test_a_safe_value_never_stands_above_what_was_asked() -> None:
    for profile in PROFILES.values():
        for one in held(profile, range(profile.channels), Safety(1.2345, 1.2345, None)):
            if "value, output" in one.meaning and one.value is not None:
                assert profile.span.volts(one.value) <= 1.2345


def test_a_station_that_stands_keeps_the_watchdog_fed() -> None:
    line, driver = in_memory(ICP)
    lamp = FostecLamp(driver, LampSettings(), clock=line.clock)
    lamp.open()
    lamp.set_volts(4.0)
    for _ in range(10):
        line.clock.now_s += 1.9
        lamp.keep_alive()
    assert line.module.output_v(0) == pytest.approx(4.0)
    line.clock.now_s += 2.1
    with pytest.raises(errors.WatchdogTripped):
        lamp.keep_alive()
    assert line.module.output_v(0) == pytest.approx(1.5)
    lamp.open()
    assert lamp.set_volts(4.0) == pytest.approx(4.0)


def test_a_level_that_went_away_while_the_line_stood_is_found() -> None:
    line, driver = in_memory(ICP, Safety())
    lamp = FostecLamp(driver, LampSettings(), clock=line.clock)
    lamp.open()
    lamp.keep_alive()
    lamp.set_volts(4.0)
    line.module.power_cycle()
    with pytest.raises(errors.ReadBackWrong, match=r"set to 4.000 V, reads back 0.000 V"):
        lamp.keep_alive()


def test_a_trip_outlives_the_power_where_the_maker_says_so() -> None:
    line, driver = in_memory(ICP)
    driver.open()
    driver.write_volts(0, 4.0)
    line.module.trip()
    line.module.power_cycle()
    assert line.module.output_v(0) == pytest.approx(1.5)
    driver.write_volts(0, 4.0)
    assert driver.read_volts(0) == pytest.approx(1.5)
    with pytest.raises(errors.WatchdogTripped, match="reopening clears it"):
        driver.check_trip()
    driver.open()
    driver.write_volts(0, 4.0)
    assert driver.read_volts(0) == pytest.approx(4.0)


@pytest.mark.parametrize("name", [name for name, profile in PROFILES.items() if profile.has_serial])
def test_after_power_comes_back_outputs_stand_at_the_power_on_value(name: str) -> None:
    line, driver = in_memory(name)
    driver.open()
    driver.write_volts(0, 4.0)
    line.module.power_cycle()
    wanted_v = 0.5 if PROFILES[name].power_on_value else 0.0
    assert driver.read_volts(0) == pytest.approx(wanted_v, abs=0.005)


def test_where_a_write_clears_a_trip_it_does() -> None:
    line, driver = in_memory(ICP, Safety())
    driver.open()
    line.module.set_value(manual(260), 1)
    line.module.trip()
    driver.write_volts(0, 4.0)
    assert driver.read_volts(0) == pytest.approx(4.0)
    driver.check_trip()


@pytest.mark.parametrize("name", ["adam-4024", "adam-4021"])
def test_an_adam_in_ascii_mode_is_silent_and_the_error_says_what_to_do(name: str, serve: Any, module_at: Any) -> None:
    server = serve(name)
    driver = module_at(name, server.address, deadline_s=0.3)
    server.module.ascii = True
    with pytest.raises(errors.NoReply, match=r"speaking ASCII: set protocol Modbus with Advantech's utility"):
        driver.open()
    server.module.ascii = False
    driver.open()


def test_a_late_answer_is_not_taken_for_the_next_one() -> None:
    line, driver = in_memory("ato-4ch", Safety())
    driver.open()
    driver.write_volts(0, 4.0)
    line.fault, line.late_s = WireFault.LATE, 0.9
    with pytest.raises(errors.NoReply):
        driver.read_volts(0)
    line.fault = WireFault.NONE
    line.module.power_cycle()
    driver.open()
    assert driver.read_volts(0) == 0.0, "4 V is what was, and came late"


def test_a_level_that_is_no_number_is_wrong(serve: Any, module_at: Any) -> None:
    server = serve("iologik-e1241", tcp=True)
    driver = module_at("iologik-e1241", server.address, deadline_s=5.0)
    driver.open()
    server.module.set_value(PROFILES["iologik-e1241"].read_back, 0x7FC0)
    with pytest.raises(errors.ReplyWrong, match="reads nan V"):
        driver.read_volts(0)


def test_one_program_has_a_unit_over_tcp_at_a_time(serve: Any, module_at: Any) -> None:
    server = serve("iologik-e1241", tcp=True)
    first, second = (module_at("iologik-e1241", server.address, deadline_s=5.0) for _ in range(2))
    first.open()
    with pytest.raises(errors.DeviceGone, match="another program has it open: end that first"):
        second.open()
    first.close()
    second.open()


@pytest.mark.parametrize("name", [name for name, profile in PROFILES.items() if profile.has_serial])
def test_opening_takes_no_more_requests_than_the_profile_says(name: str) -> None:
    """Every point held another value and the watchdog had tripped: the service's stall limit counts on this number."""
    profile, safety = PROFILES[name], SAFETY if name == ICP else Safety()
    line, module = in_memory(name, safety)
    channels = range(profile.channels)
    for wanted in held(profile, channels, safety):
        if wanted.writable and wanted.value is not None:
            line.module.set_value(wanted.point, 1 - min(wanted.value, 1))
    if profile.watchdog and profile.watchdog.clear:
        line.module.trip()
    module.open()
    most = most_requests(profile, channels, safety)
    assert len(line.requests) <= most
    assert name != ICP or len(line.requests) == most == 21
