"""`make deb`: the Debian package, a virtual environment ready-made from the locked wheels and this program's own.

Installing it runs no pip and asks no network; the same tree gives the same bytes again.
"""

from __future__ import annotations

import argparse
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
import zipfile
from importlib.metadata import Distribution, distributions
from pathlib import Path

import build_manual
import build_wheel
import sbom
from build_wheel import DIST, MACHINES, REPOSITORY

NAME = "seed-inspector"
PYTHON = "3.11"
"""Python of Debian 12; compiled wheels and byte code are of it alone."""
GLIBC_MINOR = 36
"""Debian 12 has glibc 2.36, and so loads wheels of every manylinux up to that."""
BUILD_ONLY = {"setuptools"}
"""Locked because they build this program's wheel; a station has no use for them."""
ELF_MACHINES = {"amd64": 62, "arm64": 183}
"""e_machine in the head of a program or library: EM_X86_64, EM_AARCH64."""
HOME = Path("usr/lib") / NAME
SITE = HOME / f"lib/python{PYTHON}/site-packages"
SHARE = Path("usr/share") / NAME
DOC = Path("usr/share/doc") / NAME
SYSTEM = {
    "*.service": "lib/systemd/system",
    "*.timer": "lib/systemd/system",
    "inspector.service.d/*": "lib/systemd/system/inspector.service.d",
    "system.conf.d/*": "lib/systemd/system.conf.d",
    "journald.conf.d/*": "lib/systemd/journald.conf.d",
    "sysctl.d/*": "usr/lib/sysctl.d",
    "tmpfiles.d/*": "usr/lib/tmpfiles.d",
    "udev/*": "lib/udev/rules.d",
}
"""Where each of the files in deploy/ goes: a plant's own of the same name under /etc takes the place of each."""
DEBIAN = REPOSITORY / "deploy/debian"


def build(architecture: str, output: Path, compression: str) -> Path:
    """The package, in ``output``."""
    if sys.version_info[:2] != tuple(map(int, PYTHON.split("."))):
        sys.exit(f"byte code of Python {PYTHON} is wanted, and this is {platform.python_version()}: PYTHON=python3.11")
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "root"
        fill_site(root / SITE, architecture, Path(folder))
        make_environment(root)
        add_settings(root)
        add_documents(root)
        version = add_control(root, architecture)
        set_modes(root)
        return pack(root, output / f"{NAME}_{version}_{architecture}.deb", compression)


def fill_site(site: Path, architecture: str, folder: Path) -> None:
    """Unpack the locked wheels of an architecture, and this program's own."""
    lock = folder / "requirements.txt"
    lock.write_text(without((REPOSITORY / "requirements.txt").read_text(), BUILD_ONLY))
    machine = MACHINES[architecture]
    platforms = [f"manylinux_2_{n}_{machine}" for n in range(GLIBC_MINOR, 16, -1)] + [f"manylinux2014_{machine}"]
    which = ["--only-binary=:all:", f"--python-version={PYTHON}", *(f"--platform={p}" for p in platforms)]
    quiet = ["--quiet", "--disable-pip-version-check", "--no-compile", "--no-deps"]
    pip = [sys.executable, "-m", "pip", "install", *quiet, *which, "--require-hashes"]
    run(*pip, "--requirement", lock, "--target", site)
    shutil.rmtree(site / "bin")
    with zipfile.ZipFile(build_wheel.build(architecture, folder / "wheel")) as wheel:
        wheel.extractall(site)
    check_machine(site, architecture)


def without(lock: str, names: set[str]) -> str:
    """A hashed list without some distributions."""
    entries = re.split(r"\n(?=\S)", lock)
    return "\n".join(entry for entry in entries if re.split(r"[=\s]", entry)[0] not in names)


def check_machine(site: Path, architecture: str) -> None:
    """Nothing native of another machine may go into the package."""
    for path in site.rglob("*.so*"):
        head = path.read_bytes()[:20]
        if head[:4] == b"\x7fELF" and int.from_bytes(head[18:20], "little") != ELF_MACHINES[architecture]:
            sys.exit(f"{path.relative_to(site)} is not of {architecture}: its wheel or compiler is of another machine")


def make_environment(root: Path) -> None:
    """What makes a virtual environment of site-packages, the command, and byte code that is never written again."""
    home = root / HOME
    (home / "bin").mkdir()
    (home / "bin/python3").symlink_to("/usr/bin/python3")
    (home / "pyvenv.cfg").write_text(f"home = /usr/bin\ninclude-system-site-packages = false\nversion = {PYTHON}\n")
    command = home / "bin/inspector"
    command.write_text(f"#!/{HOME}/bin/python3 -I\nfrom inspector.__main__ import main\n\nmain()\n")
    command.chmod(0o755)
    (root / "usr/bin").mkdir()
    (root / "usr/bin/inspector").symlink_to(f"/{HOME}/bin/inspector")
    compile_all = [sys.executable, "-m", "compileall", "-q", "--invalidation-mode", "unchecked-hash"]
    run(*compile_all, "-s", root, "-p", "/", root / HOME)


