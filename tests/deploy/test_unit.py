"""The unit file, as systemd itself reads it."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

DEPLOY = Path(__file__).parents[2] / "deploy"
UNIT = DEPLOY / "inspector.service"
PROGRAM = "/usr/bin/inspector"


@pytest.fixture(params=["inspector.service", "inspector-page.service"])
def installed(tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    """A unit as it is where its program is installed: there it is this environment's."""
    text = (DEPLOY / request.param).read_text()
    assert PROGRAM in text
    unit = tmp_path / request.param
    unit.write_text(text.replace(PROGRAM, str(Path(sys.executable).parent / "inspector")))
    return unit


def test_systemd_accepts_the_unit_without_a_word(installed: Path, peer: Callable[[str, str], str]) -> None:
    analyze = peer("systemd-analyze", "systemd")
    done = subprocess.run([analyze, "verify", "--man=no", installed], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout + done.stderr) == (0, "")


def test_the_unit_exposes_little(installed: Path, peer: Callable[[str, str], str]) -> None:
    command = [peer("systemd-analyze", "systemd"), "security", "--offline=true", "--threshold=20", installed]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stdout


def test_the_unit_says_what_the_service_relies_on() -> None:
    lines = UNIT.read_text().splitlines()
    for line in (
        "Type=notify",
        "DynamicUser=yes",
        "StateDirectory=inspector",
        "Restart=on-failure",
        "RestartPreventExitStatus=78",
        "AmbientCapabilities=CAP_NET_BIND_SERVICE",
        "SupplementaryGroups=dialout video",
        "ExecReload=/bin/kill -HUP $MAINPID",
    ):
        assert line in lines
    assert any(line.startswith("WatchdogSec=") for line in lines)


def test_the_pages_unit_reaches_this_machine_alone_and_no_device() -> None:
    lines = (DEPLOY / "inspector-page.service").read_text().splitlines()
    for line in (
        "DynamicUser=yes",
        "IPAddressDeny=any",
        "IPAddressAllow=localhost",
        "PrivateDevices=yes",
        "CapabilityBoundingSet=",
        "RestartPreventExitStatus=78",
    ):
        assert line in lines
    assert not [line for line in lines if line.startswith("DeviceAllow=")]
