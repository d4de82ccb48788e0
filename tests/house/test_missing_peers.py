"""A test without its foreign peer is skipped by name; where REQUIRE_PEERS is set, it has failed."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

CONFTEST = Path(__file__).parents[1] / "conftest.py"
LONELY = """
import pytest

def test_talks_to_a_peer(peer):
    peer("no-such-program", "no-such-package")

def test_is_skipped_for_another_reason():
    pytest.skip("not today")
"""


@pytest.mark.parametrize(("required", "status", "summary"), [("", 0, "2 skipped"), ("1", 1, "1 failed, 1 skipped")])
def test_a_missing_peer(tmp_path: Path, required: str, status: int, summary: str) -> None:
    shutil.copy(CONFTEST, tmp_path)
    (tmp_path / "test_lonely.py").write_text(LONELY)
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-rs", "-p", "no:cacheprovider", "."],
        cwd=tmp_path,
        env=os.environ | {"REQUIRE_PEERS": required, "PYTEST_ADDOPTS": ""},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == status
    assert summary in done.stdout
    assert "peer missing: no-such-program (apt install no-such-package)" in done.stdout
