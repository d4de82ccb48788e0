"""Recorded frames shown as if a camera took them, at a set rate or as fast as they are asked for."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from pathlib import Path

from firmware_bridge.contracts import CameraCapabilities, CameraFrame
from firmware_bridge.drivers.pace import Pace
from firmware_bridge.errors import BridgeError, DeviceGone, EndOfRecording, OutOfRange, ReplyWrong
from firmware_bridge.wire import image, session

SUFFIXES = frozenset({".png", ".tif", ".tiff", ".bmp", ".pgm", ".npy"})
"""What in a folder is a frame, by the end of its name in lower case."""

EXPOSURE_MIN_US, EXPOSURE_MAX_US, EXPOSURE_STEP_US = 1.0, 1e6, 1.0
"""The range of the line camera the recordings stand for: 1 us to 1 s in steps of 1 us."""


class ReplayCamera:
    """Implements :class:`firmware_bridge.contracts.Camera` over image files and folders of them.

    Files are decoded when they are due, one at a time. A file that cannot be read raises ReplyWrong with its name,
    and the next grab goes on with the next file; a missing folder raises DeviceGone, and after reopening the
    recording goes on where it was. A folder with an index (:mod:`firmware_bridge.wire.session`) is shown in its order,
    and its frames carry the exposure they were taken at; other recordings do not say: theirs carry the one that was
    set, None before it is set. After the last frame it starts again (``loop``) or raises EndOfRecording.
    """

    simulated = True

    def __init__(
        self,
        paths: Sequence[Path],
        *,
        rate_hz: float = 0.0,
        loop: bool = True,
        deadline_s: float = 5.0,
        device: str = "camera",
    ) -> None:
        self._paths, self._device = tuple(paths), device
        self._loop, self._pace = loop, Pace(rate_hz, deadline_s, device)
        self._files: list[Path] = []
        self._recorded_us: dict[Path, float | None] = {}
        self._position = 0
        self._taken = 0
        self._exposure_us: float | None = None
        self._shape: tuple[int, int] | None = None

    def open(self) -> None:
        """List the files. Raises DeviceGone if a path is missing or no frames are found."""
        self._files = self._listed()
        self._pace.start()

    def close(self) -> None:
        """Stop showing frames; a grab that waits in another thread ends at once. May be called twice."""
        self._pace.stop()

    def capabilities(self) -> CameraCapabilities:
        """See the contract; the shape is that of the last frame."""
        height, width = self._shape or (None, None)
        return CameraCapabilities(EXPOSURE_MIN_US, EXPOSURE_MAX_US, EXPOSURE_STEP_US, width, height)

    def set_exposure_us(self, exposure_us: float) -> float:
        """See the contract; kept as it is, since nothing is exposed anew."""
        if not EXPOSURE_MIN_US <= exposure_us <= EXPOSURE_MAX_US:
            what = f"exposure {exposure_us} us is outside {EXPOSURE_MIN_US:g} to {EXPOSURE_MAX_US:g} us"
            raise OutOfRange(self._device, what, "ask for an exposure in that range")
        self._exposure_us = exposure_us
        return exposure_us

    def grab(self) -> CameraFrame:
        """See the contract. Raises EndOfRecording after the last frame, unless it loops."""
        self._pace.wait()
        path = self._next_file()
        self._taken += 1
        frame_id, taken_at_s, taken_s = self._taken, time.time(), time.monotonic()
        try:
            grey = image.decode(path.read_bytes())
        except OSError as error:
            raise self._missing(path, error) from error
        except image.ImageWrong as error:
            raise ReplyWrong(self._device, f"{path} {error}") from error  # its words end in what to do
        self._shape = (grey.shape[0], grey.shape[1])
        exposure_us = self._recorded_us.get(path, self._exposure_us)
        return CameraFrame(grey, frame_id, _shown(path), exposure_us, taken_at_s, taken_s)

    def _next_file(self) -> Path:
        if self._position >= len(self._files):
            if not self._loop:
                raise EndOfRecording(self._device, f"all {len(self._files)} frames were shown", "set loop: true")
            self._files, self._position = self._listed(), 0
        path = self._files[self._position]
        self._position += 1
        return path

    def _listed(self) -> list[Path]:
        """Every file of the paths, a folder's as its index says or sorted by name. Raises DeviceGone."""
        files: list[Path] = []
        self._recorded_us = {}
        try:
            for path in self._paths:
                index = path / session.INDEX
                if index.is_file():
                    recorded = session.parse(index.read_text(encoding="utf-8"))
                    self._recorded_us.update({path / r.file: r.exposure_us for r in recorded})
                    files += [path / r.file for r in recorded]
                else:
                    files += _frames_in(path)
        except (session.SessionWrong, UnicodeDecodeError) as error:
            raise DeviceGone(self._device, f"{index}: {error}", "mend the index, or take it away") from error
        except OSError as error:
            what = f"cannot read {error.filename}: {error.strerror}"
            raise DeviceGone(self._device, what, "check the path and its permissions") from error
        if not files:
            shown = ", ".join(map(str, self._paths))
            raise DeviceGone(self._device, f"no frames in {shown}", "put PNG, TIFF, BMP, PGM or npy files there")
        return files

    def _missing(self, path: Path, error: OSError) -> BridgeError:
        """One file lost is a wrong frame; its whole folder lost is a camera unplugged, and the file is still due."""
        if path.parent.is_dir():
            return ReplyWrong(self._device, f"{path}: {error.strerror}", "put the file back, or restart the recording")
        self._position -= 1
        return DeviceGone(self._device, f"folder {path.parent} is missing", "put the folder back")


def _shown(path: Path) -> str:
    """The path as text that any file and terminal takes: bytes that are no UTF-8 are written out."""
    return os.fsencode(path).decode("utf-8", "backslashreplace")


def _frames_in(path: Path) -> list[Path]:
    if not path.is_dir():
        path.stat()
        return [path]
    return sorted(file for file in path.iterdir() if file.suffix.lower() in SUFFIXES)
