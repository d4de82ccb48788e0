"""Images published flat out, of which every part tells the same number, so that a torn one shows."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable

from inspector.model import Defect, Snapshot


def derived(number: int) -> Snapshot:
    """A snapshot of which every part tells the number, up to 30,000."""
    seeds = (Defect(number / 100, number / 100, number, number, (0.0, 0.0), (0.0, 0.0)),) * 64
    return Snapshot(
        sequence=number,
        acquisition_id=number,
        panel_id=number,
        recipe_id=number,
        defects=seeds,
        unpaired_count=number,
        panels_passed=number,
        overruns=number,
        lamp_set_v=number / 1000,
        exposure_us=number,
        configuration_hash=number,
    )


class FlatOut:
    """Inside its `with`, a thread shows one snapshot after the other and counts them in ``published``."""

    def __init__(self, show: Callable[[Snapshot], None], snapshots: Iterable[Snapshot]) -> None:
        self._show, self._snapshots = show, iter(snapshots)
        self.published, self._enough = 0, threading.Event()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> FlatOut:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._enough.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._enough.is_set():
            self._show(next(self._snapshots))
            self.published += 1
