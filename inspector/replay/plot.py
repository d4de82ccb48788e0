"""Heights then and now as a plot, SVG: one over the other, and by how much each moved."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from inspector.replay.tally import Tally

SIDE, LEFT, TOP, GAP, BOTTOM = 360, 80, 40, 110, 60
FONT = 'font-family="sans-serif" font-size="13"'
MOST_POINTS = 5000
"""Of more seeds as many are drawn, evenly chosen."""

Points = Sequence[tuple[float, float]]


@dataclass(frozen=True, slots=True)
class _Axis:
    """From a value to a place between ``at`` and ``at + length``, which may run backwards."""

    low: float
    high: float
    at: float
    length: float

    def place(self, value: float) -> float:
        return self.at + self.length * (value - self.low) / (self.high - self.low)

    def marks(self) -> list[float]:
        """Round values, ten at most: 1, 2 or 5 times a power of ten apart."""
        rough = (self.high - self.low) / 10
        power = 10.0 ** math.floor(math.log10(rough))
        step = next(digit * power for digit in (1, 2, 5, 10) if digit * power >= rough * (1 - 1e-9))
        return [n * step for n in range(math.ceil(self.low / step), math.floor(self.high / step) + 1)]


def svg(counted: Tally) -> str:
    """The plot of every seed that was found both times and has a height."""
    both = [pair for of in counted.seeds for pair in of.heights_um]
    known = [(a, b) for a, b in both if a is not None and b is not None and math.isfinite(a) and math.isfinite(b)]
    drawn = known[:: max(1, math.ceil(len(known) / MOST_POINTS))]
    most = 1.05 * max([1.0, *(max(pair) for pair in known)])
    furthest = 1.1 * max([0.1, *(abs(now - then) for then, now in known)])
    width, height = LEFT + 2 * SIDE + GAP + 20, TOP + SIDE + BOTTOM
    x, y = _Axis(0, most, LEFT, SIDE), _Axis(0, most, TOP + SIDE, -SIDE)
    x_moved, y_moved = _Axis(0, most, LEFT + SIDE + GAP, SIDE), _Axis(-furthest, furthest, TOP + SIDE, -SIDE)
    share = f"{len(drawn)} of {len(known)}" if len(drawn) < len(known) else f"{len(known)}"
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" {FONT}>',
        f'<rect width="{width}" height="{height}" fill="white"/>',
        f'<text x="{LEFT}" y="22">{share} seeds found both times</text>',
        *_frame(x, y, "height then, um", "height now, um"),
        _line(x, y, (0, 0), (most, most)),
        *_points(x, y, drawn),
        *_frame(x_moved, y_moved, "height then, um", "now less then, um"),
        _line(x_moved, y_moved, (0, 0), (most, 0)),
        *_points(x_moved, y_moved, [(then, now - then) for then, now in drawn]),
    ]
    return "\n".join([*parts, "</svg>"]) + "\n"


def _frame(x: _Axis, y: _Axis, name_x: str, name_y: str) -> Iterator[str]:
    left, right, top, bottom = x.at, x.at + x.length, y.at + y.length, y.at
    for value in y.marks():
        at = y.place(value)
        yield f'<line x1="{left}" x2="{right}" y1="{at:.1f}" y2="{at:.1f}" stroke="#ddd"/>'
        yield f'<text x="{left - 6}" y="{at + 4:.1f}" text-anchor="end">{value:g}</text>'
    for value in x.marks():
        at = x.place(value)
        yield f'<line x1="{at:.1f}" x2="{at:.1f}" y1="{top}" y2="{bottom}" stroke="#ddd"/>'
        turned = f'transform="rotate(-45 {at:.1f} {bottom + 14})"'
        yield f'<text x="{at:.1f}" y="{bottom + 14}" text-anchor="end" {turned}>{value:g}</text>'
    yield f'<text x="{(left + right) / 2}" y="{bottom + 54}" text-anchor="middle">{name_x}</text>'
    middle = (top + bottom) / 2
    turned = f'transform="rotate(-90 {left - 60} {middle})"'
    yield f'<text x="{left - 60}" y="{middle}" text-anchor="middle" {turned}>{name_y}</text>'


def _line(x: _Axis, y: _Axis, start: tuple[float, float], end: tuple[float, float]) -> str:
    ends = f'x1="{x.place(start[0]):.1f}" y1="{y.place(start[1]):.1f}" x2="{x.place(end[0]):.1f}"'
    return f'<line {ends} y2="{y.place(end[1]):.1f}" stroke="#999" stroke-dasharray="4 3"/>'


def _points(x: _Axis, y: _Axis, points: Points) -> Iterator[str]:
    yield '<g fill="#4c72b0" fill-opacity="0.5">'
    for a, b in points:
        yield f'<circle cx="{x.place(a):.1f}" cy="{y.place(b):.1f}" r="2.5"/>'
    yield "</g>"
