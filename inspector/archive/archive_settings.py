"""What a station must say of what it keeps."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

from pydantic import Field, PositiveFloat, PositiveInt

from firmware_bridge.strict import Strict


class KeptFrames(Strict):
    """Which frames are kept, lossless, and for how long. When room is wanted, the oldest go first."""

    failing: bool = True
    """Keep every frame of a result that is no PASS."""
    passing_every: PositiveInt | None = 100
    """Keep the frames of one PASS of so many; null: of none."""
    last: int = Field(100, ge=0, le=10_000)
    """Keep the last frames, so many, whatever they say; 0: none. Each frame is then written to the disk, at 20 a second
    some 150 GB a day: choose 0 for flash memory that is to last."""
    days: PositiveFloat = Field(30.0, le=10_000)
    """Keep them for so many days."""
    most_mb: PositiveFloat = 10_000.0
    """Keep at most so many megabytes of them."""
    min_free_mb: float = Field(500.0, ge=0)
    """Leave so many megabytes of the disk free: results need them."""


class ArchiveSettings(Strict):
    """What was inspected is kept: results in a store, which is never thinned out, and frames beside it."""

    folder: Annotated[Path, Field(strict=False)]
    """Folder of the archive; made if it is not there."""
    disk: Annotated[Path, Field(strict=False)] | None = None
    """Where the archive's own disk is mounted, at the folder or above it: without it results wait in memory, and
    nothing is written in its place. `plc.sequence_file`, `recipe_choice_file` and `statistics_file` must then be named,
    elsewhere. null: the folder is on a disk that is always there."""
    commit_wait_s: float = Field(0.2, ge=0, le=10)
    """A result is shown to the PLC when it is on the disk, but waits no longer than this, seconds; STORE_DEGRADED then
    says that it may be lost."""
    frames: KeptFrames = KeptFrames.default()
    """Which frames are kept."""

    @property
    def place(self) -> tuple[Path, Path | None]:
        """What makes it another archive."""
        return self.folder, self.disk

    def under(self, folder: Path) -> ArchiveSettings:
        """The same settings with a relative folder taken from ``folder``."""
        return self.model_copy(update={"folder": folder / self.folder, "disk": self.disk and folder / self.disk})

    def disk_misfit(self, files: Mapping[str, Path | None], folder: Path) -> str | None:
        """What is allowed, where ``disk`` is not above the archive's folder, or is above one of the small ``files``:
        what they say must hold before the disk is there. A file that is None is in the archive; relative paths count
        from ``folder``."""
        if self.disk is None:
            return None
        disk = os.path.normpath(folder / self.disk)
        if not _is_below(folder / self.folder, disk):
            return "allowed: archive.folder or a folder above it"
        there = [name for name, file in files.items() if file is None or _is_below(folder / file, disk)]
        return f"allowed: name files that are not on it as {', '.join(there)}" if there else None


def _is_below(path: Path, folder: str) -> bool:
    return Path(os.path.normpath(path)).is_relative_to(folder)
