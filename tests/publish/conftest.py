"""What the tests of the PLC server share."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import pytest

from inspector.publish.plc_server import PlcServer


@pytest.fixture
def start() -> Iterator[Callable[..., PlcServer]]:
    """Starts servers on free ports, and stops them."""
    with ExitStack() as started:

        def run(**options: Any) -> PlcServer:
            server = PlcServer(port=0, **{"stall_after_s": 60.0} | options)
            server.start()
            started.callback(server.stop)
            return server

        yield run
