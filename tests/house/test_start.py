"""The PLC waits for nothing that the registers do not need: what a start imports before it answers."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

CONFIG = Path(__file__).parents[2] / "config"
HEAVY = {
    "cv2",
    "scipy",
    "pymodbus",
    "serial",
    "ssl",
    "asyncio",
    "rich",
    "pandas",
    "pyarrow",
    "dask",
    "prometheus_client",
}
LATER = {f"inspector.{name}" for name in ("daemon", "cycle", "pipeline")} | {"firmware_bridge.factory"}
"""The service's own parts that come after the registers."""
START = """
import socket, sys
from pathlib import Path
import inspector.cli.app, inspector.service.serve
from inspector.service.front import Front
from inspector.publish.plc_server import PlcServer
from inspector.settings import load
from inspector.signals import Signals

settings, here = load(Path(sys.argv[1])), Path(sys.argv[2])
plc = settings.plc.model_copy(update={"port": 0, "sequence_file": here / "sequence.json"})
archive = settings.archive.model_copy(update={"folder": here})
front = Front(settings.model_copy(update={"plc": plc, "archive": archive}), Signals())
start = PlcServer.start
PlcServer.start = lambda server: (start(server), needed.update(sys.modules))
needed = set()
front.start()
with socket.create_connection(("127.0.0.1", front.port), timeout=10) as client:
    client.sendall(bytes.fromhex("000100000006010300000001"))
    answer = client.recv(100)
print(*sorted(needed), answer.hex(), sep="\\n")
"""


@pytest.mark.parametrize("file", ["demo.yaml", "line.yaml"])
def test_nothing_heavy_is_imported_before_a_register_is_answered(file: str, tmp_path: Path) -> None:
    command = [sys.executable, "-c", START, str(CONFIG / file), str(tmp_path)]
    said = subprocess.run(command, stdout=subprocess.PIPE, text=True, timeout=60, check=True).stdout.split()
    assert said[-1] == "0001000000050103020000"
    assert "inspector.publish.plc_server" in said
    assert not (HEAVY | LATER) & set(said)
