"""A CCD head set over a serial line; frames come another way: Video4Linux, or a grabber's device, pipe or file."""

from __future__ import annotations

import time
from dataclasses import dataclass

from firmware_bridge.contracts import CameraCapabilities, CameraFrame
from firmware_bridge.drivers.moment import monotonic_s
from firmware_bridge.errors import NoReply, NoTrigger, OutOfRange, ReadBackWrong, ReplyWrong
from firmware_bridge.links.frame_sources import FrameSource
from firmware_bridge.links.serial_line import CommandLine
from firmware_bridge.wire.ccd_dialects import Answer, Dialect, Verdict
from firmware_bridge.wire.raw_frames import RawFrame

FRAMES_UNDER_WAY = 2
"""A head that runs freely exposes one frame while it reads another out: both began before they were asked for."""


@dataclass(frozen=True, slots=True)
class Head:
    """A head: its dialect, its exposure range, and microseconds in one count of its exposure."""

    dialect: Dialect
    exposure_min_us: float
    exposure_max_us: float
    us_per_count: float = 1.0
    trigger: str = "Off"

    @property
    def step_us(self) -> float:
        """The least difference between two exposures."""
        return self.us_per_count * float(10**-self.dialect.exposure_decimals)

    @property
    def rounding_us(self) -> float:
        """How far the head may round an exposure."""
        return max(self.dialect.rounding_us, self.step_us)


class SerialCcdCamera:
    """Implements :class:`firmware_bridge.contracts.Camera`.

    The trigger mode is set when it is opened. An exposure that the head clips, or reads back further off than it may
    round, raises ReadBackWrong. A frame is new: what had come, or was under way, when it was asked for is thrown away.
    """

    simulated = False

    def __init__(
        self, head: Head, line: CommandLine, source: FrameSource, *, deadline_s: float, device: str = "camera"
    ) -> None:
        self._head, self._line, self._source = head, line, source
        self._deadline_s, self._device = deadline_s, device
        self._shape: tuple[int, int] | None = None
        self._taken = 0
        self._number: int | None = None

    def open(self) -> None:
        """Open line and frames, and set the trigger mode. Raises DeviceGone, NoReply, ReplyWrong, Refused."""
        self.close()
        self._number = None
        try:
            self._line.open()
            for name, value in self._head.dialect.modes[self._head.trigger].items():
                self._line.write(name, value)
            self._source.open()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """See the contract."""
        self._source.close()
        self._line.close()

    def capabilities(self) -> CameraCapabilities:
        """See the contract; the shape is that of the last frame. Off is a head that runs freely."""
        head, (height, width) = self._head, self._shape or (None, None)
        triggers = tuple(head.dialect.modes)
        return CameraCapabilities(
            head.exposure_min_us, head.exposure_max_us, head.step_us, width, height, triggers=triggers
        )

    def set_exposure_us(self, exposure_us: float) -> float:
        """See the contract. Raises ReadBackWrong if the head took another exposure."""
        head = self._head
        if not head.exposure_min_us <= exposure_us <= head.exposure_max_us:
            what = f"exposure {exposure_us} us is outside {head.exposure_min_us:g} to {head.exposure_max_us:g} us"
            raise OutOfRange(self._device, what, "ask for an exposure in that range")
        answer = self._line.write(head.dialect.exposure, exposure_us / head.us_per_count)
        read_us = self._line.read(head.dialect.exposure) * head.us_per_count
        if self._is_clipped(answer) or not abs(read_us - exposure_us) <= head.rounding_us:
            said = f" ({answer.text})" if answer.text else ""
            what = f"reads back {read_us:g} us, not {exposure_us:g} us{said}"
            raise ReadBackWrong(self._device, what, "ask for an exposure in the head's own range, and set that range")
        return read_us

    def grab(self) -> CameraFrame:
        """See the contract."""
        until_s = time.monotonic() + self._deadline_s
        self._source.discard()
        for _ in range(FRAMES_UNDER_WAY if self._head.trigger == "Off" else 0):
            self._count(self._read(until_s))
        frame = self._triggered(until_s)
        self._count(frame)
        self._shape = (frame.image.shape[0], frame.image.shape[1])
        taken_at_s = time.time() if frame.taken_at_s is None else frame.taken_at_s
        name = f"{self._source.name}#{self._taken}"
        taken_s = monotonic_s(taken_at_s, self._deadline_s)
        return CameraFrame(frame.image, self._taken, name, frame.exposure_us, taken_at_s, taken_s)

    def _read(self, until_s: float) -> RawFrame:
        return self._source.read(max(until_s - time.monotonic(), 0.0))

    def _triggered(self, until_s: float) -> RawFrame:
        """The next frame. Without one, a head on a trigger line that answers is only waiting. Raises NoTrigger."""
        try:
            return self._read(until_s)
        except NoReply:
            if self._head.trigger == "Off":
                raise
        self._line.read(self._head.dialect.exposure)
        raise NoTrigger(self._device, f"no signal on {self._head.trigger} in {self._deadline_s:g} s")

    def _count(self, frame: RawFrame) -> None:
        """Count by the camera's own numbers, where frames have them: those that were lost on the way count too."""
        if frame.number is None or self._number is None:
            self._taken += 1
        elif frame.number <= self._number:
            what = f"{self._source.name} gave frame {frame.number} again, after {self._number}"
            raise ReplyWrong(self._device, what, "restart the frame grabber")
        else:
            self._taken += frame.number - self._number
        self._number = frame.number

    def _is_clipped(self, answer: Answer) -> bool:
        return answer.verdict is Verdict.WARNING and answer.code in self._head.dialect.clipped.values()