def add_settings(root: Path) -> None:
    """What a new station begins with, and what it asks of the system."""
    settings = root / SHARE / "config"
    shutil.copytree(REPOSITORY / "config", settings, ignore=shutil.ignore_patterns("frames"))
    (settings / "demo.yaml").unlink()
    for files, place in SYSTEM.items():
        for source in (REPOSITORY / "deploy").glob(files):
            (root / place).mkdir(parents=True, exist_ok=True)
            shutil.copy(source, root / place)


def add_documents(root: Path) -> None:
    """The manual, as Markdown and as HTML, the bill of materials, and the licence of every part."""
    doc = root / DOC
    doc.mkdir(parents=True)
    manual = build_manual.build(doc / "html")
    build_manual.copy([*manual.pages, *manual.files], doc)
    (doc / "sbom.cdx.json").write_text(sbom.bill(root / SITE, NAME))
    parts = sorted(distributions(path=[str(root / SITE)]), key=sbom.name_of)
    said = [licences(part, root) for part in parts if sbom.name_of(part) != NAME]
    (doc / "copyright").write_text((DEBIAN / "copyright").read_text() + "\n" + "\n".join(said))


def licences(part: Distribution, root: Path) -> str:
    """A paragraph of the file of copyrights; the texts that it names are put beside it."""
    name = sbom.name_of(part)
    folder = root / DOC / "licences" / name
    files = [f for f in part.files or () if re.search(r"licen[cs]e|copying|notice", f.name, re.IGNORECASE)]
    texts = [root / SITE / f for f in files if f.suffix != ".py"] or [DEBIAN / "licences" / name]
    folder.mkdir(parents=True)
    for number, text in enumerate(texts):
        shutil.copy(text, folder / (f"{number}-{text.name}" if len(texts) > 1 else text.name))
    ((_, stated),) = sbom.licence_of(part).items()
    stated = stated if isinstance(stated, str) else stated["name"]
    return f"Files: {SITE}\nComment: {name} {part.version}\nLicense: {stated}\n Texts: /{DOC}/licences/{name}/\n"


def add_control(root: Path, architecture: str) -> str:
    """The control files; the version."""
    folder = root / "DEBIAN"
    folder.mkdir()
    for script in ("postinst", "prerm", "postrm"):
        shutil.copy(DEBIAN / script, folder)
    (program,) = distributions(name=NAME, path=[str(root / SITE)])
    size_kib = sum(p.lstat().st_size for p in root.rglob("*") if not p.is_dir()) // 1024
    control = (DEBIAN / "control").read_text()
    values = {"VERSION": program.version, "ARCHITECTURE": architecture, "SIZE_KIB": str(size_kib)}
    (folder / "control").write_text(re.sub(r"@(\w+)@", lambda m: values[m[1]], control))
    return program.version


def set_modes(root: Path) -> None:
    """The same modes and times whoever builds it: nothing of the umask, nothing of today."""
    for path in [root, *root.rglob("*")]:
        if not path.is_symlink():
            scripts = {root / HOME / "bin", root / "DEBIAN"} - ({path.parent} if path.name == "control" else set())
            path.chmod(0o755 if path.is_dir() or path.parent in scripts else 0o644)
        os.utime(path, (build_wheel.epoch(), build_wheel.epoch()), follow_symlinks=False)


def pack(root: Path, package: Path, compression: str) -> Path:
    """Make the archive."""
    package.parent.mkdir(parents=True, exist_ok=True)
    os.environ["SOURCE_DATE_EPOCH"] = str(build_wheel.epoch())
    run("dpkg-deb", "--root-owner-group", f"-Z{compression}", "--build", root, package)
    return package


def run(*command: str | Path) -> None:
    """A command that has to succeed; what it says is shown if it does not."""
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"{done.stdout}{done.stderr}\n{Path(command[0]).name} failed, as said above")


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description="Build the Debian package.")
    parser.add_argument("--arch", choices=MACHINES, default=None, help="Debian's name of the machine to build for")
    parser.add_argument("--output", type=Path, default=DIST, help="folder for the package")
    parser.add_argument("--compression", default="zstd", help="as dpkg-deb -Z has it; xz takes minutes")
    options = parser.parse_args()
    print(build(options.arch or build_wheel.this_architecture(), options.output, options.compression))


if __name__ == "__main__":
    main()
