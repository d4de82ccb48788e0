"""The Debian package on a clean Debian 12 under a real systemd, without a network: put on, changed, taken off."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from installed import SETTINGS, STATE, a_result, as_documented, at_version, changed, install, process, set_up

pytestmark = [pytest.mark.long, pytest.mark.timeout(1200)]

NONE_FOUND = 1
"""Exit status of pgrep."""
STRICTER = "    calibration: Path\n", "    site: str\n    calibration: Path\n"
"""Settings that have to say something that no settings yet say."""


@pytest.fixture(scope="module")
def booted_files(debian_files: Path) -> Path:
    """A clean Debian 12, in place of this machine's files."""
    return debian_files


def left_in(folder: Path) -> list[str]:
    return sorted(str(p.relative_to(folder)) for p in folder.rglob("*")) if folder.exists() else []


def test_it_installs_on_a_clean_machine_without_a_network_and_inspects_once_it_is_set_up(
    machine: Any, package: Path, frames_folder: Path, wait_until: Callable[..., Any]
) -> None:
    said = install(machine, package).stdout
    assert "systemctl enable --now inspector" in said
    state = machine.run("systemctl", "show", "--property=ActiveState,UnitFileState", "inspector").stdout
    assert set(state.split()) == {"ActiveState=inactive", "UnitFileState=disabled"}
    refused = machine.run("inspector", "config", "check", f"/{SETTINGS}", check=False)
    assert "camera.paths" in refused.stderr  # nobody inspects with a camera that nobody has named
    shutil.copytree(frames_folder, machine.root / "srv/frames")
    frame = ["/srv/frames/four_seeds.png", "--calibration", "/srv/frames/calibration.yaml"]
    assert "HEIGHT" in machine.run("inspector", "inspect", *frame, "--format", "csv").stdout.upper()
    set_up(machine)
    a_result(machine, wait_until)
    machine.run("apt-get", "install", "--yes", "mbpoll")
    assert machine.run("mbpoll", "-0", "-1", "-t4", "-r6", "-c1", "-p502", "127.0.0.1").stdout.count("[6]:") == 1
    assert machine.run("dpkg", "--verify", "seed-inspector").stdout == ""
    owned = set(machine.run("dpkg", "--listfiles", "seed-inspector").stdout.splitlines())
    there = {f"/{p.relative_to(machine.root)}" for p in (machine.root / "usr/lib/seed-inspector").rglob("*")}
    assert there <= owned


def test_another_version_takes_the_place_with_settings_and_state_kept_and_so_does_the_old_one_again(
    machine: Any, unpacked: Path, wait_until: Callable[..., Any]
) -> None:
    old, new = at_version(unpacked, "1.0.0"), at_version(unpacked, "1.1.0")
    install(machine, old)
    set_up(machine)
    (machine.root / "etc/inspector/recipes/white-gloss.yaml").unlink()
    (machine.root / "etc/inspector/recipes/black-gloss.yaml").write_text("edited: yes\n")
    settings = {p: (machine.root / "etc/inspector" / p).read_text() for p in ("line.yaml", "recipes/black-gloss.yaml")}
    last, was = a_result(machine, wait_until), process(machine)
    for package in (new, old):
        said = install(machine, package)
        assert "conffile" not in (said.stdout + said.stderr).lower()
        assert process(machine) not in (0, was)
        last, was = a_result(machine, wait_until, after=last), process(machine)
        assert {p: (machine.root / "etc/inspector" / p).read_text() for p in settings} == settings
        assert not (machine.root / "etc/inspector/recipes/white-gloss.yaml").exists()
    machine.cut_power()
    machine.boot()
    a_result(machine, wait_until, after=last)


def test_a_version_that_refuses_the_settings_leaves_the_one_before_at_work(
    machine: Any, unpacked: Path, wait_until: Callable[..., Any]
) -> None:
    old, new = at_version(unpacked, "1.0.0"), changed(unpacked, "2.0.0", "inspector/settings.py", *STRICTER)
    install(machine, old)
    set_up(machine)
    last, was = a_result(machine, wait_until), process(machine)
    said = install(machine, new, check=False)
    assert said.returncode != 0
    assert "site: missing" in said.stdout + said.stderr
    assert "THE VERSION BEFORE GOES ON" in said.stdout + said.stderr
    assert process(machine) == was
    last = a_result(machine, wait_until, after=last)
    machine.run("systemctl", "reload", "inspector")
    last = a_result(machine, wait_until, after=last)
    with (machine.root / SETTINGS).open("a") as settings:
        settings.write("site: here\n")
    machine.run("dpkg", "--configure", "seed-inspector")
    assert process(machine) not in (0, was)
    last, was = a_result(machine, wait_until, after=last), process(machine)
    assert install(machine, old, check=False).returncode != 0  # to it, `site` is unknown
    assert process(machine) == was
    text = (machine.root / SETTINGS).read_text().replace("site: here\n", "")
    (machine.root / SETTINGS).write_text(text)
    machine.run("dpkg", "--configure", "--pending")
    assert process(machine) not in (0, was)
    a_result(machine, wait_until, after=last)


def test_taken_off_it_leaves_what_is_the_plants_and_purged_nothing_until_that_is_restored(
    machine: Any, package: Path, wait_until: Callable[..., Any]
) -> None:
    install(machine, package)
    set_up(machine)
    last = a_result(machine, wait_until)
    settings = (machine.root / SETTINGS).read_text()
    machine.run("apt-get", "remove", "--yes", "seed-inspector", timeout=300)
    assert machine.run("pgrep", "--full", "seed-inspector", check=False).returncode == NONE_FOUND
    assert not (machine.root / "usr/lib/seed-inspector").exists()
    assert (machine.root / SETTINGS).read_text() == settings
    assert "sequence.json" in left_in(machine.root / STATE)
    install(machine, package)
    machine.run("systemctl", "start", "inspector")
    last = a_result(machine, wait_until, after=last)
    as_documented(machine, "Back up")
    machine.run("apt-get", "purge", "--yes", "seed-inspector", timeout=300)
    for folder in ("usr/lib/seed-inspector", "etc/inspector", STATE, "var/lib/inspector", "usr/share/seed-inspector"):
        assert not (machine.root / folder).is_symlink()
        assert not left_in(machine.root / folder)
    assert not list((machine.root / "etc/systemd").rglob("*inspector*"))
    assert "inspector" not in machine.run("systemctl", "list-units", "--all", "--failed").stdout
    install(machine, package)
    as_documented(machine, "To restore")
    a_result(machine, wait_until, after=last)
    assert (machine.root / SETTINGS).read_text() == settings
