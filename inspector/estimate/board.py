"""Grey image of a calibration board -> numbered squares with sub-pixel centroids.

The board: bright squares of equal side on black, ``columns`` x ``rows`` of them at one pitch, seen whole, at any
rotation.

World frame: square (i, j), counted from 1, stands at x = i * pitch, y = j * pitch; x runs along the ``columns``
squares, y along the ``rows``, and z out of the board towards the camera (right-handed). A board of plain squares looks
the same turned by half a turn, so of the two frames left the one is taken whose axis that lies more towards the camera
points *to* the camera: along it the squares grow. With as many rows as columns that axis is x. Turning the image, or
the camera about its own axis, so changes no number.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import numpy.typing as npt

from inspector.estimate.calibration import BoardRefused, Points
from inspector.estimate.squares import Squares
from inspector.model import FloatArray, Image, IntArray

MIN_AREA_PX = 25
"""A smaller spot has no edges to speak of."""
FOURTH = (1.05, 2.8)
"""|E z^4| of a whitened parallelogram is 2.4 (z = u + i v, unit variances); blur and pixels bring one 4 px across down
to 1.1. A disc's is 0, an ellipse's of 8 x 4 px 1.0."""
MAX_THIRD = 0.6
"""|E z^3| of a whitened parallelogram is 0, of few pixels 0.55; of a square less a corner 0.7, of a triangle 2.3."""
FILL_TOLERANCE = 0.05
"""A parallelogram's area is 12 times the root of its covariance's determinant; a cross has a tenth less, a triangle a
seventh."""
MIN_CONTRAST_SIGMA = 6.0
"""Squares that stand out by less of their own scatter are not bright squares on black."""
SIDEWAYS = 0.5
"""A neighbour lies within this slope of a square's own axis; the diagonal one has slope 1."""
STEP_TOLERANCE = 0.25
"""A step to a neighbour, in sides, differs from the usual one by less than this share."""
RIM_PX = 3
"""Blur spreads an edge over this far on either side."""
MISSING_SHOWN = 6
"""So many places are named in a refusal; more say no more."""

Cell = tuple[int, int]
Mask = npt.NDArray[np.uint8]
Chosen = npt.NDArray[np.bool_]
Outline = npt.NDArray[np.int32]


@dataclass(frozen=True)
class Rejected:
    """A bright thing that is no square of the board, where it is, and why."""

    x_px: float
    y_px: float
    reason: str

    def __str__(self) -> str:
        return f"({self.x_px:.0f}, {self.y_px:.0f}) {self.reason}"


@dataclass(frozen=True)
class Board:
    """Numbered squares, in order of x then y (1,1), (1,2), ...; and what was bright but no square of the board."""

    squares: Squares
    columns: int
    rows: int
    rejected: tuple[Rejected, ...]


@dataclass(frozen=True)
class _Spot:
    """A bright thing: ``filled`` (h, w), 1 where it is, in a window whose first pixel is ``low`` (x, y)."""

    low: IntArray
    filled: Mask
    is_cut: bool

    @cached_property
    def pixels(self) -> FloatArray:
        """Its pixels (k, 2), x and y in the image."""
        return np.asarray(np.argwhere(self.filled)[:, ::-1] + self.low, np.float64)

    @cached_property
    def centre(self) -> FloatArray:
        return np.asarray(self.pixels.mean(axis=0))

    @cached_property
    def spread(self) -> FloatArray:
        """Lower triangle (2, 2) whose product with its transpose is the area's covariance, a pixel being a square."""
        away = self.pixels - self.centre
        return np.asarray(np.linalg.cholesky(away.T @ away / len(away) + np.eye(2) / 12), np.float64)

    @cached_property
    def whitened(self) -> npt.NDArray[np.complex128]:
        """Its pixels (k,) as complex numbers of unit variance in both parts: all parallelograms become one square."""
        u, v = np.linalg.solve(self.spread, (self.pixels - self.centre).T)
        return np.asarray(u + 1j * v)

    @cached_property
    def axes(self) -> FloatArray:
        """The sides of the parallelogram that it is, as columns (2, 2) px; E z^4 points against their direction."""
        turn = np.angle(-np.mean(self.whitened**4)) / 4
        c, s = np.cos(turn), np.sin(turn)
        return np.asarray(np.sqrt(12) * self.spread @ np.array([[c, -s], [s, c]]))

    def is_square(self) -> bool:
        """Whether it has the shape of a square seen aslant."""
        third, fourth = abs(np.mean(self.whitened**3)), abs(np.mean(self.whitened**4))
        fill = len(self.pixels) / (12 * np.linalg.det(self.spread))
        return bool(FOURTH[0] < fourth < FOURTH[1] and third < MAX_THIRD and abs(fill - 1) < FILL_TOLERANCE)

    def reject(self, reason: str) -> Rejected:
        return Rejected(float(self.centre[0]), float(self.centre[1]), reason)


