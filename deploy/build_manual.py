"""`make manual`: every page that docs/README.md leads to, as HTML in one folder, with what they show and link to.

Nothing in it asks a network. The order of the pages is that in which they are first named.
"""

from __future__ import annotations

import argparse
import html
import os
import re
import shutil
import string
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from markdown_it import MarkdownIt
from markdown_it.token import Token

REPOSITORY = Path(__file__).parents[1]
START = Path("docs/README.md")
OUTPUT = REPOSITORY / "build/manual"
TEMPLATE = string.Template(Path(__file__).with_name("manual.template.html").read_text())
ELSEWHERE = re.compile(r"[a-z]+:|//")
"""How a link begins that leads out of the manual."""
PARSER = MarkdownIt("commonmark", {"html": False}).enable("table")


@dataclass(frozen=True, slots=True)
class Page:
    """A page of the manual; paths are from the repository."""

    path: Path
    title: str
    tokens: list[Token]
    anchors: frozenset[str]

    @property
    def links(self) -> Iterator[tuple[Token, str, Path, str]]:
        """Each token that links or shows something of the project: the token, its attribute, target and fragment."""
        for token in _inline(self.tokens):
            name = {"link_open": "href", "image": "src"}.get(token.type, "")
            address = str(token.attrGet(name) or "") if name else ""
            if address and not ELSEWHERE.match(address):
                target, _, fragment = address.partition("#")
                place = os.path.normpath(self.path.parent / target) if target else str(self.path)
                yield token, name, Path(place), fragment


@dataclass(frozen=True, slots=True)
class Manual:
    """All pages, in order; the files that they link to or show; and what is wrong with their links."""

    pages: dict[Path, Page]
    files: tuple[Path, ...]
    broken: tuple[str, ...]


def read(start: Path = START) -> Manual:
    """The manual as its first page leads to it."""
    pages: dict[Path, Page] = {}
    files: dict[Path, None] = {}
    broken, waiting = [], [start]
    while waiting:
        path = waiting.pop(0)
        if path in pages:
            continue
        pages[path] = page = parse(path)
        for _, _, target, _ in page.links:
            if not _is_there(target):
                broken.append(f"{path}: {target} is no file of the project")
            elif target.suffix == ".md":
                waiting.append(target)
            else:
                files[target] = None
    broken += [f"{page.path}: {target} has no heading #{fragment}" for page, target, fragment in _lost(pages)]
    return Manual(pages, tuple(files), tuple(broken))


def parse(path: Path) -> Page:
    """One page, its headings with the anchors that forges give them."""
    tokens = PARSER.parse((REPOSITORY / path).read_text())
    anchors: dict[str, str] = {}
    for opening, content in pairwise(tokens):
        if opening.type == "heading_open":
            name = slug(content.content)
            name = name if name not in anchors else f"{name}-{sum(a.startswith(name) for a in anchors)}"
            anchors[name] = content.content
            opening.attrSet("id", name)
    title = next(iter(anchors.values()), path.stem).replace("`", "")
    return Page(path, title, tokens, frozenset(anchors))


def slug(heading: str) -> str:
    """A heading's anchor: small letters, hyphens for spaces, nothing else but digits and underscores."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


def build(output: Path) -> Manual:
    """Write the manual into a folder; what was there is replaced. Ends the program if a link leads nowhere."""
    manual = read()
    if manual.broken:
        sys.exit("\n".join(manual.broken))
    shutil.rmtree(output, ignore_errors=True)
    for page in manual.pages.values():
        place = output / _as_html(page.path)
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_text(render(page, list(manual.pages.values())))
    copy(manual.files, output)
    start = _as_html(START)
    (output / "index.html").write_text(f'<!DOCTYPE html><meta http-equiv="refresh" content="0; url={start}">\n')
    return manual


def copy(files: Sequence[Path], output: Path) -> None:
    """Copy files of the project to the same places under a folder."""
    for file in files:
        (output / file).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(REPOSITORY / file, output / file)


def render(page: Page, pages: Sequence[Page]) -> str:
    """A page's HTML, with links to all pages beside it."""
    for token, name, target, fragment in page.links:
        address = os.path.relpath(_as_html(target), page.path.parent)
        token.attrSet(name, f"{address}#{fragment}" if fragment else address)
    body = PARSER.renderer.render(page.tokens, PARSER.options, {})
    body = body.replace("<li>[ ] ", '<li class="step"><input type="checkbox"> ')
    entries = [_entry(other, page) for other in pages]
    return TEMPLATE.substitute(title=html.escape(page.title), pages="\n".join(entries), body=body)


def _entry(page: Page, shown: Page) -> str:
    """A page's line in the list beside the page that is shown."""
    here, address = " class=here" if page is shown else "", os.path.relpath(_as_html(page.path), shown.path.parent)
    return f'<li{here}><a href="{address}">{html.escape(page.title)}</a>'


def _as_html(path: Path) -> Path:
    return path.with_suffix(".html") if path.suffix == ".md" else path


def _is_there(path: Path) -> bool:
    return path.parts[0] != ".." and not path.is_absolute() and (REPOSITORY / path).is_file()


def _inline(tokens: Sequence[Token]) -> Iterator[Token]:
    for token in tokens:
        yield token
        yield from _inline(token.children or ())


def _lost(pages: dict[Path, Page]) -> Iterator[tuple[Page, Path, str]]:
    """Links to headings that are not there."""
    for page in pages.values():
        for _, _, target, fragment in page.links:
            if fragment and target in pages and fragment not in pages[target].anchors:
                yield page, target, fragment


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description="Build the manual.")
    parser.add_argument("--output", type=Path, default=OUTPUT, help="folder for it; what is there is replaced")
    options = parser.parse_args()
    build(options.output)
    print(options.output / "index.html")


if __name__ == "__main__":
    main()
