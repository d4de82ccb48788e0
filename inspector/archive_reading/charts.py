"""Charts of a report as inline SVG: counts over panels with limits and alarms, and a histogram."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape

WIDTH, HEIGHT, LEFT, RIGHT, TOP, BOTTOM = 1000, 280, 60, 16, 14, 46
BLUE, PALE, RED, AMBER = "#4c72b0", "#c3d0e6", "#c62828", "#b87503"


@dataclass(frozen=True, slots=True)
class Block:
    """One panel, or several in a row: mean and most defects, the lowest upper control limit of these panels (None: none
    yet), and what alarms began there."""

    mean: float
    most: float
    limit: float | None
    alarms: Sequence[str]
    label: str


def counts(blocks: Sequence[Block], each: int) -> str:
    """Defects per panel in the order of panels; ``each``: panels a block."""
    top = 1.12 * max([1.0, *(max(block.most, block.limit or 0.0) for block in blocks)])
    wide = (WIDTH - LEFT - RIGHT) / max(len(blocks), 1)
    parts = [*_begin(top, "defects per panel")]
    for n, block in enumerate(blocks):
        x, told = LEFT + n * wide, escape(f"{block.label}: mean {block.mean:.2f}, most {block.most:g}")
        parts.append(f"<g><title>{told}</title>{_bar(x, wide, block.most, top, PALE)}")
        parts.append(f"{_bar(x, wide, block.mean, top, BLUE)}</g>")
        if block.limit is not None:
            y = _y(block.limit, top)
            parts.append(f'<path d="M{x:.1f} {y:.1f}h{wide:.2f}" stroke="{AMBER}" stroke-width="2"/>')
        if block.alarms:
            at, why = x + wide / 2, escape("; ".join(block.alarms))
            parts.append(f"<g><title>{why}</title>")
            parts.append(f'<path d="M{at:.1f} {TOP + 12}l-6 -11h12z" fill="{RED}"/></g>')
    for n in range(0, len(blocks), max(1, math.ceil(len(blocks) / 8))):
        x, label = LEFT + (n + 0.5) * wide, escape(blocks[n].label)
        parts.append(f'<text x="{x:.1f}" y="{HEIGHT - BOTTOM + 16}" text-anchor="middle">{label}</text>')
    what = "panel" if each == 1 else f"{each} panels: their mean, pale their most"
    says = f"each bar {what};  line: upper control limit of a panel;  triangle: an alarm began"
    parts.append(f'<text x="{LEFT}" y="{HEIGHT - 8}" fill="#5d6876">{says}</text>')
    return "\n".join([*parts, "</svg>"])


def histogram(numbers: Sequence[int], step: float, limit_um: float | None) -> str:
    """Seeds by height, ``step`` um a bar, from 0; ``limit_um``: where the recipe's limit is."""
    top = 1.08 * max([1, *numbers])
    parts, wide = [*_begin(top, "seeds")], (WIDTH - LEFT - RIGHT) / max(len(numbers), 1)
    for n, number in enumerate(numbers):
        told = f"{n * step:g} to {(n + 1) * step:g} um: {number}"
        parts.append(f"<g><title>{told}</title>{_bar(LEFT + n * wide, wide, number, top, BLUE)}</g>")
    for n in range(0, len(numbers) + 1, max(1, math.ceil(len(numbers) / 10))):
        x = LEFT + n * wide
        parts.append(f'<text x="{x:.1f}" y="{HEIGHT - BOTTOM + 16}" text-anchor="middle">{n * step:g}</text>')
    if limit_um is not None and limit_um <= step * len(numbers):
        x = LEFT + limit_um / step * wide
        parts.append(f'<path d="M{x:.1f} {TOP}V{HEIGHT - BOTTOM}" stroke="{RED}" stroke-dasharray="5 4"/>')
        parts.append(f'<text x="{x + 5:.1f}" y="{TOP + 12}" fill="{RED}">limit {limit_um:g} um</text>')
    parts.append(f'<text x="{(LEFT + WIDTH - RIGHT) / 2}" y="{HEIGHT - 8}" text-anchor="middle">height, um</text>')
    return "\n".join([*parts, "</svg>"])


def step_of(most: float, bars: int) -> float:
    """1, 2 or 5 times a power of ten, so that there are ``bars`` at most."""
    rough = max(most, 1e-9) / bars
    power = 10.0 ** math.floor(math.log10(rough))
    return next(digit * power for digit in (1, 2, 5, 10) if digit * power >= rough * (1 - 1e-9))


def _begin(top: float, what: str) -> Iterator[str]:
    yield f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" font-family="sans-serif" font-size="12">'
    yield f'<rect width="{WIDTH}" height="{HEIGHT}" fill="white"/>'
    step = max(1.0, step_of(top, 6))
    for n in range(int(top / step) + 1):
        y = _y(n * step, top)
        yield f'<path d="M{LEFT} {y:.1f}H{WIDTH - RIGHT}" stroke="#ddd"/>'
        yield f'<text x="{LEFT - 8}" y="{y + 4:.1f}" text-anchor="end">{n * step:g}</text>'
    middle = (TOP + HEIGHT - BOTTOM) / 2
    yield f'<text x="16" y="{middle}" text-anchor="middle" transform="rotate(-90 16 {middle})">{what}</text>'


def _y(value: float, top: float) -> float:
    return HEIGHT - BOTTOM - (HEIGHT - TOP - BOTTOM) * value / top


def _bar(x: float, wide: float, value: float, top: float, colour: str) -> str:
    y, gap = _y(value, top), min(0.15 * wide, 2.0)
    high = HEIGHT - BOTTOM - y
    return f'<rect x="{x + gap:.2f}" y="{y:.1f}" width="{wide - 2 * gap:.2f}" height="{high:.1f}" fill="{colour}"/>'
