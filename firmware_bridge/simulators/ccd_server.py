"""The wires of a simulated CCD head: a pseudo-terminal for its commands, a pipe or a file for its frames."""

from __future__ import annotations

import enum
import random
from collections.abc import Callable
from pathlib import Path

from firmware_bridge.simulators.ccd_frames import FrameWriter
from firmware_bridge.simulators.ccd_state import Sensor, SimulatedCcdHead, draw
from firmware_bridge.simulators.server import Server
from firmware_bridge.wire.ccd_dialects import CommandReader
from firmware_bridge.wire.raw_frames import RawFormat


class LineFault(enum.StrEnum):
    """What goes wrong with an answer."""

    NONE = "none"
    SILENT = "silent"
    LATE = "late"
    GARBAGE = "garbage"
    NOISY = "noisy"
    TRUNCATED = "truncated"


def spoil(fault: LineFault, answer: bytes) -> bytes:
    """An answer as the fault leaves it; ``noisy`` leaves it whole, with noise before and after."""
    match fault:
        case LineFault.SILENT:
            return b""
        case LineFault.GARBAGE:
            return random.Random(len(answer)).randbytes(len(answer))
        case LineFault.NOISY:
            return b"\xff\x00#\x80" + answer + b"\x00~\xfe"
        case LineFault.TRUNCATED:
            return answer[: len(answer) // 2]
        case _:
            return answer


class CcdServer(Server):
    """Serves one head. ``address`` is the terminal's path; ``writer`` writes its frames, if it was given a path.

    ``fault`` may be set at any time, from any thread: it spoils every answer.
    """

    def __init__(
        self,
        head: SimulatedCcdHead,
        *,
        symlink: Path | None = None,
        frames: Path | None = None,
        form: RawFormat | None = None,
        rate_hz: float = 0.0,
    ) -> None:
        super().__init__()
        self.head, self.fault, self.late_s = head, LineFault.NONE, 1.0
        reader = CommandReader(head.dialect)
        self.address, send = self.open_terminal(lambda data: self._receive(reader, data, send), symlink)
        self.writer: FrameWriter | None = None
        if frames:
            self.writer = _writer(head, frames, form or RawFormat(640, 480, 8), rate_hz)
            self.cleanup.callback(self.writer.stop)

    def _receive(self, reader: CommandReader, data: bytes, send: Callable[[bytes], object]) -> None:
        for line in reader.receive(data):
            answer = self.head.dialect.encode_answer(self.head.answer(line))
            if self.fault is LineFault.LATE:
                self.wait(self.late_s)
            if spoiled := spoil(self.fault, answer):
                send(spoiled)


def _writer(head: SimulatedCcdHead, path: Path, form: RawFormat, rate_hz: float) -> FrameWriter:
    sensor = Sensor(draw(form.width_px, form.height_px), form.bits)
    return FrameWriter(head, sensor, form, path, rate_hz)
