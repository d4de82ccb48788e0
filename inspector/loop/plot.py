"""The comparison of kept booths as a plot, SVG: mean defects per panel over time, with a band of the middle 80 %."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from inspector.loop.proof import Comparison
from inspector.model import FloatArray

WIDTH, HEIGHT, LEFT, RIGHT, TOP, BOTTOM = 860, 420, 60, 20, 20, 50
BLOCK_PANELS = 50
FONT = 'font-family="sans-serif" font-size="13"'
COLOURS = ("#c44e52", "#dd8452", "#8172b3", "#4c72b0", "#55a868")


def svg(comparison: Comparison) -> str:
    """The plot of every way of keeping the booth."""
    curves = {way: comparison.in_blocks(way, BLOCK_PANELS) for way in comparison.runs}
    top = float(max(curve[:, 2].max() for curve in curves.values())) * 1.05
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" {FONT}>',
        f'<rect width="{WIDTH}" height="{HEIGHT}" fill="white"/>',
        *_axes(comparison.panels, top),
    ]
    for n, (way, curve) in enumerate(curves.items()):
        parts += _curve(curve, comparison.panels, top, COLOURS[n % len(COLOURS)])
        parts.append(
            f'<rect x="{LEFT + 14}" y="{TOP + 8 + 20 * n}" width="14" height="10" fill="{COLOURS[n % len(COLOURS)]}"/>'
        )
        parts.append(f'<text x="{LEFT + 34}" y="{TOP + 18 + 20 * n}">{way}</text>')
    return "\n".join([*parts, "</svg>"]) + "\n"


def _x(panel: float, panels: int) -> float:
    return LEFT + (WIDTH - LEFT - RIGHT) * panel / panels


def _y(value: float, top: float) -> float:
    return HEIGHT - BOTTOM - (HEIGHT - TOP - BOTTOM) * value / top


def _step(most: float) -> int:
    """Between marks of an axis: 1, 2 or 5 times a power of ten, so that there are ten at most."""
    steps = (digit * int(10**power) for power in range(9) for digit in (1, 2, 5))
    return next(step for step in steps if most / step <= 10)


def _axes(panels: int, top: float) -> Iterator[str]:
    for value in range(0, int(top) + 1, _step(top)):
        y = _y(value, top)
        yield f'<line x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y:.1f}" y2="{y:.1f}" stroke="#ddd"/>'
        yield f'<text x="{LEFT - 8}" y="{y + 4:.1f}" text-anchor="end">{value}</text>'
    for n in range(0, panels + 1, _step(panels)):
        yield f'<text x="{_x(n, panels):.1f}" y="{HEIGHT - BOTTOM + 18}" text-anchor="middle">{n}</text>'
    yield f'<text x="{(LEFT + WIDTH - RIGHT) / 2}" y="{HEIGHT - 10}" text-anchor="middle">panels</text>'
    middle = (TOP + HEIGHT - BOTTOM) / 2
    turned = f'transform="rotate(-90 16 {middle})"'
    yield f'<text x="16" y="{middle}" text-anchor="middle" {turned}>defects per panel</text>'


def _curve(curve: FloatArray, panels: int, top: float, colour: str) -> Iterator[str]:
    xs = [_x((n + 0.5) * BLOCK_PANELS, panels) for n in range(len(curve))]
    mean, low, high = ([_y(float(v), top) for v in column] for column in curve.T)
    band = [*zip(xs, low, strict=True), *reversed(list(zip(xs, high, strict=True)))]
    yield f'<polygon points="{_points(band)}" fill="{colour}" opacity="0.15"/>'
    line = _points(list(zip(xs, mean, strict=True)))
    yield f'<polyline points="{line}" fill="none" stroke="{colour}" stroke-width="2"/>'


def _points(points: Sequence[tuple[float, float]]) -> str:
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
