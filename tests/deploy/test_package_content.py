"""What is in the Debian package: the locked versions and no others, licences; and for aarch64 too."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from installed import SITE
from packaging.requirements import Requirement

pytestmark = [pytest.mark.long, pytest.mark.timeout(1800)]

REPOSITORY = Path(__file__).parents[2]
DEBIAN_12 = {"python_full_version": "3.11.2", "python_version": "3.11", "sys_platform": "linux"}
BUILD_ONLY = {"setuptools"}
START = f"import sys; sys.path.insert(0, '/{SITE}'); from inspector.__main__ import main; main()"
"""The command: an emulated program cannot start another, as its first line would."""
DOC = "usr/share/doc/seed-inspector"
OF_DEBIAN = r"lib(c|m|gcc_s|stdc\+\+|z|pthread|dl|rt)\.so\.\d+|ld-linux-.*"
"""What libc6, libgcc-s1, libstdc++6 and zlib1g bring, which the package depends on."""


def locked() -> dict[str, str]:
    """Version by name, as the lock has them for a station."""
    lines = re.findall(r"(?m)^\w.*(?= \\$)", (REPOSITORY / "requirements.txt").read_text())
    found = [r for r in map(Requirement, lines) if r.marker is None or r.marker.evaluate(DEBIAN_12)]
    return {r.name: str(r.specifier).removeprefix("==") for r in found if r.name not in BUILD_ONLY}


@pytest.fixture(scope="module")
def bill(unpacked: Path) -> Any:
    return json.loads((unpacked / DOC / "sbom.cdx.json").read_text())


def test_the_bill_of_materials_lists_the_locked_versions_and_no_others(bill: Any) -> None:
    assert {part["name"]: part["version"] for part in bill["components"]} == locked()
    assert bill["metadata"]["component"]["name"] == "seed-inspector"


def test_the_bill_of_materials_lists_every_native_library_that_a_wheel_brings(bill: Any, unpacked: Path) -> None:
    listed = {library["name"] for part in bill["components"] for library in part.get("components", ())}
    assert listed == {path.name for path in (unpacked / SITE).glob("*.libs/*")}
    assert not [part for part in bill["components"] if part["licenses"] == [{"license": {"name": "not stated"}}]]


def test_every_part_has_its_licence(bill: Any, unpacked: Path) -> None:
    for part in bill["components"]:
        texts = list((unpacked / DOC / "licences" / part["name"]).iterdir())
        assert texts
        assert all(len(text.read_text()) > 300 for text in texts)


def test_no_address_and_no_path_of_the_building_machine_is_in_what_is_generated(unpacked: Path) -> None:
    addresses = re.findall(r"https?://[^/\"]+", (unpacked / DOC / "sbom.cdx.json").read_text())
    assert addresses == ["http://cyclonedx.org"]
    made = [*(unpacked / DOC).glob("*"), *(unpacked / "DEBIAN").iterdir(), *unpacked.glob("usr/lib/*/pyvenv.cfg")]
    text = "\n".join(path.read_text() for path in made if path.is_file())
    assert not re.findall(r"/(?:tmp|root|home)/", text)
    compiled = unpacked / SITE / "inspector/cli/__pycache__/app.cpython-311.pyc"
    assert f"/{SITE}/inspector/cli/app.py".encode() in compiled.read_bytes()


def test_libraries_need_only_each_other_and_what_the_package_depends_on(unpacked: Path) -> None:
    libraries = [path for path in (unpacked / SITE).rglob("*.so*") if path.read_bytes()[:4] == b"\x7fELF"]
    read = ["readelf", "--dynamic", *map(str, libraries)]
    said = subprocess.run(read, capture_output=True, text=True, check=True, timeout=300).stdout
    needed = set(re.findall(r"\(NEEDED\).*\[(.+)\]", said))
    assert needed
    brought = {path.name for path in libraries}
    assert not {name for name in needed - brought if not re.fullmatch(OF_DEBIAN, name)}


def test_the_same_tree_gives_the_same_package_again(built: Callable[..., Path], package: Path) -> None:
    assert built().read_bytes() == package.read_bytes()


@pytest.fixture(scope="module")
def aarch64(built: Callable[..., Path], peer: Callable[[str, str], str], tmp_path_factory: Any) -> Path:
    """The files of an aarch64 Debian with the package for it, and an emulator for them in its root folder."""
    import clean_debian

    peer("aarch64-linux-gnu-gcc", "gcc-aarch64-linux-gnu")
    emulator = peer("qemu-aarch64-static", "qemu-user-static")
    peer("debootstrap", "debootstrap")
    root: Path = tmp_path_factory.mktemp("aarch64")
    try:
        clean_debian.unpack("arm64", "python3,libstdc++6", root)
    except clean_debian.CannotBeMade as error:
        pytest.skip(f"peer missing: {error}")
    subprocess.run(["dpkg-deb", "--extract", str(built("--arch", "arm64")), str(root)], check=True, timeout=300)
    shutil.copy(emulator, root / "emulator")
    return root


def test_on_aarch64_it_inspects_a_frame_to_the_same_heights(aarch64: Path, frames_folder: Path) -> None:
    shutil.copytree(frames_folder, aarch64 / "frames")
    emulated = ["chroot", str(aarch64), "/emulator", "/usr/bin/python3", "-I", "-c", START]
    there = inspect([*emulated], Path("/frames"))
    here = inspect([sys.executable, "-P", "-m", "inspector"], frames_folder)
    assert len(there) == 4
    assert there == pytest.approx(here, rel=1e-9)


def inspect(program: list[str], folder: Path) -> list[float]:
    """Heights in um that a program finds in a frame, in its order."""
    frame = [str(folder / "four_seeds.png"), "--calibration", str(folder / "calibration.yaml"), "--format", "jsonl"]
    done = subprocess.run([*program, "inspect", *frame], capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr
    return [defect["height_um"] for defect in json.loads(done.stdout)["defects"]]
