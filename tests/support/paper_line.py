"""A station on paper, its registers read and written as words by programs of the PLC's side; time is the test's."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import replace

from inspector import handshake
from inspector.dialogues import Inspects, PaperStation, Writes
from inspector.model import Verdict
from inspector.publish import registers
from inspector.publish.wire_fields import WordOrder


class PaperLine:
    """The station; its heartbeat follows ``now_s`` while ``beating``."""

    def __init__(self, trigger_by_plc: bool = True, order: WordOrder = "high_first") -> None:
        self.now_s, self.order, self.heartbeat, self.beating = 0.0, order, 0, True
        self.station = PaperStation(trigger_by_plc)
        self.station.live = replace(self.station.live, result_at_s=0.0)

    def passes(self, seconds: float) -> None:
        """Time goes on."""
        self.now_s += seconds
        self.heartbeat = int(self.now_s) % 65536 if self.beating else self.heartbeat

    def image(self) -> tuple[int, ...]:
        """The result block as it is read."""
        shown = handshake.view(self.station.state, self.station.live)
        return struct.unpack(">125H", registers.encode(shown, self.now_s, self.heartbeat, self.order))

    def written(self, words: Sequence[int]) -> None:
        """The PLC has written the first words of the control block."""
        whole = [*words, *[0] * (registers.CONTROL_WORDS - len(words))]
        block = registers.decode_control(whole, self.order)
        numbers = (block.acknowledged_sequence, block.panel_id, block.command, block.argument)
        self.station.does(Writes(block.bits, *numbers))

    def inspects(self, verdict: Verdict | None = Verdict.PASS) -> None:
        """The station inspects a panel; without a verdict its program fails."""
        self.station.does(Inspects(verdict))
        # A result of now, as the block's bit RESULTS_VALID asks for.
        self.station.live = replace(self.station.live, result_at_s=self.now_s)
