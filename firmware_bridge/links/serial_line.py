"""A serial line to a CCD head: one command, one answer, one deadline over all of it."""

from __future__ import annotations

import time
from collections.abc import Callable

from firmware_bridge.errors import DeviceGone, NoReply, Refused, ReplyWrong
from firmware_bridge.links.ports import Port, PortOpener
from firmware_bridge.wire.ccd_dialects import Answer, AnswerReader, Command, Dialect, Verdict


class CommandLine:
    """Writes and reads settings of a head that speaks ``dialect``, over a port that ``open_port`` opens.

    Both raise DeviceGone (port missing or closed), NoReply (silence), ReplyWrong (noise, or half an answer) or Refused
    (the head's own error), within ``deadline_s`` of the call. After the first, close and open again.
    """

    def __init__(self, device: str, dialect: Dialect, open_port: PortOpener, deadline_s: float) -> None:
        self._device, self._dialect, self._open_port, self._deadline_s = device, dialect, open_port, deadline_s
        self._port: Port | None = None

    def open(self) -> None:
        """Open the port; an open one is closed first. Raises DeviceGone."""
        self.close()
        self._port = self._open_port()

    def close(self) -> None:
        """Close the port; may be called twice, never raises."""
        if self._port:
            self._port.close()
        self._port = None

    def write(self, name: str, value: float) -> Answer:
        """Write a setting, in the head's counts; the answer is done or a warning."""
        return self._ask(Command(name, value), lambda answer: answer.verdict is not Verdict.VALUE)

    def read(self, name: str) -> float:
        """A setting as the head has it, in its counts."""
        answer = self._ask(Command(name), lambda answer: answer.value is not None and answer.name in ("", name))
        assert answer.value is not None
        return answer.value

    def _ask(self, command: Command, answers: Callable[[Answer], bool]) -> Answer:
        """Send, and wait for what answers the command; other answers are late ones of earlier commands."""
        if self._port is None:
            raise DeviceGone(self._device, "not open", "open it first")
        until_s = time.monotonic() + self._deadline_s
        reader = AnswerReader(self._dialect)
        received = 0
        self._port.settle()
        self._port.write(self._dialect.encode(command), self._deadline_s)
        while (left_s := until_s - time.monotonic()) > 0:
            data = self._port.read(left_s)
            received += len(data)
            for answer in reader.receive(data):
                if answer.verdict is Verdict.ERROR:
                    raise self._refused(command, answer)
                if answers(answer):
                    return answer
        raise self._unanswered(command, received)

    def _refused(self, command: Command, answer: Answer) -> Refused:
        what = f"the head refused {self._text(command)!r}: error {answer.code}, {answer.text}"
        return Refused(self._device, what, "check dialect, range and the head's mode")

    def _unanswered(self, command: Command, received: int) -> NoReply | ReplyWrong:
        what = f"to {self._text(command)!r} in {self._deadline_s:g} s"
        if received:
            remedy = "check dialect, baud rate, shield and ground"
            return ReplyWrong(self._device, f"{received} bytes and no answer {what}", remedy)
        return NoReply(self._device, f"no answer {what}", "check the head's power, cable, dialect and baud rate")

    def _text(self, command: Command) -> str:
        return self._dialect.encode(command).decode().strip()
