"""Aravis' GigE Vision camera as a process that can be killed and started again, and its turn at the port."""

from __future__ import annotations

import resource
import socket
import subprocess
from dataclasses import astuple, dataclass
from pathlib import Path
from types import TracebackType

import numpy as np
import numpy.typing as npt

from firmware_bridge.drivers.genicam_features import Region
from firmware_bridge.wire import image

PEERS = Path(__file__).parents[1] / "peers"
SERIAL, ADDRESS = "SCENE1", "127.0.0.1"
PORT = "port 3956 of 127.0.0.1"
"""The one of GigE Vision, for one camera at a time: an xdist_group, so that one worker has them one after the other."""
ALLOCATORS_KIB = 4096
SCENE_US = 1000.0
"""The exposure at which it shows the scene as it is."""


@dataclass(frozen=True, slots=True)
class Traces:
    """What a process holds: descriptors, threads, and memory in KiB."""

    descriptors: int
    threads: int
    memory_kib: int

    @classmethod
    def of(cls, pid: int) -> Traces:
        """As it is now."""
        process = Path("/proc", str(pid))
        pages = int((process / "statm").read_text().split()[1])
        held = [len(list((process / folder).iterdir())) for folder in ("fd", "task")]
        return cls(held[0], held[1], pages * resource.getpagesize() // 1024)

    def within(self, before: Traces, spare: int = 0) -> bool:
        """Whether no more is held than before, but for what allocators keep, and ``spare`` descriptors and threads."""
        fits = self.memory_kib <= before.memory_kib + ALLOCATORS_KIB
        return fits and self.descriptors <= before.descriptors + spare and self.threads <= before.threads + spare


class Turn:
    """GigE Vision has one port: also runs of the tests beside each other take turns, by a name that the kernel gives to
    one at a time."""

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)

    def __enter__(self) -> Turn:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._socket.close()

    def taken(self) -> bool:
        """Whether it is ours now."""
        try:
            self._socket.bind(f"\0{PORT}")
        except OSError:
            return False
        return True


class GigeCamera:
    """The process. ``features`` is a file beside its source, or "-" for Aravis' own, with their older names."""

    def __init__(self, program: str, scene: Path, folder: Path, features: str, lost: float) -> None:
        self.scene = image.decode(scene.read_bytes())
        pgm = folder / "scene.pgm"
        height_px, width_px = self.scene.shape
        pgm.write_bytes(b"P5 %d %d 255\n" % (width_px, height_px) + self.scene.tobytes())
        self._command = [program, features if features == "-" else str(PEERS / features), str(pgm), str(lost)]
        self._process: subprocess.Popen[str] | None = None

    def start(self) -> None:
        """Plug it in; returns once it listens."""
        pipe = subprocess.PIPE
        self._process = subprocess.Popen(self._command, stdin=pipe, stdout=pipe, stderr=pipe, text=True)
        assert self._process.stdout is not None
        said = self._process.stdout.readline()
        assert said == "ready\n", self._process.communicate(timeout=30)[1]

    def kill(self) -> None:
        """Pull the plug (SIGKILL)."""
        if self._process is not None:
            self._process.kill()
            self._process.communicate(timeout=30)
            self._process = None

    def pulse(self) -> None:
        """A signal on Line0."""
        assert self._process is not None
        assert self._process.stdin is not None
        self._process.stdin.write("\n")
        self._process.stdin.flush()

    def shown(
        self, exposure_us: float, bits: int = 8, gain_db: int = 0, region: Region | None = None
    ) -> npt.NDArray[np.uint16]:
        """What it shows at an exposure."""
        x_px, y_px, width_px, height_px = astuple(region) if region else (0, 0, *self.scene.shape[::-1])
        scale = exposure_us / SCENE_US * 10 ** (gain_db / 20) * (1 << (bits - 8))
        bright = np.floor(self.scene[y_px : y_px + height_px, x_px : x_px + width_px] * scale + 0.5)
        return np.minimum(bright, (1 << bits) - 1).astype(np.uint16)
