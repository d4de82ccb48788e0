"""What `inspector replay` does: recorded frames inspected again on all cores, beside what was found in them then.

An interrupted run goes on from its state file.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from firmware_bridge import whole_file
from inspector.change_options import Asked, Unusable, change_of
from inspector.reinspection import Change
from inspector.replay import summary, workers
from inspector.replay.comparison import Comparing
from inspector.replay.plan import Part, Plan
from inspector.replay.state import OfAnother, State, program
from inspector.replay.tally import Tally, tally

AS_IT_WAS, SOME_NOT, NOTHING_DONE = 0, 1, 2
"""Exit statuses: all as it was, or all compared with new settings; differences, or not all could be compared; nothing
could be done."""
PART_BYTES = 64 * 1024
"""An index is shared out in parts of this size: some fifty frames, a fifth of a second's work."""


@dataclass(frozen=True, slots=True)
class Output:
    """Where what came out goes. ``file`` None: to standard output; ``plot`` None: none is drawn."""

    form: str = "table"
    file: Path | None = None
    plot: Path | None = None
    state: Path | None = None
    """Where the state is kept; None: beside ``file``, or nowhere."""

    @property
    def state_file(self) -> Path | None:
        """The file that an interrupted run goes on from."""
        return self.state or (self.file and self.file.with_name(self.file.name + ".state"))


def run(
    paths: Sequence[Path], asked: Asked, output: Output, jobs: int | None = None, part_bytes: int = PART_BYTES
) -> int:
    """Replay the sessions among and below ``paths`` and print the comparison; the exit status."""
    try:
        change = change_of(asked)
        counted = _replayed(paths, change, output, jobs or workers.cores(), part_bytes)
        _print(counted, output, asked)
    except (Unusable, OfAnother, workers.WorkersDied) as error:
        return _refused(str(error))
    except OSError as error:
        return _refused(f"{error.filename or output.file}: {error.strerror}")
    if not counted.frames:
        return _refused("no frame could be compared")
    settled = not counted.not_compared if asked.anything else counted.identical
    return AS_IT_WAS if settled else SOME_NOT


def _refused(why: str) -> int:
    print(f"inspector: {why}", file=sys.stderr)
    return NOTHING_DONE


def _replayed(paths: Sequence[Path], change: Change, output: Output, jobs: int, part_bytes: int) -> Tally:
    """What came out, in the sessions' order. Raises Unusable, OfAnother, WorkersDied, OSError."""
    plan = Plan.of(paths, part_bytes)
    if not plan.sessions:
        raise Unusable(f"no session in {' '.join(map(str, paths))}: name folders with a session.jsonl, or above such")
    state = (
        State(output.state_file, program(paths, change, _every_seed(change, output)), plan)
        if output.state_file
        else None
    )
    parts = dict(enumerate((state.plan if state else plan).parts()))
    done = dict(state.done) if state else {}
    work = partial(examine, change=change, every_seed=_every_seed(change, output))
    try:
        with workers.progress("frames", len(parts), sum(t.frames for t in done.values()), len(done)) as advance:
            for number, counted in workers.share(work, [p for p in parts.items() if p[0] not in done], jobs):
                done[number] = counted
                if state:
                    state.add(number, counted)
                advance(counted.frames)
    finally:
        if state:
            state.close()
    whole = Tally()
    for number in parts:
        whole.add(done[number])
    if state:
        state.remove()
    return whole


def _every_seed(change: Change, output: Output) -> bool:
    return change != Change() or output.plot is not None


_comparing: tuple[Change, Comparing] | None = None
"""Of this process: what it has made of a version of the settings serves the next part too."""


def examine(part: Part, careful: bool, change: Change, every_seed: bool) -> Tally:
    """A part of the sessions inspected again and compared, in whatever process; ``careful`` where one died at it."""
    global _comparing
    if careful:
        return tally(Comparing(change, careful).all(part), every_seed)
    if _comparing is None or _comparing[0] != change:
        _comparing = change, Comparing(change)
    return tally(_comparing[1].all(part), every_seed)


def _print(counted: Tally, output: Output, asked: Asked) -> None:
    text = summary.FORMATS[output.form](counted)
    if output.plot:
        from inspector.replay import plot

        whole_file.write(output.plot, plot.svg(counted))
    if output.file:
        whole_file.write(output.file, text + "\n")
    else:
        print(text)
