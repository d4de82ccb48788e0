"""What every module driver promises, over every wire it may be behind; each against the simulator of its profile."""

from __future__ import annotations

from typing import Any

import pytest

from firmware_bridge import errors
from firmware_bridge.wire.modbus import Table
from firmware_bridge.wire.profiles import PROFILES, manual

SERIAL = [(name, False) for name, profile in PROFILES.items() if profile.has_serial]
NETWORK = [(name, True) for name in PROFILES]
"""Over TCP where the module has it, and the others behind a gateway."""


@pytest.fixture(params=SERIAL + NETWORK, ids=lambda wire: f"{wire[0]}-{'tcp' if wire[1] else 'rtu'}")
def wired(request: pytest.FixtureRequest, serve: Any, module_at: Any) -> Any:
    """Profile, simulator and driver, not yet open."""
    name, tcp = request.param
    server = serve(name, tcp=tcp)
    return PROFILES[name], server, module_at(name, server.address, deadline_s=5.0)


def test_levels_written_stand_on_the_terminal_and_read_back(wired: Any) -> None:
    profile, server, driver = wired
    driver.open()
    for channel in range(profile.channels):
        for volts in (0.0, 1.0, 4.0, 5.0):
            driver.write_volts(channel, volts)
            assert server.module.output_v(channel) == pytest.approx(volts, abs=profile.span.step_v)
            assert driver.read_volts(channel) == pytest.approx(server.module.output_v(channel), abs=1e-5)


def test_channels_are_apart(wired: Any) -> None:
    profile, _, driver = wired
    driver.open()
    levels = [0.5 * (channel + 1) for channel in range(profile.channels)]
    for channel, volts in enumerate(levels):
        driver.write_volts(channel, volts)
    assert [driver.read_volts(channel) for channel in range(profile.channels)] == pytest.approx(levels, abs=0.006)


@pytest.mark.parametrize("volts", [11.0, -11.0, float("nan"), float("inf")])
def test_levels_outside_the_span_are_not_sent(wired: Any, volts: float) -> None:
    _, server, driver = wired
    driver.open()
    driver.write_volts(0, 3.0)
    before_v = server.module.output_v(0)
    with pytest.raises(errors.OutOfRange, match="outside"):
        driver.write_volts(0, volts)
    assert server.module.output_v(0) == before_v


def test_channels_it_has_not_are_refused(wired: Any) -> None:
    profile, _, driver = wired
    driver.open()
    for channel in (profile.channels, -1):
        with pytest.raises(errors.OutOfRange, match="not in use"):
            driver.write_volts(channel, 1.0)
        with pytest.raises(errors.OutOfRange, match="not in use"):
            driver.read_volts(channel)


def test_it_closes_twice_and_opens_again(wired: Any) -> None:
    _, _, driver = wired
    driver.close()
    driver.open()
    driver.write_volts(0, 2.0)
    driver.close()
    driver.close()
    with pytest.raises(errors.DeviceGone, match="not open"):
        driver.read_volts(0)
    driver.open()
    driver.open()
    assert driver.read_volts(0) == pytest.approx(2.0, abs=0.005)


def test_reopening_leaves_nothing_behind(wired: Any, descriptors: Any) -> None:
    _, _, driver = wired
    driver.open()
    driver.read_volts(0)
    driver.close()
    before = descriptors()
    for _ in range(20):
        driver.open()
        driver.read_volts(0)
        driver.close()
    # The simulator shares this process, and may not yet have closed the last connection's own end.
    assert descriptors() <= before + 1


def test_counts_outside_the_span_are_refused_by_the_module(wired: Any, master_at: Any) -> None:
    profile, server, _ = wired
    master = master_at(server.address)
    output = profile.output_of(0)
    with pytest.raises(errors.Refused, match="exception 3, illegal data value"):
        master.write(output.table, output.address, profile.span.counts_high + 1)
    with pytest.raises(errors.Refused, match="exception 2, illegal data address"):
        master.read(Table.HOLDING_REGISTERS, 60000)


TRIPPING = [name for name, profile in PROFILES.items() if profile.watchdog]


@pytest.mark.parametrize("name", TRIPPING)
def test_a_tripped_module_ignores_writes_until_reopening_clears_it(name: str, serve: Any, module_at: Any) -> None:
    profile = PROFILES[name]
    server = serve(name, tcp=not profile.has_serial)
    driver = module_at(name, server.address, deadline_s=5.0)
    driver.open()
    driver.write_volts(0, 4.0)
    driver.check_trip()
    server.module.trip()
    driver.write_volts(0, 4.0)
    assert driver.read_volts(0) == pytest.approx(0.0, abs=0.005)
    with pytest.raises(errors.WatchdogTripped, match="ignores writes"):
        driver.check_trip()
    if profile.watchdog.clear is None:
        with pytest.raises(errors.WatchdogTripped, match="maker's tool"):
            driver.open()
        return
    driver.open()
    driver.check_trip()
    driver.write_volts(0, 4.0)
    assert driver.read_volts(0) == pytest.approx(4.0, abs=0.005)


def test_watchdog_and_safe_level_are_set_and_act(serve: Any, module_at: Any) -> None:
    now_s = [0.0]
    server = serve("tm-da1p1r1", clock=lambda: now_s[0])
    driver = module_at("tm-da1p1r1", server.address, deadline_s=5.0, safe_v=1.5, watchdog_s=2.0)
    driver.open()
    driver.write_volts(0, 4.0)
    now_s[0] = 1.9
    assert server.module.output_v(0) == 4.0
    driver.read_volts(0)
    now_s[0] = 3.8
    assert server.module.output_v(0) == 4.0, "every request feeds it"
    now_s[0] = 4.0
    assert server.module.output_v(0) == 1.5, "the host was silent for 2.1 s"
    with pytest.raises(errors.WatchdogTripped):
        driver.check_trip()


def test_another_range_than_the_profiles_is_refused(serve: Any, module_at: Any) -> None:
    server = serve("adam-4024")
    server.module.set_value(manual(40203), 0x30)
    with pytest.raises(errors.Refused, match=r"40203 reads 0x30, not 0x32.*maker's tool"):
        module_at("adam-4024", server.address, deadline_s=5.0).open()


def test_another_data_format_is_put_right(serve: Any, module_at: Any) -> None:
    server = serve("tm-da1p1r1")
    server.module.set_value(manual(269), 0)
    driver = module_at("tm-da1p1r1", server.address, deadline_s=5.0)
    driver.open()
    driver.write_volts(0, 4.0)
    assert server.module.read_bits(Table.COILS, 268, 1) == [True]
