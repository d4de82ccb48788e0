"""A grey frame from a file, or one sentence that says why not."""

from __future__ import annotations

import stat
from pathlib import Path

from firmware_bridge.wire import image
from inspector.model import Image


class FrameUnreadable(Exception):
    """The file holds no grey frame. The message names the file, ``sentence`` the problem and the remedy."""

    def __init__(self, path: Path, sentence: str) -> None:
        self.sentence = sentence
        super().__init__(f"{path}: {sentence}")


def read(path: Path) -> Image:
    """The frame (H, W), uint8 or uint16, of a PNG, TIFF, BMP, PGM or .npy file. Raises FrameUnreadable.

    Devices and pipes, which may never end, are not opened.
    """
    try:
        mode = path.stat().st_mode
        if stat.S_ISDIR(mode):
            raise FrameUnreadable(path, "is a folder; name the frames in it")
        if not stat.S_ISREG(mode):
            raise FrameUnreadable(path, f"is no ordinary file; save the frame as {image.KINDS_TEXT}")
        return image.decode(path.read_bytes())
    except FileNotFoundError:
        raise FrameUnreadable(path, "no such file; check the path") from None
    except OSError as error:
        reason = f"cannot be read ({error.strerror}); check its permissions and its disk"
        raise FrameUnreadable(path, reason) from error
    except ValueError as error:  # ImageWrong, and a path that no file can have (a zero byte in it)
        raise FrameUnreadable(path, str(error)) from error
