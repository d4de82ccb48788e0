"""A station's devices in the hand of a command that sets them up, with the service stopped."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from threading import Event

import typer

from firmware_bridge import factory
from firmware_bridge.contracts import Camera, Lamp
from firmware_bridge.errors import BridgeError
from inspector.acquire.capture import Wanted, capture
from inspector.acquire.fresh import FreshFrames
from inspector.acquire.keeper import Keeper, Retry
from inspector.model import Frame
from inspector.settings import Settings, SettingsError, load

EXIT_DONE, EXIT_NOT_DONE, EXIT_UNAVAILABLE, EXIT_SETTINGS_REFUSED = 0, 1, 69, 78
"""Exit statuses: done; not possible, or declined; a device cannot be used (EX_UNAVAILABLE); settings (EX_CONFIG)."""

Build = Callable[..., factory.Devices]
AT_ONCE = Retry(0.0, 0.0)
"""A command gives up at the first failure: there is nobody to try again for."""


class NotPossible(Exception):
    """What was asked for cannot be had from this station; the message says why and what to do."""


class Bench:
    """Lamp and camera of a station, opened at their first use. ``settle_s``: a lamp's time to follow its level."""

    def __init__(self, settings: Settings, devices: factory.Devices, settle_s: float) -> None:
        self.settings, self._settle_s = settings, settle_s
        self.camera: Keeper[Camera] = Keeper("camera", FreshFrames(devices.camera), AT_ONCE)
        self.lamp: Keeper[Lamp] = Keeper("lamp", devices.lamp, AT_ONCE)
        self._lit_v: float | None = None

    def frame(self, exposure_us: float, lamp_v: float) -> Frame:
        """One frame taken so, with everything read back. Raises BridgeError."""
        tolerance_v = self.settings.lamp.tolerance_v
        if lamp_v != self._lit_v:
            self.lamp.use(lambda lamp: lamp.set_volts(lamp_v))
            self._lit_v = lamp_v
            self.wait(self._settle_s)
        wanted = Wanted(exposure_us, lamp_v, tolerance_v, self.settings.cycle.exposure_tolerance)
        return capture(self.lamp, self.camera, wanted)

    def warm_up(self, lamp_v: float) -> None:
        """Light the lamp for as long as the settings say that it takes. Raises BridgeError."""
        self.lamp.use(lambda lamp: lamp.set_volts(lamp_v))
        if self.settings.lamp.warm_up_s:
            typer.echo(f"warming the lamp up for {self.settings.lamp.warm_up_s:g} s ...", err=True)
            self.wait(self.settings.lamp.warm_up_s)

    def wait(self, wait_s: float) -> None:
        """Wait, while the lamp's module hears of us often enough for its watchdog. Raises BridgeError."""
        pause_s = (self.settings.module.watchdog_s or 3 * wait_s) / 3
        until_s, pause = time.monotonic() + wait_s, Event()
        while (left_s := until_s - time.monotonic()) > 0:
            pause.wait(min(left_s, pause_s))
            self.lamp.use(lambda lamp: lamp.keep_alive())

    def close(self) -> None:
        """Put the lamp out and close both."""
        self.lamp.close()
        self.camera.close()


def run(config: Path, work: Callable[[Bench], int], *, settle_s: float, build: Build = factory.build) -> int:
    """Do ``work`` with the station's devices, the lamp out at the end; errors are said and become exit statuses."""
    try:
        with _opened(config, settle_s, build) as bench:
            return work(bench)
    except SettingsError as error:
        typer.echo(f"{error}\nrefused: {config}", err=True)
        return EXIT_SETTINGS_REFUSED
    except BridgeError as error:
        typer.echo(str(error), err=True)
        return EXIT_UNAVAILABLE
    except (NotPossible, OSError) as error:
        typer.echo(str(error), err=True)
        return EXIT_NOT_DONE


@contextlib.contextmanager
def _opened(config: Path, settle_s: float, build: Build) -> Iterator[Bench]:
    settings = load(config)
    bench = Bench(settings, build(settings.camera, settings.module, settings.lamp), settle_s)
    with contextlib.closing(bench):
        yield bench
