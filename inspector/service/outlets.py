"""Where results go: the registers' server and the PLC that is written to; made anew when the settings change.

The cycle's thread calls; what it calls never waits for a client.
"""

from __future__ import annotations

import logging
import threading
import time
from importlib.metadata import version
from typing import TYPE_CHECKING

from inspector.cycle_settings import Timed
from inspector.metrics.observed import Observed
from inspector.model import Snapshot
from inspector.publish import address, console
from inspector.publish.plc_server import PRODUCT, PlcServer, PlcServerError, as_stalled
from inspector.publish.systemd import Notifier
from inspector.service.control import PlcControl
from inspector.settings import Settings

if TYPE_CHECKING:
    from inspector.metrics.server import MetricsServer
    from inspector.metrics.table import Gauges, Scrape
    from inspector.service.posting import Poster

log = logging.getLogger(__name__)

STALL_MARGIN_S = 1.5
"""What a cycle may take beyond its devices' deadlines before the PLC is told that it has stalled."""
LAMP_REQUESTS = 4
"""Requests to the lamp's module around a frame: write and read back, read after the grab, and 0 V when that fails."""


class Outlets:
    """The servers of one station. ``control`` is told what the PLC writes, ``notifier`` how long a cycle may take."""

    def __init__(self, settings: Settings, control: PlcControl, notifier: Notifier, observed: Observed) -> None:
        self._settings, self._control, self._notifier, self._observed = settings, control, notifier, observed
        self.server = _server(settings, control)
        self._poster: Poster | None = None
        self._turn_to_post = threading.Lock()
        self._metrics: MetricsServer | None = None
        self._version = version(PRODUCT)
        self.gauges: list[Gauges] = []
        """What other parts offer to be measured; each row is in the table of :mod:`inspector.metrics.table`."""

    def start(self, first: Snapshot) -> None:
        """Serve and post, ``first`` before anything else. Raises PlcServerError."""
        self.server.start()
        self._serve()
        self._post_anew(None, first)
        self._measure_anew(None)
        _say_where(self._settings, self.server)

    def reach(self, new: Settings, *, renews_certificates: bool) -> None:
        """Listen as ``new`` says. Raises PlcServerError, and then listens on as before."""
        if new.plc.served != self._settings.plc.served:
            self._serve_anew(new)
        elif renews_certificates:
            self.server.renew_certificates()

    def take_over(self, new: Settings, shown: Snapshot) -> None:
        """Go on by settings that were reached; ``shown`` is what the station is."""
        old, self._settings = self._settings, new
        self._serve()
        self._post_anew(old, shown)
        self._measure_anew(old)

    def stop(self) -> None:
        """End, and say in the log what is lost by it."""
        if untaken := self._control.untaken:
            log.error("stopped with %d results that the PLC has not taken: they are lost to it", untaken)
        if self._poster and (left := self._poster.stop().undelivered):
            log.error("stopped with %d results that were not posted: they are lost to the PLC", left)
        if self._metrics:
            self._metrics.stop()
        self.server.stop()

    def _serve_anew(self, new: Settings) -> None:
        """Serve as ``new`` says. Raises PlcServerError, and then serves on as before."""
        server = _server(new, self._control)
        in_the_way = bool(new.plc.ports & self._settings.plc.ports)
        if in_the_way:
            self.server.stop()
        # Before anybody can connect: whoever is first finds the results where they were.
        self._control.serve(server, new.plc.word_order, new.plc.buffer_results)
        try:
            server.start()
        except PlcServerError:
            if in_the_way:
                self.server = _server(self._settings, self._control)
                self.server.start()
            self._serve()
            raise
        self.server.stop()
        self.server = server
        _say_where(new, server)

    def _serve(self) -> None:
        """Registers are shown by this server, as the settings say, and the cycle may be silent as they let it."""
        plc = self._settings.plc
        self._control.serve(self.server, plc.word_order, plc.buffer_results)
        self.server.stall_after_s = longest_silence_s(self._settings)
        self._notifier.allow_silence(self.server.stall_after_s)

    def _post_anew(self, old: Settings | None, shown: Snapshot) -> None:
        """Write results into the PLC that the settings name, if that is not what is done already."""
        plc = self._settings.plc
        if old is not None and (plc.post, plc.word_order) == (old.plc.post, old.plc.word_order):
            return
        self._control.post(None)
        left = self._poster.stop() if self._poster else None
        self._poster = None
        if plc.post is not None:
            from firmware_bridge import factory  # only stations that post pay for it, before registers are served
            from inspector.service.posting import Poster

            master = factory.build_plc_master(plc.post.host, plc.post.port, plc.post.unit, plc.post.deadline_s)
            self._poster = Poster(
                plc.post,
                master,
                shown,
                turn=self._turn_to_post,
                word_order=plc.word_order,
                stalled=self._is_stalled,
            )
            if left is not None:
                self._poster.take_over(left)
            self._poster.start()
        self._control.post(self._poster)

    def _is_stalled(self) -> bool:
        return self.server.stalled

    def _measure_anew(self, old: Settings | None) -> None:
        """Serve measured values as the settings say, if they are not served so already."""
        metrics = self._settings.metrics
        if old is not None and metrics == old.metrics:
            return
        if self._metrics:
            self._metrics.stop()
        self._metrics = None
        if metrics is not None:
            from inspector.metrics.server import MetricsServer  # asyncio: stations without this need not wait

            self._metrics = MetricsServer(metrics, self._scrape)
            self._metrics.start()

    def _scrape(self) -> Scrape:
        """What is measured, at this moment: everything read here is replaced whole by whoever changes it."""
        from inspector.metrics import process
        from inspector.metrics.table import Scrape

        server, poster, trigger = self.server, self._poster, self._settings.cycle.trigger
        station = self._control.station
        return Scrape(
            station=as_stalled(station) if server.stalled else station,
            observed=self._observed,
            plc=server.diagnostics,
            now_s=time.monotonic(),
            unix_s=time.time(),
            name=self._settings.station,
            version=self._version,
            period_s=1 / trigger.rate_hz if isinstance(trigger, Timed) else None,
            posting=poster.box if poster else None,
            process=process.now(),
            more={name: value for gauges in tuple(self.gauges) for name, value in gauges().items()},
        )


def _say_where(settings: Settings, server: PlcServer) -> None:
    """To people, and to programs of this machine."""
    console.say(console.how_to_poll(settings.plc.host, server.port))
    address.tell(settings.plc.host, server.port, settings.plc.unit_ids[0])


def _server(settings: Settings, control: PlcControl) -> PlcServer:
    return PlcServer(
        stall_after_s=longest_silence_s(settings),
        on_control=control.write,
        name=settings.station,
        **settings.plc.served,
    )


def longest_silence_s(settings: Settings) -> float:
    """How long a cycle may be silent: the longest step around which it waits, opening the module or taking a frame."""
    module = settings.module
    frame_s = settings.camera.slowest_s + LAMP_REQUESTS * module.deadline_s
    return max(frame_s, module.opening_s) + STALL_MARGIN_S
