"""Pages that are made from a table: the committed copy is current, and the table leaves nothing out."""

from __future__ import annotations

from pathlib import Path

import pytest

from firmware_bridge.wire import profiles_page
from firmware_bridge.wire.profiles import PROFILES
from inspector.archive_reading import columns
from inspector.commands import fault_table
from inspector.faults import Fault
from inspector.replay import tables

DOCS = Path(__file__).parents[2] / "docs"


@pytest.mark.parametrize(("name", "made"), [
    ("modules.md", profiles_page.markdown),
    ("faults.md", fault_table.as_markdown),
    ("reinspect.md", tables.as_markdown),
    ("export.md", columns.as_markdown),
])  # fmt: skip
def test_the_committed_page_is_current(name: str, made: object) -> None:
    assert (DOCS / name).read_text() == made(), "run: make docs"


def test_every_module_is_on_its_page() -> None:
    assert [row[0] for row in profiles_page.rows()] == list(PROFILES)
    assert not [doubt for profile in PROFILES.values() for doubt in profile.unconfirmed
                if doubt not in profiles_page.markdown()]  # fmt: skip


def test_every_fault_has_a_row_and_says_all() -> None:
    assert {row.fault for row in fault_table.ROWS} == set(Fault) - {Fault.NONE}
    assert not [row for row in fault_table.ROWS if not (row.happening and row.log and row.recovery and row.plc_sees)]


@pytest.mark.parametrize("row", fault_table.ROWS, ids=lambda row: row.happening)
def test_no_fault_leaves_a_verdict(row: fault_table.FaultRow) -> None:
    assert "NOT_INSPECTED" in row.plc_sees or row.fault in fault_table.INSPECTION_GOES_ON
