"""On a process's path: a frame in a folder named `crashes` ends it when read, as a fault in compiled code does."""

import os
import signal
from pathlib import Path

from inspector import imagefile
from inspector.model import Image

_read = imagefile.read


def _crashing(path: Path) -> Image:
    if path.parent.name == "crashes" and path.name == "000002.png":
        os.kill(os.getpid(), signal.SIGSEGV)
    return _read(path)


imagefile.read = _crashing
