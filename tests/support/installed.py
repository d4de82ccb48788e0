"""The Debian package installed in a machine that boots: versions of it, a station set up, and what a PLC sees of it."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import yaml

from tests.line.conftest import Plc

REPOSITORY = Path(__file__).parents[2]
SITE = "usr/lib/seed-inspector/lib/python3.11/site-packages"
PYTHON = "/usr/lib/seed-inspector/bin/python3"
SETTINGS = "etc/inspector/line.yaml"
STATE = "var/lib/private/inspector"
GOES_ON = 2
"""Further results to see after a change."""


def at_version(unpacked: Path, version: str) -> Path:
    """A package of the same tree under another version."""
    control = unpacked / "DEBIAN/control"
    control.write_text(re.sub(r"(?m)^Version: .*", f"Version: {version}", control.read_text()))
    package = unpacked.parent / f"seed-inspector_{version}.deb"
    pack = ["dpkg-deb", "--root-owner-group", "-Znone", "--build", str(unpacked), str(package)]
    subprocess.run(pack, check=True, capture_output=True, timeout=300)
    return package


def changed(unpacked: Path, version: str, module: str, before: str, after: str) -> Path:
    """A package of a version in which a module, such as ``inspector/settings.py``, says something else in one place."""
    source = unpacked / SITE / module
    text = source.read_text()
    assert text.count(before) == 1
    source.write_text(text.replace(before, after))
    for compiled in (source.parent / "__pycache__").glob(f"{source.stem}.*.pyc"):
        compiled.rename(unpacked.parent / compiled.name)
    try:
        return at_version(unpacked, version)
    finally:
        source.write_text(text)
        for compiled in unpacked.parent.glob(f"{source.stem}.*.pyc"):
            compiled.rename(source.parent / "__pycache__" / compiled.name)


def install(machine: Any, package: Path, **options: Any) -> subprocess.CompletedProcess[str]:
    """As a person does it, from a file, with nobody to answer a question."""
    shutil.copy(package, machine.root / "srv/seed-inspector.deb")
    apt = ["apt-get", "install", "--yes", "--allow-downgrades", "/srv/seed-inspector.deb"]
    return machine.run("env", "DEBIAN_FRONTEND=noninteractive", *apt, timeout=300, stdin=subprocess.DEVNULL, **options)


def set_up(machine: Any, **own: Any) -> None:
    """What a person does next: a station's settings, here without hardware and with some of its ``own``, and the
    service started."""
    settings: dict[str, Any] = yaml.safe_load((REPOSITORY / "config/simulated.yaml").read_text())
    del settings["camera"]["faults"]
    settings["plc"] = {"port": 502, "sequence_file": "/var/lib/inspector/sequence.json"}
    (machine.root / SETTINGS).write_text(yaml.safe_dump(settings | own))
    machine.run("inspector", "config", "check", f"/{SETTINGS}")
    machine.run("systemctl", "enable", "--now", "inspector")


def as_documented(machine: Any, what: str, page_name: str = "install.md") -> None:
    """Carry out the commands that follow these words in a page of docs/."""
    page = (REPOSITORY / "docs" / page_name).read_text()
    commands = page.partition(what)[2].partition("\n\n    ")[2].partition("\n\n")[0]
    machine.run("sh", "-e", "-c", f"cd /srv\n{commands}", timeout=300)


def a_result(machine: Any, wait_until: Callable[..., Any], after: int = 0) -> int:
    """The number of a judged result after another, as the PLC reads it."""
    plc = machine.in_network(lambda: Plc(502))
    try:
        shown = plc.until(wait_until, lambda r: r["verdict"] and r["sequence"] > after + GOES_ON, "a verdict")
        return int(shown["sequence"])
    finally:
        plc.close()


def process(machine: Any) -> int:
    return int(machine.run("systemctl", "show", "--property=MainPID", "--value", "inspector").stdout)
