"""The manual: links lead somewhere; commands, options and settings' keys that it names exist; what can be tried is."""

from __future__ import annotations

import importlib.util
import json
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import typer
from typer.core import TyperGroup
from typer.testing import CliRunner

from inspector.cli.app import app
from inspector.faults import Fault
from inspector.hmi import texts

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.glob("*.md")), *sorted((ROOT / "deploy").rglob("*.md"))]
TRIED = "## Try it without hardware"
SCHEMA = json.loads((ROOT / "config/schema.json").read_text())
COMMAND = typer.main.get_command(app)
HOLDS = re.compile(r"[a-z0-9_]+(\.[a-z0-9_]+)+")
"""A settings' key with what it is under, as the manual writes it."""
FILE_ENDINGS = (".yaml", ".json", ".jsonl", ".sqlite", ".md", ".py", ".png", ".svg", ".csv", ".so", ".service")


def short(path: Path) -> str:
    return str(path.relative_to(ROOT))


def code(page: Path) -> Iterator[str]:
    """Every line of a page's blocks of code, and every span of code."""
    for line in page.read_text().splitlines():
        if line.startswith("    ") and not line.lstrip().startswith(("|", "-")):
            yield line.strip()
        else:
            yield from re.findall(r"`([^`]+)`", line)


@cache
def build_manual() -> ModuleType:
    found = importlib.util.spec_from_file_location("build_manual", ROOT / "deploy/build_manual.py")
    assert found
    assert found.loader
    module = importlib.util.module_from_spec(found)
    sys.modules[found.name] = module  # dataclasses look their own module up
    found.loader.exec_module(module)
    return module


