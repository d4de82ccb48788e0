"""Memory that was needed for a moment is not kept."""

from __future__ import annotations

import subprocess
import sys

IMAGES_THAT_WAITED = """
import os
from pathlib import Path
from inspector import heap

def resident():
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")

heap.keep_images_off()
image = b"x" * 307_200
del image
before, images, rows = resident(), [], []
for number in range(100):
    images.append(number.to_bytes(4, "little") * 76_800)
    rows.append(b"x" * (600 + number))
most = resident() - before
images.clear()
print(most, resident() - before)
"""


def test_images_that_waited_while_small_blocks_outlive_them_leave_nothing_behind() -> None:
    said = subprocess.run([sys.executable, "-c", IMAGES_THAT_WAITED], capture_output=True, check=True, text=True)
    most, kept = map(int, said.stdout.split())
    assert most > 30e6
    assert kept < 1e6
