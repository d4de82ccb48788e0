"""The lamp: percent and volts, the clamp that nothing passes, read-back after every write, 0 V at the end."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_bridge import errors
from firmware_bridge.drivers.lamp import FostecLamp
from firmware_bridge.settings import LampSettings
from firmware_bridge.simulators.module_server import WireFault
from firmware_bridge.wire.profiles import PROFILES

MEASURED = ((0.0, 0.0), (50.0, 1.5), (100.0, 4.5))


@pytest.fixture(params=PROFILES)
def lit(request: pytest.FixtureRequest, serve: Any, module_at: Any) -> Any:
    """Simulator and open lamp, on the last channel of every profile."""
    profile = PROFILES[request.param]
    server = serve(profile.name, tcp=not profile.has_serial)
    channel = profile.channels - 1
    lamp = FostecLamp(module_at(profile.name, server.address, deadline_s=5.0), LampSettings(channel=channel))
    lamp.open()
    yield server, lamp, channel
    lamp.close()


def test_it_reads_back_what_stands_on_the_terminal(lit: Any) -> None:
    server, lamp, channel = lit
    for volts in (0.0, 0.1, 3.75, 5.0):
        assert lamp.set_volts(volts) == pytest.approx(volts, abs=0.005)
        assert lamp.read_volts() == pytest.approx(server.module.output_v(channel), abs=1e-5)


def test_nothing_passes_the_clamp(lit: Any) -> None:
    server, lamp, channel = lit
    lamp.set_volts(2.0)
    for volts in (5.001, 10.0, -0.001, float("nan"), float("inf")):
        with pytest.raises(errors.OutOfRange, match="outside 0 to 5"):
            lamp.set_volts(volts)
    for percent in (100.1, -0.1, float("nan")):
        with pytest.raises(errors.OutOfRange, match="outside 0 to 100 %"):
            lamp.set_percent(percent)
    assert server.module.output_v(channel) == pytest.approx(2.0, abs=0.005)
    lamp.set_percent(100.0)
    assert server.module.output_v(channel) <= 5.0


def test_closing_puts_it_out(lit: Any) -> None:
    server, lamp, channel = lit
    lamp.set_percent(80.0)
    lamp.close()
    assert server.module.output_v(channel) == pytest.approx(0.0, abs=0.005)
    lamp.close()


def test_closing_never_raises(lit: Any) -> None:
    server, lamp, _ = lit
    lamp.set_percent(80.0)
    server.stop()
    lamp.close()


def test_a_dead_output_is_seen_at_once(lit: Any) -> None:
    server, lamp, _ = lit
    lamp.set_volts(1.0)
    server.module.stuck = True
    with pytest.raises(errors.ReadBackWrong, match=r"set to 4.000 V, reads back (1.000|0.99\d) V"):
        lamp.set_volts(4.0)


def test_a_tripped_watchdog_is_named(serve: Any, module_at: Any) -> None:
    server = serve("tm-da1p1r1")
    lamp = FostecLamp(module_at("tm-da1p1r1", server.address, deadline_s=5.0), LampSettings())
    lamp.open()
    lamp.set_volts(4.0)
    server.module.trip()
    with pytest.raises(errors.WatchdogTripped):
        lamp.set_volts(4.0)
    lamp.close()
    lamp.open()
    assert lamp.set_volts(4.0) == pytest.approx(4.0)


def test_faults_of_the_wire_pass_through(serve: Any, module_at: Any) -> None:
    server = serve("ato-4ch")
    lamp = FostecLamp(module_at("ato-4ch", server.address, deadline_s=0.2), LampSettings())
    lamp.open()
    server.fault = WireFault.SILENT
    with pytest.raises(errors.NoReply):
        lamp.set_volts(4.0)
    lamp.close()


@given(st.floats(0, 100))
def test_a_measured_curve_goes_both_ways(percent: float) -> None:
    settings = LampSettings(curve=MEASURED)
    assert 0 <= settings.volts(percent) <= 4.5
    assert settings.percent(settings.volts(percent)) == pytest.approx(percent, abs=1e-9)


@given(st.floats(allow_nan=True, allow_infinity=True))
def test_no_percentage_asks_for_more_than_the_lamp_takes(percent: float) -> None:
    assert 0.0 <= LampSettings().volts(percent) <= 5.0


def test_percent_follows_the_curve(serve: Any, module_at: Any) -> None:
    server = serve("waveshare-ao-8ch-b")
    driver = module_at("waveshare-ao-8ch-b", server.address, deadline_s=5.0)
    lamp = FostecLamp(driver, LampSettings(curve=MEASURED, channel=2))
    lamp.open()
    assert lamp.set_percent(75.0) == pytest.approx(3.0)
    assert LampSettings().volts(80.0) == pytest.approx(4.0)
    lamp.close()