class Html(HTMLParser):
    """What a page links to or shows, and what it may be linked at."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.links: list[str] = []
        self.ids: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name in ("href", "src") and value:
                self.links.append(value)
            elif name == "id" and value:
                self.ids.add(value)


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("manual") / "html"
    build_manual().build(folder)
    return folder


def test_every_page_is_reached_and_every_link_in_the_built_manual_leads_somewhere(built: Path) -> None:
    pages = {path.resolve(): Html(path.read_text()) for path in built.rglob("*.html")}
    assert {short(page) for page in PAGES} <= {str(p.relative_to(built.resolve()).with_suffix(".md")) for p in pages}
    lost = []
    for path, page in pages.items():
        for link in page.links:
            target, _, fragment = link.partition("#")
            if re.match(r"[a-z]+:", link):
                continue
            place = (path.parent / target).resolve() if target else path
            if not place.is_file() or (fragment and fragment not in pages[place].ids):
                lost.append(f"{path.relative_to(built.resolve())}: {link}")
    assert not lost
    assert not [page for page, html in pages.items() if not html.links and page.name != "index.html"]
    assert "`" not in (built / "docs/README.html").read_text().partition("</nav>")[0]


@pytest.mark.parametrize(("text", "said"), [("[x](away.md)", "away.md"), ("[x](#nothing)\n# Head", "#nothing")])
def test_a_link_that_leads_nowhere_fails_the_build(
    text: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs/README.md").write_text(text)
    monkeypatch.setattr(build_manual(), "REPOSITORY", tmp_path)
    with pytest.raises(SystemExit, match=said):
        build_manual().build(tmp_path / "html")
    assert not (tmp_path / "html").exists()


def commands() -> list[tuple[str, str]]:
    """Every call of the program that a page names: the page, and the call."""
    calls = [(page, line) for page in PAGES for line in code(page)]
    return [(short(page), call) for page, line in calls for call in re.findall(r"(?:^|bin/)inspector (\S.*)", line)]


def wrong_in(call: str) -> str:
    """What in a call of the program is no command or option of it; empty if nothing."""
    words = re.findall(r"[^\s\[\]|\\,;]+", call)
    command: Any = COMMAND
    while isinstance(command, TyperGroup) and words and words[0] in command.commands:
        command = command.commands[words.pop(0)]
    if isinstance(command, TyperGroup) and words and not words[0].startswith("-"):
        return f"no command {words[0]!r}"
    known = {option for parameter in command.params for option in parameter.opts} | {"--help"}
    if command.context_settings.get("ignore_unknown_options"):  # a parser of its own
        known |= set(re.findall(r"--[a-z-]+", simulator_help(command.name or "")))
    return ", ".join(f"no option {word}" for word in words if word.startswith("--") and word.split("=")[0] not in known)


@cache
def simulator_help(name: str) -> str:
    return CliRunner().invoke(app, ["simulate-device", name, "--help"]).output


def test_every_command_and_option_that_a_page_names_exists() -> None:
    found = commands()
    assert len({call.split()[0] for _, call in found}) > 15
    assert not [f"{page}: inspector {call}: {wrong}" for page, call in found if (wrong := wrong_in(call))]


@pytest.mark.parametrize(
    "call", ["runn --config FILE", "run --confg FILE", "recipe usee 7", "simulate-device ccd --prof x"]
)
def test_a_command_that_is_not_there_is_noticed(call: str) -> None:
    assert wrong_in(call)


def below(node: dict[str, Any], key: str) -> list[dict[str, Any]]:
    """Every schema that a key may have below one."""
    definitions = SCHEMA["$defs"]
    if "$ref" in node:
        return below(definitions[node["$ref"].rpartition("/")[2]], key)
    parts = [part for name in ("anyOf", "oneOf", "allOf") for part in node.get(name, ())]
    parts += [node["items"]] if isinstance(node.get("items"), dict) else []
    here = [node["properties"][key]] if key in node.get("properties", {}) else []
    return here + [found for part in parts for found in below(part, key)]


def is_setting(path: str) -> bool:
    found = [SCHEMA]
    for key in path.split("."):
        found = [schema for node in found for schema in below(node, key)]
    return bool(found)


def test_every_settings_key_that_a_page_names_exists() -> None:
    top = SCHEMA["properties"].keys()
    spans = {(short(page), span) for page in PAGES for span in code(page) if HOLDS.fullmatch(span)}
    keys = [(page, span) for page, span in spans if span.split(".")[0] in top and not span.endswith(FILE_ENDINGS)]
    assert len(keys) > 40
    assert not [f"{page}: {key}" for page, key in sorted(keys) if not is_setting(key)]
    assert not is_setting("plc.prot")


def test_every_fault_is_on_its_page_with_its_remedy() -> None:
    page = (DOCS / "faults.md").read_text()
    missing = [
        fault.name
        for fault in Fault
        if fault and f"| {fault.value} {fault.name} | {fault.meaning} | {fault.remedy} |" not in page
    ]
    assert not missing
    hundreds = {str(fault.value)[0] for fault in Fault if fault}
    assert hundreds == set(re.findall(r"^\| (\d)\.\. \|", (DOCS / "operate.md").read_text(), re.MULTILINE))


def test_every_word_and_note_of_the_operators_page_is_explained() -> None:
    page, words = (DOCS / "operate.md").read_text(), texts.english()
    shown = [
        text
        for key, text in words.items()
        if key.startswith(("verdict.", "note.", "button.")) and key not in ("button.cancel", "button.confirm")
    ]
    assert not [text for text in shown if f"| {text} |" not in page]


def tried() -> list[str]:
    """The pages with commands that a newcomer can carry out."""
    return [page.name for page in DOCS.glob("*.md") if TRIED in page.read_text()]


@pytest.mark.parametrize("name", tried())
def test_what_can_be_tried_without_hardware_works(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for folder in ("config", "tests/data/board"):
        shutil.copytree(ROOT / folder, tmp_path / folder)
    for file in ("demo.yaml", "simulated.yaml"):  # any port, and as fast as can be
        text = (
            (tmp_path / "config" / file)
            .read_text()
            .replace("port: 5020", "port: 0")
            .replace("rate_hz: 4", "rate_hz: 200")
        )
        (tmp_path / "config" / file).write_text(text)
    (tmp_path / "var").mkdir()
    block = (DOCS / name).read_text().partition(TRIED)[2]
    lines = [line.strip() for line in block.splitlines() if line.startswith("    inspector ")]
    assert lines
    monkeypatch.chdir(tmp_path)
    for line in lines:
        if line.startswith("inspector run "):  # it has the process to itself
            words = [sys.executable, "-m", "inspector", *shlex.split(line)[1:]]
            assert subprocess.run(words, capture_output=True, timeout=100).returncode == 0, line
        else:
            done = CliRunner().invoke(app, shlex.split(line)[1:])
            assert done.exit_code == 0, f"{line}\n{done.output}"
