"""Writes a session: each image whole on the disk before its line is in the index, and its settings before either."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from firmware_bridge import whole_file
from firmware_bridge.wire import session
from firmware_bridge.wire.session import Recorded
from inspector.archive.session_frames import version_file
from inspector.model import Image

PART = ".part"
"""End of the name of a file that is being written: whoever finds one after a crash may delete it."""


class SessionWriter:
    """A session in a folder that this makes. Raises FileExistsError if it is there already, unless it is to ``go_on``;
    OSError."""

    def __init__(self, folder: Path, about: Mapping[str, object], *, go_on: bool = False) -> None:
        if not (go_on and folder.is_dir()):
            folder.mkdir(parents=True)
            whole_file.settle(folder.parent)
        self.folder = folder
        self._index = folder / session.INDEX
        self._versions: set[str] = set()
        if not self._index.exists():
            whole_file.write(self._index, session.first_line(about))

    def version(self, name: str, text: str) -> None:
        """Keep a version of the settings, once; frames that name it come after. Raises OSError."""
        if name not in self._versions:
            whole_file.write(self.folder / version_file(name), text)
            self._versions.add(name)

    def keep(self, frames: Sequence[tuple[Image, Recorded]]) -> None:
        """Images (H, W), lossless, each under the name that its ``recorded`` gives it. Raises OSError, and then there
        is no line of any of them, nor an image."""
        import cv2  # a quarter of a second that the registers do not wait for

        written: list[Path] = []
        try:
            for image, recorded in frames:
                path = self.folder / recorded.file
                written.append(path)
                _write_part(path, cv2.imencode(".png", image)[1].tobytes())
            for path in written:
                _part_of(path).replace(path)
            whole_file.settle(self.folder)
            self._append("".join(session.line(recorded) for _, recorded in frames))
        except BaseException:
            for path in written:
                with suppress(OSError):
                    _part_of(path).unlink(missing_ok=True)
                with suppress(OSError):
                    path.unlink(missing_ok=True)
            raise

    def share(self, other: SessionWriter, frames: Sequence[tuple[Image, Recorded]]) -> None:
        """Have frames of another session here too, without writing their images again where the disk can do that.
        Raises OSError."""
        try:
            for _, recorded in frames:
                os.link(other.folder / recorded.file, self.folder / recorded.file)
            whole_file.settle(self.folder)
        except OSError:
            for _, recorded in frames:
                (self.folder / recorded.file).unlink(missing_ok=True)
            self.keep(frames)
        else:
            self._append("".join(session.line(recorded) for _, recorded in frames))

    def _append(self, lines: str) -> None:
        """Lines at the end of the index, whole and on the disk, or none of them."""
        size = self._index.stat().st_size
        with self._index.open("ab") as file:
            try:
                file.write(lines.encode())
                file.flush()
                os.fsync(file.fileno())
            except OSError:
                with suppress(OSError):
                    file.truncate(size)
                raise


def _part_of(path: Path) -> Path:
    return path.with_name(f".{path.name}{PART}")


def _write_part(path: Path, data: bytes) -> None:
    with _part_of(path).open("xb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
