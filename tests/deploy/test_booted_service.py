"""The unit at work under a real systemd, as it is deployed; the PLC polls it over the wire."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.line.conftest import Plc

REPOSITORY = Path(__file__).parents[2]


@pytest.fixture
def machine(booted: Any) -> Any:
    """A machine, still off, on which the service is installed and enabled, with the settings of the demonstration."""
    booted.install_project()
    shutil.copytree(REPOSITORY / "config", booted.root / "etc/inspector")
    shutil.copy(REPOSITORY / "config/demo.yaml", booted.root / "etc/inspector/line.yaml")
    units = booted.root / "etc/systemd/system"
    shutil.copy(REPOSITORY / "deploy/inspector.service", units)
    wants = units / "multi-user.target.wants"
    wants.mkdir()
    (wants / "inspector.service").symlink_to("/etc/systemd/system/inspector.service")
    return booted


def test_the_service_inspects_after_the_machine_has_come_up_and_after_a_power_cut(
    machine: Any, wait_until: Callable[..., Any]
) -> None:
    for _ in range(2):
        machine.boot()
        plc = machine.in_network(lambda: Plc(5020))
        plc.until(wait_until, lambda r: r["verdict"], "a verdict")
        assert machine.run("systemctl", "is-active", "inspector").stdout == "active\n"
        machine.cut_power()
        plc.close()
