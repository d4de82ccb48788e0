"""The PLC waits for nothing that the registers do not need: what a start imports before it answers."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

CONFIG = Path(__file__).parents[2] / "config"
HEAVY = {
    "typer",
    "argparse",
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
LATER = {
    "inspector.cli.app",
    "inspector.service.daemon",
    "inspector.service.cycle",
    "inspector.pipeline",
    "inspector.metrics.table",
    "firmware_bridge.factory",
}
"""The service's own parts that come after the registers, or never."""
ARRAYS = {"numpy", "inspector.optics"}
"""What only zones, and panels of several frames, are proved with."""
START = """
import socket, sys
from pathlib import Path
import inspector.__main__, inspector.service.serve
from inspector.service.front import Front
from inspector.publish.plc_server import PlcServer
from inspector.settings import load
from inspector.signals import Signals

settings, here = load(Path(sys.argv[1])), Path(sys.argv[2])
(here / "sequence.json").write_text('{"sequence": 0}')
plc = settings.plc.model_copy(update={"port": 0, "sequence_file": here / "sequence.json"})
archive = settings.archive.model_copy(update={"folder": here / "archive"})
new = {"plc": plc, "archive": archive, "recipe_choice_file": here / "recipe.json", "statistics_file": None}
touched = set()
sys.addaudithook(lambda _, given: touched.update(str(a) for a in given if isinstance(a, str | Path)))
front = Front(settings.model_copy(update=new), Signals())
start = PlcServer.start
PlcServer.start = lambda server: (start(server), needed.update(sys.modules), needed.update(touched))
needed = set()
front.start()
assert archive.folder.is_dir()
with socket.create_connection(("127.0.0.1", front.port), timeout=10) as client:
    client.sendall(bytes.fromhex("000100000006010300000001"))
    answer = client.recv(100)
print(*sorted(needed), answer.hex(), sep="\\n")
"""


@pytest.mark.parametrize(("file", "heavy"), [("demo.yaml", HEAVY | ARRAYS), ("line.yaml", HEAVY)])
def test_nothing_heavy_is_imported_before_a_register_is_answered(file: str, heavy: set[str], tmp_path: Path) -> None:
    command = [sys.executable, "-c", START, str(CONFIG / file), str(tmp_path)]
    said = subprocess.run(command, stdout=subprocess.PIPE, text=True, timeout=60, check=True).stdout.split()
    assert said[-1] == "0001000000050103020000"
    assert "inspector.publish.plc_server" in said
    assert not (heavy | LATER) & set(said)
    assert str(tmp_path / "sequence.json") in said
    assert not [name for name in said if name.startswith(str(tmp_path / "archive"))], "its disk may hang"


def told(*options: str) -> tuple[int, str, set[str]]:
    """Exit status of `inspector run` with settings that are not there, what it logs, and what it has imported."""
    code = (
        "import atexit, sys; atexit.register(lambda: print(*sys.modules)); from inspector.__main__ import main; main()"
    )
    command = [sys.executable, "-c", code, "run", "--config", "none.yaml", *options]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60)
    return ended.returncode, ended.stderr.partition(" ERROR ")[2], set(ended.stdout.split())


def test_a_plain_start_is_the_command_without_its_parser() -> None:
    status, log, imported = told()
    assert (status, log) == (78, "settings refused: none.yaml: cannot be read: No such file or directory\n")
    assert not (HEAVY | LATER | ARRAYS) & imported
    status_of_options, log_of_options, imported = told("--panels", "1")
    assert (status_of_options, log_of_options) == (status, log)
    assert "inspector.cli.app" in imported
