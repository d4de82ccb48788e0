"""Pages made of sections: facts, paragraphs, tables and pictures, as text for a terminal or as one HTML file."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape
from itertools import groupby

Cells = Sequence[str]


@dataclass(frozen=True, slots=True)
class Table:
    """Rows of cells below a header; ``marks`` has the class of a row ("pass", "fail", "") for each, or nothing."""

    header: Cells
    rows: Sequence[Cells]
    marks: Sequence[str] = ()


@dataclass(frozen=True, slots=True)
class Picture:
    """Markup that stands as it is: an SVG, or an image by :func:`embedded`; and what it shows."""

    markup: str
    caption: str = ""
    narrow: bool = False


@dataclass(frozen=True, slots=True)
class Section:
    """A part of a page, in the order: facts, paragraphs (those that begin with a space are equations), tables,
    pictures."""

    title: str
    facts: Sequence[tuple[str, str]] = ()
    paragraphs: Sequence[str] = ()
    tables: Sequence[Table] = ()
    pictures: Sequence[Picture] = ()
    level: int = 2


@dataclass(frozen=True, slots=True)
class Document:
    """``verdict`` is the word that stands out, "" for none; ``lead`` what stands below the title."""

    title: str
    lead: str
    verdict: str
    sections: Sequence[Section]


def embedded(image: bytes, kind: str, alt: str) -> str:
    """An image as markup that holds it; ``kind`` such as "jpeg"."""
    data = base64.b64encode(image).decode()
    return f'<img alt="{escape(alt)}" src="data:image/{kind};base64,{data}">'


def as_text(page: Document) -> str:
    """For a terminal; pictures are left out."""
    lines = [page.title, page.lead, *([page.verdict] if page.verdict else [])]
    for section in page.sections:
        lines += ["", section.title, ("=" if section.level == 2 else "-") * len(section.title)]
        width = max((len(name) for name, _ in section.facts), default=0)
        lines += [f"{name:<{width}}  {value}" for name, value in section.facts]
        lines += section.paragraphs
        for table in section.tables:
            lines += ["", *_text_table(table)]
    return "\n".join(line.rstrip() for line in lines) + "\n"


def _text_table(table: Table) -> Iterator[str]:
    rows = [table.header, *table.rows]
    widths = [max(len(row[n]) for row in rows) for n in range(len(table.header))]
    for row in rows:
        yield "  ".join(
            cell.rjust(width) if n else cell.ljust(width)
            for n, (cell, width) in enumerate(zip(row, widths, strict=True))
        )


def as_html(page: Document, made: str) -> str:
    """One file without anything outside of it; ``made`` says at the foot what made it, and when."""
    verdict = f'<p class="verdict {_mark(page.verdict)}">{escape(page.verdict)}</p>' if page.verdict else ""
    body = "\n".join(part for section in page.sections for part in _section(section))
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(page.title)}</title><style>{STYLE}</style></head><body>\n"
        f"<header><div><h1>{escape(page.title)}</h1><p>{escape(page.lead)}</p></div>{verdict}</header>\n"
        f"<main>\n{body}\n</main>\n<footer>{escape(made)}</footer>\n</body></html>\n"
    )


def _mark(verdict: str) -> str:
    return {"PASS": "pass", "FAIL": "fail"}.get(verdict, "none")


def _section(section: Section) -> Iterator[str]:
    yield f"<section><h{section.level}>{escape(section.title)}</h{section.level}>"
    if section.facts:
        facts = "".join(f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>" for name, value in section.facts)
        yield f"<dl>{facts}</dl>"
    for equations, texts in groupby(section.paragraphs, lambda text: text.startswith(" ")):
        if equations:
            yield f"<pre>{escape(chr(10).join(text.strip() for text in texts))}</pre>"
        else:
            yield from (f"<p>{escape(text)}</p>" for text in texts)
    for table in section.tables:
        yield from _table(table)
    if section.pictures:
        yield '<div class="pictures">'
        for picture in section.pictures:
            kind = ' class="narrow"' if picture.narrow else ""
            yield f"<figure{kind}>{picture.markup}<figcaption>{escape(picture.caption)}</figcaption></figure>"
        yield "</div>"
    yield "</section>"


def _table(table: Table) -> Iterator[str]:
    kinds = [_kind([row[n] for row in table.rows]) for n in range(len(table.header))]
    head = "".join(f"<th{kind}>{escape(cell)}</th>" for kind, cell in zip(kinds, table.header, strict=True))
    yield f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>'
    for n, row in enumerate(table.rows):
        cells = "".join(f"<td{kind}>{escape(cell)}</td>" for kind, cell in zip(kinds, row, strict=True))
        yield f'<tr class="{table.marks[n]}">{cells}</tr>' if n < len(table.marks) else f"<tr>{cells}</tr>"
    yield "</tbody></table></div>"


def _kind(column: Sequence[str]) -> str:
    """Words stand on the left, and no number is broken into two lines."""
    if any(cell and not cell[0].isdigit() and cell[0] not in "-+±" for cell in column):
        return ' class="text"'
    return "" if any(" " in cell for cell in column) else ' class="number"'


STYLE = """
:root{--ink:#1c2430;--dim:#5d6876;--line:#d9dee5;--pass:#2e8b57;--fail:#c62828;--none:#b87503}
*{box-sizing:border-box}
body{margin:0 auto;padding:28px;max-width:1080px;color:var(--ink);background:#fff;
font:14px/1.45 system-ui,"Segoe UI","Liberation Sans",Arial,sans-serif}
header{display:flex;justify-content:space-between;align-items:center;gap:24px;border-bottom:3px solid var(--ink);
padding-bottom:12px}
h1{font-size:24px;margin:0}header p{margin:4px 0 0;color:var(--dim)}
header p.verdict{margin:0;padding:10px 22px;color:#fff;font-size:20px;font-weight:700;letter-spacing:.06em;
white-space:nowrap;border-radius:4px}
.verdict.pass{background:var(--pass)}.verdict.fail{background:var(--fail)}.verdict.none{background:var(--none)}
h2{font-size:17px;margin:26px 0 8px;padding-bottom:3px;border-bottom:1px solid var(--line)}
h3{font-size:15px;margin:18px 0 6px}
p{margin:6px 0}pre{margin:6px 0;padding:8px 12px;background:#f4f6f8;border-left:3px solid var(--line);
font:12.5px/1.5 ui-monospace,"DejaVu Sans Mono",monospace;white-space:pre-wrap}
dl{display:grid;grid-template-columns:repeat(auto-fill,minmax(min(240px,44%),1fr));gap:8px 20px;margin:8px 0}
dt{color:var(--dim);font-size:12px}dd{margin:0;font-weight:600;overflow-wrap:anywhere}
.wide{overflow-x:auto}table{border-collapse:collapse;width:100%;margin:8px 0;font-size:13px;
font-variant-numeric:tabular-nums}
th{text-align:right;color:var(--dim);font-weight:600;font-size:12px;border-bottom:2px solid var(--line);
padding:4px 8px;vertical-align:bottom}
td{text-align:right;padding:3px 8px;border-bottom:1px solid var(--line)}
td.number{white-space:nowrap}th.text,td.text,th:first-child,td:first-child{text-align:left}
tr.fail td{background:#fdecec}tr.near td{background:#fff5e0}
.pictures{display:flex;flex-wrap:wrap;gap:14px;margin:8px 0}
figure{margin:0;flex:1 1 100%}figure.narrow{flex:0 1 calc(33.3% - 10px)}
figure img,figure svg{width:100%;height:auto;display:block;border:1px solid var(--line)}
figcaption{color:var(--dim);font-size:12px;padding:3px 0}
footer{margin-top:30px;padding-top:8px;border-top:1px solid var(--line);color:var(--dim);font-size:12px}
@media(max-width:600px){body{padding:14px}figure{overflow-x:auto}figure svg{min-width:640px}
figure.narrow{flex-basis:calc(50% - 7px)}}
@media print{@page{size:A4;margin:14mm}body{padding:0;max-width:none;font-size:11px}
*{-webkit-print-color-adjust:exact;print-color-adjust:exact}
dl{grid-template-columns:repeat(4,1fr)}td,th,figcaption{font-size:11px}
h2,h3{break-after:avoid}figure,tr,dl{break-inside:avoid}thead{display:table-header-group}.wide{overflow:visible}}
"""
