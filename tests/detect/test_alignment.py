"""No read of the C kernel needs an address that the processor might insist on: built so that such a read ends it."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

DETECT = Path(__file__).parents[2] / "inspector" / "detect"
FILES = ("_background", "_lit", "_measure", "_fit", "_tangles", "_equations", "_bloom")
TRAP = ("-fsanitize=alignment", "-fsanitize-undefined-trap-on-error")
INSPECT = """
import importlib.util, sys
from types import SimpleNamespace
kernel, usual = sys.argv[1], importlib.util.find_spec
found = SimpleNamespace(origin=kernel)
importlib.util.find_spec = lambda name, *a: found if name == "inspector.detect._kernel" else usual(name, *a)
sys.path[:0] = sys.argv[2:]
import numpy as np
from drawn import Drawing, lattice
from test_formats import at_odd_addresses
from inspector.detect import highlights
from inspector.recipe import Detection
drawing = Drawing(shape=(240, 331), full_dn=65535.0)
xy = lattice(6, 5, drawing.shape, np.random.default_rng(0))
image = at_odd_addresses(drawing.draw(xy, drawing.full_dn * np.linspace(0.2, 4, len(xy))))
print(image.ctypes.data % 2, len(highlights.find(image, Detection(), drawing.sensor)))
"""


@pytest.mark.long
def test_frames_at_odd_addresses_are_read_byte_by_byte(peer: Callable[[str, str], str], tmp_path: Path) -> None:
    kernel, sources = tmp_path / "kernel.so", [str(DETECT / f"{name}.c") for name in FILES]
    command = [peer("gcc", "gcc libc6-dev"), "-shared", "-fPIC", "-O1", *TRAP, "-o", str(kernel), *sources, "-lm"]
    subprocess.run(command, check=True, timeout=100)
    folders = [str(Path(__file__).parent), str(Path(__file__).parents[1] / "support")]
    done = subprocess.run([sys.executable, "-c", INSPECT, str(kernel), *folders], capture_output=True, timeout=60)
    assert (done.returncode, done.stdout.split()) == (0, [b"1", b"30"])