def find(image: Image, pitch_mm: float, columns: int, rows: int, square_mm: float | None = None) -> Board:
    """The squares of a board in ``image`` (H, W), numbered; ``square_mm`` None: not known.

    Raises BoardRefused where there are no squares, some are missing or cut, or there are more than stated.
    """
    if columns < 2 or rows < 2:
        raise BoardRefused(f"a board of {columns} x {rows} squares is a line: at least 2 x 2 are needed")
    mask = _bright(image)
    quads, rejected = _sorted_out(_spots(mask))
    cells = _lattice(quads, None if square_mm is None else pitch_mm / square_mm)
    grid = _whole_board(cells, columns, rows, quads, rejected)
    xy_px, area_px2 = _centroids(image, mask, quads)
    order = _numbered(grid, xy_px, area_px2).ravel()
    i, j = np.indices((columns, rows)).reshape(2, -1) + 1
    points = Points(pitch_mm * np.column_stack([i, j, np.zeros(len(order))]), xy_px[order])
    strays = [quads[k].reject("is off the board's grid") for k in sorted(set(range(len(quads))) - set(order))]
    return Board(Squares(points, area_px2[order], square_mm), columns, rows, (*rejected, *strays))


# --- bright spots ----------------------------------------------------------------------------------------------------


def _bright(image: Image) -> Mask:
    """Pixels (H, W) uint8, 1 where brighter than Otsu's threshold. Raises BoardRefused where nothing stands out."""
    top = max(float(np.percentile(image, 99.9)), 1.0)  # a hot pixel must not set the scale
    scaled = np.clip(image * (255 / top), 0, 255).astype(np.uint8)
    threshold, mask = cv2.threshold(scaled, 0, 1, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
    dark, lit = scaled[scaled <= threshold], scaled[scaled > threshold]
    if not (dark.size and lit.size and lit.mean() - dark.mean() > MIN_CONTRAST_SIGMA * dark.std()):
        raise BoardRefused(
            "no bright squares on black: the image is evenly dark, bright or grey; light the board alone"
        )
    return np.asarray(mask, np.uint8)


def _spots(mask: Mask) -> list[_Spot]:
    """Bright things with their holes filled, but for specks."""
    outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    spots = (_spot(np.asarray(outline, np.int32), mask.shape) for outline in outlines)
    return [spot for spot in spots if np.count_nonzero(spot.filled) >= MIN_AREA_PX]


def _spot(outline: Outline, shape: tuple[int, ...]) -> _Spot:
    last = np.array([shape[1] - 1, shape[0] - 1])
    first_in, last_in = outline.min(axis=(0, 1)), outline.max(axis=(0, 1))
    low, high = np.maximum(first_in - 2 * RIM_PX, 0), np.minimum(last_in + 2 * RIM_PX, last)
    filled = np.zeros((high - low + 1)[::-1], np.uint8)
    cv2.drawContours(filled, [outline], -1, 1, cv2.FILLED, offset=(-int(low[0]), -int(low[1])))
    return _Spot(low, filled, bool(np.any(first_in == 0) or np.any(last_in == last)))


def _sorted_out(spots: list[_Spot]) -> tuple[list[_Spot], list[Rejected]]:
    """Spots that have a square's shape and are whole, and the others."""
    whole = [spot for spot in spots if not spot.is_cut]
    cut = [spot.reject("is cut by the image's edge") for spot in spots if spot.is_cut]
    odd = [spot.reject("is not a square's shape") for spot in whole if not spot.is_square()]
    return [spot for spot in whole if spot.is_square()], cut + odd


# --- the grid --------------------------------------------------------------------------------------------------------


def _lattice(quads: list[_Spot], step: float | None) -> dict[Cell, int]:
    """Cells of the largest set of quadrilaterals that are each other's neighbours: cell -> index.

    ``step`` is the pitch in sides; None: the most usual distance between neighbours.
    """
    links = _links(quads, step)
    largest: dict[Cell, int] = {}
    left = set(range(len(quads)))
    while left:
        cells = _spread_out(min(left), quads, links)
        left -= set(cells.values())
        largest = max(largest, cells, key=len)
    return largest


def _links(quads: list[_Spot], step: float | None) -> list[set[int]]:
    """For each quadrilateral, its neighbours: nearest along one of its axes, at the usual step, and the same back."""
    if not quads:
        return []
    centres = np.array([q.centre for q in quads])
    nearest = [_nearest_along(quad, centres) for quad in quads]
    mutual = [(k, j, a) for k, found in enumerate(nearest) for j, a in found.items() if k in nearest[j]]
    usual = step or float(np.median([a for _, _, a in mutual])) if mutual else 1.0
    steady = {(k, j) for k, j, a in mutual if abs(a / usual - 1) < STEP_TOLERANCE}
    return [{j for j in nearest[k] if {(k, j), (j, k)} <= steady} for k in range(len(quads))]


def _nearest_along(quad: _Spot, centres: FloatArray) -> dict[int, float]:
    """The nearest centre in each of the four directions of a quadrilateral's sides: index -> distance in sides."""
    local = np.linalg.solve(quad.axes, (centres - quad.centre).T).T
    found = {}
    for axis in (0, 1):
        for sign in (1, -1):
            ahead, aside = sign * local[:, axis], np.abs(local[:, 1 - axis])
            distance = np.where((ahead > 1) & (aside < SIDEWAYS * ahead), ahead, np.inf)
            if np.isfinite(distance).any():
                found[int(np.argmin(distance))] = float(distance.min())
    return found


def _spread_out(first: int, quads: list[_Spot], links: list[set[int]]) -> dict[Cell, int]:
    """Cells of all quadrilaterals linked with the ``first``, found outwards: cell -> index."""
    cells, axes = {(0, 0): first}, {first: quads[first].axes}
    queue = [((0, 0), first)]
    for cell, k in queue:
        for j in links[k] - set(axes):
            local = np.linalg.solve(axes[k], quads[j].centre - quads[k].centre)
            step = np.eye(2, dtype=int)[np.argmax(np.abs(local))] * int(np.sign(local[np.argmax(np.abs(local))]))
            there = (cell[0] + int(step[0]), cell[1] + int(step[1]))
            if there not in cells:
                cells[there], axes[j] = j, _aligned(quads[j].axes, axes[k])
                queue.append((there, j))
    return cells


def _aligned(axes: FloatArray, model: FloatArray) -> FloatArray:
    """``axes`` (2, 2) turned by the number of quarter turns that brings them nearest to the ``model``'s."""
    quarter = np.array([[0, -1], [1, 0]])
    turns = [axes @ np.linalg.matrix_power(quarter, n) for n in range(4)]
    return min(turns, key=lambda turned: float(np.sum((turned - model) ** 2)))


def _whole_board(
    cells: dict[Cell, int], columns: int, rows: int, quads: list[_Spot], rejected: list[Rejected]
) -> IntArray:
    """Indices (columns, rows) of the one full grid of the stated size. Raises BoardRefused, saying what was found."""
    found = np.array(sorted(cells)).reshape(-1, 2)
    grids = []
    for turned in {columns, rows}:
        size = (turned, columns + rows - turned)
        for corner in found:
            block = [(int(corner[0]) + u, int(corner[1]) + v) for u in range(size[0]) for v in range(size[1])]
            if all(cell in cells for cell in block):
                grid = np.array([cells[cell] for cell in block]).reshape(size)
                grids.append(grid if turned == columns else grid.T)
    if len(grids) == 1:
        return grids[0]
    raise BoardRefused(_why_not(cells, columns, rows, len(grids), quads, rejected))


def _why_not(
    cells: dict[Cell, int], columns: int, rows: int, count: int, quads: list[_Spot], rejected: list[Rejected]
) -> str:
    """What was found instead of one whole board."""
    found = np.array(sorted(cells)).reshape(-1, 2)
    extent = tuple(int(n) for n in np.ptp(found, axis=0) + 1) if len(found) else (0, 0)
    text = f"found {len(cells)} squares in a grid of {max(extent)} x {min(extent)}, not {columns} x {rows}"
    if count > 1:
        return f"{text}: the board has more squares than stated, so its corner is not known; state its true size"
    if sorted(extent) == sorted((columns, rows)):
        text += f"; missing near {_missing(cells, quads)}"
    if rejected:
        more = ", ..." if len(rejected) > MISSING_SHOWN else ""
        text += "; left out: " + ", ".join(map(str, rejected[:MISSING_SHOWN])) + more
    return text + ". The whole board must be in view, clear of dirt and reflections"


def _missing(cells: dict[Cell, int], quads: list[_Spot]) -> str:
    """Where in the image the empty cells of the grid are, by the plane's homography."""
    known = np.array(sorted(cells), dtype=np.float64)
    seen = np.array([quads[cells[cell]].centre for cell in sorted(cells)])
    low, high = known.min(axis=0).astype(int), known.max(axis=0).astype(int)
    empty = [(u, v) for u in range(low[0], high[0] + 1) for v in range(low[1], high[1] + 1) if (u, v) not in cells]
    homography, _ = cv2.findHomography(known, seen)
    places = cv2.perspectiveTransform(np.array(empty, dtype=np.float64)[:, None], homography)[:, 0]
    more = ", ..." if len(empty) > MISSING_SHOWN else ""
    return ", ".join(f"({x:.0f}, {y:.0f})" for x, y in places[:MISSING_SHOWN]) + more


def _numbered(grid: IntArray, xy_px: FloatArray, area_px2: FloatArray) -> IntArray:
    """The grid (columns, rows) turned into the world frame: right-handed, its axis along the view to the camera."""
    along_x, along_y = (np.diff(xy_px[grid], axis=axis).mean(axis=(0, 1)) for axis in (0, 1))
    if along_x[0] * along_y[1] - along_x[1] * along_y[0] > 0:  # image y points down: right-handed is negative
        grid = grid[:, ::-1]
    nearer_x, nearer_y = (float(np.diff(np.log(area_px2[grid]), axis=axis).mean()) for axis in (0, 1))
    if grid.shape[0] == grid.shape[1] and abs(nearer_y) > abs(nearer_x):
        grid, nearer_x, nearer_y = grid.T[:, ::-1], nearer_y, -nearer_x  # a quarter turn: x is the old y
    towards = nearer_x if abs(nearer_x) >= abs(nearer_y) else nearer_y
    return grid if towards > 0 else grid[::-1, ::-1]


# --- sub-pixel -------------------------------------------------------------------------------------------------------


def _centroids(image: Image, mask: Mask, quads: list[_Spot]) -> tuple[FloatArray, FloatArray]:
    """Area centroids (n, 2) px and areas (n,) px^2 of quadrilaterals, by how much of each pixel they cover."""
    distance, owner = cv2.distanceTransformWithLabels(1 - mask, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_CCOMP)
    dark = distance > RIM_PX
    black_dn = float(np.median(image[dark])) if dark.any() else float(image.min())
    light = image.astype(np.float64)
    found = [_centroid(light, dark, np.asarray(owner, np.intp), black_dn, quad) for quad in quads]
    return np.array([xy for xy, _ in found]), np.array([area for _, area in found])


def _centroid(
    light: FloatArray, dark: Chosen, owner: IntArray, black_dn: float, quad: _Spot
) -> tuple[FloatArray, float]:
    """Centroid (2,) px and area px^2: inside counts fully, the blurred rim by its grey level between black and white.

    White is a plane through the inside, since the board may be lit aslant; black is the dark just around the square.
    Where neighbours' rims meet, each pixel belongs to the nearer square.
    """
    height, width = quad.filled.shape
    x0, y0 = quad.low
    window = (slice(y0, y0 + height), slice(x0, x0 + width))
    grey, around, filled = light[window], dark[window], quad.filled > 0
    inside = cv2.erode(quad.filled, np.ones((3, 3), np.uint8), iterations=RIM_PX - 1) > 0
    reach = filled | (~around & (owner[window] == np.median(owner[window][filled])))
    black = float(np.median(grey[around])) if np.count_nonzero(around) > MIN_AREA_PX else black_dn
    white = _white(grey, filled, inside)
    cover = np.where(inside, 1.0, np.where(reach, (grey - black) / np.maximum(white - black, 1.0), 0.0))
    y, x = np.indices(grey.shape)
    area = float(cover.sum())
    return np.array([np.sum(cover * x), np.sum(cover * y)]) / area + quad.low, area


def _white(grey: FloatArray, filled: Chosen, inside: Chosen) -> FloatArray:
    """The square's own brightness everywhere (h, w): a plane through its inside, or its peak where there is none.

    Pixels far from the inside's median, dirt and glare, have no say.
    """
    if np.count_nonzero(inside) < MIN_AREA_PX:
        return np.full(grey.shape, np.percentile(grey[filled], 90))
    usual = np.median(grey[inside])
    away = np.abs(grey - usual)
    clean = inside & (away <= 4 * np.median(away[inside]) + 0.01 * usual)
    y, x = np.indices(grey.shape)
    terms = np.stack([np.ones_like(grey), x, y], axis=-1)
    plane = np.linalg.lstsq(terms[clean], grey[clean], rcond=None)[0]
    return np.asarray(terms @ plane)
