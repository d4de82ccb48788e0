"""A new module is a new row and a test run, no code: every list of the bridge's tests is run over a row added here."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
SUPPORT = HERE.parent / "support"
LISTS = {
    "test_profiles.py": 1,
    "test_module_contract.py": 18,
    "test_module_safety.py": 5,
    "test_faults_at_the_wire.py": 13,
    "test_foreign_module.py": 1,
}
"""The files that go over the table's rows, and how many of their tests a row with both links must reach at least."""


@pytest.mark.timeout(240)
def test_a_row_that_is_added_is_driven_and_simulated_and_meets_every_list() -> None:
    files = [str(HERE / name) for name in LISTS]
    options = ["-p", "imaginary_module", "-k", "imaginary", "-n", "0", "-vv", "--tb=short"]
    path = os.pathsep.join([str(SUPPORT), *filter(None, [os.environ.get("PYTHONPATH")])])
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *options, *files],
        capture_output=True,
        text=True,
        timeout=220,
        cwd=HERE.parents[1],
        env={key: value for key, value in os.environ.items() if not key.startswith("PYTEST_")} | {"PYTHONPATH": path},
    )
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr
    for name, least in LISTS.items():
        lines = [line for line in done.stdout.splitlines() if name in line and "imaginary" in line]
        assert len(lines) >= least, f"{name}: {lines}"


def test_a_row_that_is_added_is_documented_and_offered_in_the_settings() -> None:
    code = (
        "import imaginary_module; from firmware_bridge.wire import profiles_page;"
        "from firmware_bridge.settings import ModuleSettings as Settings;"
        "print(profiles_page.markdown(), Settings.model_json_schema())"
    )
    shown = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True,
        env=os.environ | {"PYTHONPATH": str(SUPPORT)},
    ).stdout  # fmt: skip
    assert "| imaginary-3ao | Imaginary 3 AO | RTU, TCP |" in shown
    assert "'imaginary-3ao'" in shown
