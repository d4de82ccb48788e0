"""House rules that a reviewer would otherwise have to remember, over every file of the project."""

from __future__ import annotations

import ast
import importlib
import re
import statistics
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
from pydantic import BaseModel

from firmware_bridge.strict import attribute_docstrings
from inspector.faults import Fault

ROOT = Path(__file__).parents[2]
HERE = Path(__file__)
MADE = {"build", "dist", "var"}
"""Folders that the project's own tools make."""
TEXT_SUFFIXES = {"", ".c", ".cfg", ".csv", ".js", ".json", ".md", ".mjs", ".py", ".service", ".st", ".toml", ".txt"}
TEXT_SUFFIXES |= {".yaml", ".yml"}


def project_files() -> list[Path]:
    """Every text file that belongs to the project, this one left out: it has to name what it forbids."""
    folders = [p for p in ROOT.iterdir() if p.is_dir() and not p.name.startswith(".") and p.name not in MADE]
    folders = [p for p in folders if not p.name.endswith(".egg-info")]
    found = [p for p in ROOT.iterdir() if p.is_file()] + [ROOT / ".ci" / "run"]
    found += [p for folder in folders for p in folder.rglob("*") if p.is_file() and "__pycache__" not in p.parts]
    return [p for p in found if p.suffix in TEXT_SUFFIXES and p != HERE]


FILES = project_files()
SOURCES = [p for p in FILES if p.suffix == ".py"]


def short(path: Path) -> str:
    return str(path.relative_to(ROOT))


def lines_with(pattern: str, files: list[Path]) -> list[str]:
    """`file:line: text` of every line that the pattern is found in."""
    return [
        f"{short(path)}:{number}: {line.strip()}"
        for path in files
        for number, line in enumerate(path.read_text().splitlines(), 1)
        if re.search(pattern, line)
    ]


def functions() -> Iterator[tuple[str, int]]:
    """Every function of the two packages, and its number of lines."""
    for path in SOURCES:
        if not path.is_relative_to(ROOT / "tests"):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                    assert node.end_lineno is not None
                    yield f"{short(path)}:{node.lineno} {node.name}", node.end_lineno - node.lineno + 1


def models() -> list[type[BaseModel]]:
    """Every settings model of the project, from every module that there is."""
    for path in SOURCES:
        if path.is_relative_to(ROOT / "inspector") or path.is_relative_to(ROOT / "firmware_bridge"):
            importlib.import_module(".".join(path.relative_to(ROOT).with_suffix("").parts))

    def below(model: type[BaseModel]) -> Iterator[type[BaseModel]]:
        for child in model.__subclasses__():
            yield child
            yield from below(child)

    return [m for m in below(BaseModel) if m.__module__.startswith(("inspector.", "firmware_bridge."))]


def test_every_setting_says_what_it_is() -> None:
    said = {f"{m.__module__}.{m.__name__}": m.model_fields.keys() - attribute_docstrings(m).keys() for m in models()}
    assert "inspector.settings.Settings" in said
    assert not {name: unsaid for name, unsaid in said.items() if unsaid}


@pytest.mark.parametrize("fault", list(Fault)[1:], ids=lambda f: f.name)
def test_every_fault_has_a_meaning_and_a_remedy(fault: Fault) -> None:
    assert fault.meaning
    assert fault.remedy


def test_files_and_functions_stay_small() -> None:
    assert not [short(path) for path in SOURCES if len(path.read_text().splitlines()) > 450]
    lengths = dict(functions())
    assert not [name for name, length in lengths.items() if length > 60]
    assert statistics.median(lengths.values()) <= 15


def test_no_test_sleeps() -> None:
    assert not lines_with(r"\btime\.sleep\(|from time import .*\bsleep\b", [p for p in SOURCES if "tests" in p.parts])


def test_no_exception_to_a_rule_without_its_reason() -> None:
    reasonless = r"# (type: ignore|noqa)\b(?!\S*(\[|: ).*(  #|: ) ?\w+ \w+)"
    assert not lines_with(reasonless, SOURCES)


def test_nothing_is_left_undone() -> None:
    assert not lines_with(r"\b(TODO|FIXME|XXX|NotImplementedError)\b", FILES)


def test_no_path_of_one_machine() -> None:
    assert not lines_with(r"(?<![\w.])/(work|root|home|farm|tmp)/", FILES)


def test_no_address_of_a_package_registry() -> None:
    assert not lines_with(r"pypi\.org|pythonhosted|npmjs\.(org|com)|--(extra-)?index-url|deb\.debian\.org", FILES)


def test_import_rules_hold() -> None:
    command = [Path(sys.executable).parent / "lint-imports", "--no-cache", "--config", ROOT / "pyproject.toml"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=100)
    assert done.returncode == 0, done.stdout


def test_nothing_but_commands_and_tests_uses_the_lab() -> None:
    service = [p for p in SOURCES if not {"tests", "lab", "cli"} & set(p.parts)]
    assert not lines_with(r"\binspector\.lab\b|from inspector import .*\blab\b", service)


def test_the_readme_names_commands_that_exist() -> None:
    targets = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    named = set(re.findall(r"(?:^    |`)make ([a-z]+)", (ROOT / "README.md").read_text(), re.MULTILINE))
    assert {"demo", "test"} <= named <= targets


def test_units_start_the_command_where_the_package_puts_it() -> None:
    elsewhere = r"^Exec\w+=(?!/usr/bin/inspector ).*\binspector (run|page|health)\b|/opt/"
    assert not lines_with(elsewhere, [p for p in FILES if p.is_relative_to(ROOT / "deploy") and p.suffix == ".service"])


def test_every_file_of_the_two_packages_is_installed_with_them() -> None:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    patterns = ["*.py", "*.c", "*.h", *settings["package-data"]["*"]]
    listed = ["git", "-C", str(ROOT), "ls-files", "inspector", "firmware_bridge"]
    names = subprocess.run(listed, capture_output=True, text=True, check=True, timeout=60).stdout.splitlines()
    assert names
    assert not [name for name in names if not any(Path(name).match(pattern) for pattern in patterns)]
