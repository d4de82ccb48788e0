"""The unit files, as systemd itself reads them."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

DEPLOY = Path(__file__).parents[2] / "deploy"
UNITS = ("inspector.service", "inspector-health.service", "inspector-health.timer", "inspector-page.service")
PROGRAM = "/usr/bin/inspector"


@pytest.fixture
def installed(tmp_path: Path) -> Path:
    """The units as they are where their program is installed: there it is this environment's."""
    for name in UNITS:
        text = (DEPLOY / name).read_text()
        assert PROGRAM in text or name.endswith(".timer")
        (tmp_path / name).write_text(text.replace(PROGRAM, str(Path(sys.executable).parent / "inspector")))
    return tmp_path


def test_systemd_accepts_the_units_without_a_word(installed: Path, peer: Callable[[str, str], str]) -> None:
    command = [peer("systemd-analyze", "systemd"), "verify", "--man=no", *(installed / name for name in UNITS)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout + done.stderr) == (0, "")


@pytest.mark.parametrize("name", [name for name in UNITS if name.endswith(".service")])
def test_the_units_expose_little(name: str, installed: Path, peer: Callable[[str, str], str]) -> None:
    """1.5 on systemd's scale from 0 to 10; docs/security.md says what it consists of."""
    command = [peer("systemd-analyze", "systemd"), "security", "--offline=true", "--threshold=15", installed / name]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stdout


def test_the_unit_says_what_the_service_relies_on() -> None:
    lines = (DEPLOY / UNITS[0]).read_text().splitlines()
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
