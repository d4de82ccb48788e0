"""A PLC's program that takes results and triggers, scan by scan, as the integrator's page asks for.

``sequence`` taken last is retentive: it outlives a crash; everything else starts with zeros.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from inspector.handshake_table import Answer, Control


@dataclass
class PlcProgram:
    """``taken`` are the results it has acted on, by their long sequence and verdict."""

    keep: Control = Control.BUFFER_RESULTS
    """Bits that it always sets."""
    impatient: bool = False
    """It triggers without waiting for TRIGGER_READY."""
    last_taken: int = 0
    taken: list[tuple[int, int]] = field(default_factory=list)
    acknowledging: bool = False
    triggering: bool = False
    wants_trigger: bool = False
    number: int = 0

    def crash(self) -> None:
        """Start again with zeros, but for what is retentive."""
        self.acknowledging = self.triggering = self.wants_trigger = False
        self.number = 0

    def scan(self, read: Mapping[str, int]) -> tuple[int, int]:
        """One scan: what was read, to be answered by these first two words of the control block."""
        answers = Answer(read["handshake"])
        available, sequence = Answer.RESULT_AVAILABLE in answers, read["sequence_u32"]
        if not available or Answer.ACK_MISMATCH in answers or (self.acknowledging and sequence != self.last_taken):
            self.acknowledging = False
        elif not self.acknowledging:
            if sequence != self.last_taken:
                self.taken.append((sequence, read["verdict"]))
                self.last_taken = sequence
            self.acknowledging, self.number = True, read["sequence"]
        self._trigger(answers)
        bits = self.keep
        bits |= Control.RESULTS_ACK if self.acknowledging else Control(0)
        bits |= Control.TRIGGER if self.triggering else Control(0)
        return int(bits), self.number

    def _trigger(self, answers: Answer) -> None:
        if self.triggering:
            self.triggering = not answers & (Answer.TRIGGER_ACK | Answer.TRIGGER_MISSED)
        elif self.wants_trigger and (self.impatient or Answer.TRIGGER_READY in answers):
            self.triggering, self.wants_trigger = True, False
