"""The program of a line's PLC that tends the booth: register values in, orders out, and nothing else. Pure.

As it would stand in structured text: once for each new sequence, while the statistics are valid and fresh, do what the
station advises with confidence enough, then reset the statistics and let the deed work before the next. It knows no
defects, no booth and no part of the station's code; names are those of the integrator's register list.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from inspector.lab.booth import Deed

VALID = 1 << 0
HOLD, CHECK_FILTER, CLEAN_BOOTH, CHECK_FIXTURE = 1, 2, 3, 4
DEEDS: Mapping[int, tuple[Deed, ...]] = {
    HOLD: (Deed.CHANGE_FILTER, Deed.CLEAN_BOOTH),
    CHECK_FILTER: (Deed.CHANGE_FILTER,),
    CLEAN_BOOTH: (Deed.CLEAN_BOOTH,),
    CHECK_FIXTURE: (Deed.CLEAN_FIXTURE,),
}
"""What the crew is sent to do for an action code; the other codes are lamps on the panel for a person to see."""

LEAST_CONFIDENCE = 0.5
OLDEST_MS = 60_000.0

Registers = Mapping[str, float | int | None]


@dataclass(slots=True)
class PlcProgram:
    """What the program remembers from scan to scan."""

    settle_panels: int = 30
    """Panels after an order in which nothing is ordered: the crew needs some, and the charts begin anew after."""
    sequence: int | None = None
    ordered_at: int | None = None
    """Sequence of the last order, until the statistics are reset."""
    orders: list[tuple[int, Deed]] = field(default_factory=list)
    """Every order, with the sequence after which it was given."""

    def scan(self, registers: Registers) -> tuple[tuple[Deed, ...], bool]:
        """What to order, and whether to reset the statistics now, after one read of the statistics area."""
        sequence = registers["statistics_sequence"]
        if sequence != registers["statistics_sequence_end"] or sequence == self.sequence or sequence is None:
            return (), False
        self.sequence = int(sequence)
        if self.ordered_at is not None:
            is_settled = (self.sequence - self.ordered_at) % 65536 >= self.settle_panels
            self.ordered_at = None if is_settled else self.ordered_at
            return (), is_settled
        if not self._may_act(registers):
            return (), False
        deeds = DEEDS.get(int(registers["action"] or 0), ())
        if deeds:
            self.ordered_at = self.sequence
            self.orders += [(self.sequence, deed) for deed in deeds]
        return deeds, False

    def _may_act(self, registers: Registers) -> bool:
        age_ms, confidence = registers["statistics_age_ms"], registers["confidence"]
        valid = int(registers["statistics_status"] or 0) & VALID
        return bool(valid and age_ms is not None and age_ms <= OLDEST_MS and (confidence or 0.0) >= LEAST_CONFIDENCE)
