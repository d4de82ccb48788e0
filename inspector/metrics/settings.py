"""What a station must say about the page of its measured values."""

from __future__ import annotations

from pydantic import Field

from firmware_bridge.strict import Strict
from inspector.publish.plc_access import LOOPBACK
from inspector.publish.plc_settings import Network


class MetricsSettings(Strict):
    """Measured values of the station for Prometheus, over HTTP at /metrics."""

    host: str = Field("127.0.0.1", min_length=1)
    """Address of this machine to listen on; 0.0.0.0 for all of them."""
    port: int = Field(9464, ge=0, le=65535)
    """TCP port; 0 takes any free one, which the log names."""
    allow: tuple[Network, ...] = LOOPBACK
    """Addresses and networks that may connect."""
