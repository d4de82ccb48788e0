"""Writes a session: each image whole on the disk before its line is in the index, and its settings before either."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import cv2

from firmware_bridge import whole_file
from firmware_bridge.wire import session
from firmware_bridge.wire.session import Recorded
from inspector.archive.session_frames import version_file
from inspector.model import Image


class SessionWriter:
    """A session in a folder that this makes. Raises FileExistsError if it is there already, OSError."""

    def __init__(self, folder: Path, about: Mapping[str, object]) -> None:
        folder.mkdir(parents=True)
        self.folder = folder
        self._index = folder / session.INDEX
        self._versions: set[str] = set()
        whole_file.write(self._index, session.first_line(about))

    def version(self, name: str, text: str) -> None:
        """Keep a version of the settings, once; frames that name it come after. Raises OSError."""
        if name not in self._versions:
            whole_file.write(self.folder / version_file(name), text)
            self._versions.add(name)

    def keep(self, image: Image, recorded: Recorded) -> int:
        """The image (H, W), lossless, under the name that ``recorded`` gives it; how many bytes it took. Raises
        OSError, and then there is no line of it."""
        png = cv2.imencode(".png", image)[1].tobytes()
        whole_file.write(self.folder / recorded.file, png)
        with self._index.open("a", encoding="utf-8") as file:
            file.write(session.line(recorded))
            file.flush()
            os.fsync(file.fileno())
        return len(png)
