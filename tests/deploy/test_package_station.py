"""A station from the package: the page beside a service with secrets."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from browser import Browser
from installed import a_result, install, set_up

pytestmark = [pytest.mark.long, pytest.mark.timeout(1200)]

KEY = "inspector-plc.key"
RECIPES = [
    {"id": 1, "name": "lenient", "limits": {"max_height_um": 3000}},
    {"id": 2, "name": "strict", "limits": {"max_height_um": 100}},
]


@pytest.fixture(scope="module")
def booted_files(debian_files: Path) -> Path:
    """A clean Debian 12, in place of this machine's files."""
    return debian_files


def with_key(machine: Any) -> dict[str, str]:
    """Certificates for everybody, the key for root alone; the settings that name them."""
    etc, store = machine.root / "etc/inspector", machine.root / "etc/credstore"
    made = ["-keyout", str(store / KEY), "-out", str(etc / "plc.pem")]
    kind = ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes", "-subj", "/CN=station"]
    subprocess.run(["openssl", "req", "-x509", *kind, *made], check=True, capture_output=True, timeout=60)
    (etc / "plc.pem").chmod(0o644)
    (store / KEY).chmod(0o400)
    return {"certificate": "plc.pem", "key": f"credential:{KEY}", "client_ca": "plc.pem"}


def property_of(machine: Any, unit: str, name: str) -> str:
    return str(machine.run("systemctl", "show", f"--property={name}", "--value", unit).stdout.strip())


def test_the_page_shows_and_commands_a_station_whose_key_it_may_not_read(
    machine: Any, package: Path, peer: Callable[[str, str], str], wait_until: Callable[..., Any]
) -> None:
    peer("openssl", "openssl")
    install(machine, package)
    plc = {"port": 502, "tls": with_key(machine)}
    set_up(machine, plc=plc, recipes=RECIPES, recipe=1, archive={"folder": "/var/lib/inspector/archive"})
    a_result(machine, wait_until)
    machine.run("systemctl", "enable", "--now", "inspector-page")
    page = Browser(8080)

    def state() -> dict[str, Any]:
        found: dict[str, Any] = machine.in_network(page.state)
        return found

    wait_until(lambda: state()["verdict"]["name"] == "PASS", "the verdict on the page")
    status, told = machine.in_network(lambda: page.command("CHANGE_RECIPE", 2))
    assert status == 202
    ended = wait_until(lambda: (c := state()["command"])["outcome"] != "running" and c, "the command's end")
    assert (ended["number"], ended["outcome"]) == (told["number"], "done")
    wait_until(lambda: state()["verdict"]["name"] == "FAIL", "judged by the other recipe")
    assert "PASS" not in state()["verdict"]["name"]
    user = property_of(machine, "inspector-page", "MainPID"), property_of(machine, "inspector", "MainPID")
    assert len({machine.run("ps", "-o", "uid=", "-p", pid).stdout.strip() for pid in user}) == len(user)
    assert machine.run("inspector", "health", "--config", "/etc/inspector/line.yaml").returncode == 0
    machine.run("systemctl", "restart", "inspector-page")
    wait_until(lambda: state()["verdict"]["name"] == "FAIL", "the page that was started again")
    assert property_of(machine, "inspector-page", "NRestarts") == "0"
