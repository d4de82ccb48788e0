"""The results' store under another version of the package and back again: nothing of 100,000 panels is lost."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from installed import PYTHON, STATE, a_result, at_version, changed, install, set_up

pytestmark = [pytest.mark.long, pytest.mark.timeout(2400)]

ARCHIVE = "/var/lib/inspector/archive"
PANELS = 100_000
STEP = "ALTER TABLE result ADD COLUMN gloss REAL NOT NULL DEFAULT 0.5; CREATE TABLE gloss (id INTEGER PRIMARY KEY)"
STEPS_END = '    """,\n)\nOLDEST_WRITER = '
ONE_MORE = f'    """,\n    "{STEP}",\n)\nOLDEST_WRITER = '
"""The steps in schema.py with one more, as the next version may have it."""
FILL = f"""
import numpy as np
from pathlib import Path
from inspector.archive import entries
from inspector.archive.store import Run, Store
from inspector.model import Defect, Flag, Frame, FrameResult, Snapshot, Verdict

def result(n):
    defects = (Defect(n % 97, 2.0, 900.0 + n % 1000, 3.5, (4.0, 5.0), (6.0, 7.0), Flag(0)),) if n % 3 == 0 else ()
    verdict = Verdict.FAIL if n % 1000 > 990 else Verdict.PASS
    shown = Snapshot(sequence=n, panel_id=n, verdict=verdict, defects=defects)
    taken = entries.Taken(frame, FrameResult("a.png", verdict, defects=defects), 1000.0, 4.0)
    return entries.of_result(shown, 1e9 + n, ("of before",), [taken], [None], ("0a", "0b"))

frame = Frame(np.zeros((2, 2), np.uint8), "a.png", 9, 1000.0, 4.0, 12.5)
store = Store(Path("{ARCHIVE}"), Run(1e9, "0.0.1", "line 2"))
for first in range(1, {PANELS}, 1000):
    store.write([result(n) for n in range(first, first + 1000)])
store.close(2e9)
"""
LOOK = f"""
import hashlib, json, sqlite3, sys
store = sqlite3.connect("file:{ARCHIVE}/" + sys.argv[1] + "?mode=ro", uri=True)
(before,) = store.execute("SELECT id FROM run WHERE started_s = 1e9").fetchone()
digest = hashlib.sha256()
for table, key in (("result", "id"), ("frame", "result"), ("defect", "result")):
    names = ", ".join(row[1] for row in store.execute(f"PRAGMA table_info({{table}})") if row[1] != "gloss")
    rows = store.execute(f"SELECT {{names}} FROM {{table}} WHERE {{key}} >> 32 = ? ORDER BY 1, 2", (before,))
    for row in rows:
        digest.update(repr(row).encode())
of_before = "SELECT count(*), min(sequence), max(sequence) FROM result WHERE id >> 32 = ?"
print(json.dumps({{
    "before": store.execute(of_before, (before,)).fetchone(),
    "digest": digest.hexdigest(),
    "since": [n for n, in store.execute("SELECT sequence FROM result WHERE id >> 32 != ? ORDER BY id", (before,))],
    "columns": len([*store.execute("PRAGMA table_info(result)")]),
    "version": store.execute("PRAGMA user_version").fetchone()[0],
    "sound": store.execute("PRAGMA integrity_check").fetchone()[0],
}}))
"""


@pytest.fixture(scope="module")
def booted_files(debian_files: Path) -> Path:
    """A clean Debian 12, in place of this machine's files."""
    return debian_files


def look(machine: Any, file: str = "results.sqlite") -> dict[str, Any]:
    """What a reader of its own finds in a store, looked through whole."""
    found: dict[str, Any] = json.loads(machine.run(PYTHON, "-I", "-c", LOOK, file, timeout=300).stdout)
    assert found.pop("sound") == "ok"
    return found


def kept(machine: Any, wait_until: Callable[..., Any], sequence: int) -> dict[str, Any]:
    """What is in the store once it has the result of this number."""

    def there() -> dict[str, Any] | None:
        found = look(machine)
        return found if sequence in found["since"] else None

    found: dict[str, Any] = wait_until(there, f"result {sequence} is in the store", 120)
    return found


def test_nothing_of_100_000_panels_is_lost_by_another_version_and_back_again(
    machine: Any, unpacked: Path, wait_until: Callable[..., Any]
) -> None:
    old = at_version(unpacked, "1.0.0")
    new = changed(unpacked, "1.1.0", "inspector/archive/schema.py", STEPS_END, ONE_MORE)
    install(machine, old)
    set_up(machine, archive={"folder": ARCHIVE, "frames": {"last": 0}})
    a_result(machine, wait_until)
    machine.run("systemctl", "stop", "inspector")
    machine.run(PYTHON, "-I", "-c", FILL, timeout=900)
    machine.run("systemctl", "start", "inspector")
    last = a_result(machine, wait_until, after=max(look(machine)["since"]))
    first = kept(machine, wait_until, last)
    assert first["before"] == [PANELS, 1, PANELS]
    size_mb = (machine.root / STATE / "archive/results.sqlite").stat().st_size / 1e6
    print(f"\n{PANELS} panels, {size_mb:.1f} MB")
    was = first
    for package, version, columns in ((new, 2, 1), (old, 2, 1), (new, 2, 1)):
        began_s = time.monotonic()
        install(machine, package)
        installed_s = time.monotonic() - began_s
        last = a_result(machine, wait_until, after=last)
        now = kept(machine, wait_until, last)
        began_s = time.monotonic() - began_s
        print(
            f"{package.name}: {installed_s:.1f} s to install, {began_s:.1f} s until a new result was seen in the store"
        )
        assert (now["before"], now["digest"]) == (first["before"], first["digest"])
        assert (now["version"], now["columns"]) == (version, first["columns"] + columns)
        assert now["since"][: len(was["since"])] == was["since"]
        assert now["since"] == list(range(now["since"][0], now["since"][-1] + 1)), "no number is missing or comes twice"
        was = now
    backup = look(machine, "results.version-1.sqlite")
    assert (backup["before"], backup["digest"], backup["version"]) == (first["before"], first["digest"], 1)
    assert backup["since"] == was["since"][: len(backup["since"])]
    assert set(first["since"]) <= set(backup["since"])
    assert not list((machine.root / STATE / "archive").glob("*set-aside*"))
    machine.run("apt-get", "remove", "--yes", "seed-inspector", timeout=300)
    install(machine, old)
    machine.run("systemctl", "start", "inspector")
    last = a_result(machine, wait_until, after=last)
    assert kept(machine, wait_until, last)["digest"] == first["digest"]
    machine.run("apt-get", "purge", "--yes", "seed-inspector", timeout=300)
    assert not (machine.root / STATE).exists()
