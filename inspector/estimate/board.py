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

import cv2
import numpy as np
import numpy.typing as npt

from inspector.estimate.calibration import BoardRefused, Points
from inspector.estimate.squares import Squares
from inspector.model import FloatArray, Image, IntArray

MIN_AREA_PX = 25
"""A smaller spot has no edges to speak of."""
MIN_FILL = 0.82
"""Least share of an outline's hull that it, and the quadrilateral of its corners, fill: a disc's fills 0.64."""
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
class _Quad:
    """A bright quadrilateral: its outline (k, 1, 2) of pixels and its corners (4, 2), all quads' in one sense."""

    outline: Outline
    corners: FloatArray

    @property
    def centre(self) -> FloatArray:
        return np.asarray(self.corners.mean(axis=0))

    @property
    def axes(self) -> FloatArray:
        """Its two sides as vectors, in columns (2, 2) px."""
        c = self.corners
        return np.column_stack([(c[1] - c[0]) + (c[2] - c[3]), (c[2] - c[1]) + (c[3] - c[0])]) / 2


def find(image: Image, pitch_mm: float, columns: int, rows: int, square_mm: float | None = None) -> Board:
    """The squares of a board in ``image`` (H, W), numbered; ``square_mm`` None: not known.

    Raises BoardRefused where there are no squares, some are missing or cut, or there are more than stated.
    """
    if columns < 2 or rows < 2:
        raise BoardRefused(f"a board of {columns} x {rows} squares is a line: at least 2 x 2 are needed")
    mask = _bright(image)
    quads, rejected = _quads(mask)
    cells = _lattice(quads, None if square_mm is None else pitch_mm / square_mm)
    grid = _whole_board(cells, columns, rows, quads, rejected)
    xy_px, area_px2 = _centroids(image, mask, quads)
    order = _numbered(grid, xy_px, area_px2).ravel()
    i, j = np.indices((columns, rows)).reshape(2, -1) + 1
    points = Points(pitch_mm * np.column_stack([i, j, np.zeros(len(order))]), xy_px[order])
    strays = [_reject(quads[k].outline, "is off the board's grid") for k in sorted(set(range(len(quads))) - set(order))]
    return Board(Squares(points, area_px2[order], square_mm), columns, rows, (*rejected, *strays))


# --- bright quadrilaterals -------------------------------------------------------------------------------------------


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


def _quads(mask: Mask) -> tuple[list[_Quad], list[Rejected]]:
    """Bright quadrilaterals wholly in the image, and what else is bright (but specks, which are dropped)."""
    outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    quads, rejected = [], []
    for outline in (np.asarray(found, np.int32) for found in outlines):
        if cv2.contourArea(outline) < MIN_AREA_PX:
            continue
        corners = _corners(outline)
        if _is_cut(outline, mask.shape):
            rejected.append(_reject(outline, "is cut by the image's edge"))
        elif corners is None:
            rejected.append(_reject(outline, "is not a square's shape"))
        else:
            quads.append(_Quad(outline, corners))
    return quads, rejected


def _corners(outline: Outline) -> FloatArray | None:
    """The four corners (4, 2) of an outline, clockwise in the image; None if it is no filled quadrilateral."""
    hull = cv2.convexHull(outline, clockwise=True)
    area, around = cv2.contourArea(hull), cv2.arcLength(hull, True)
    if cv2.contourArea(outline) < MIN_FILL * area:
        return None
    for share in np.arange(0.02, 0.12, 0.01):
        corners = cv2.approxPolyDP(hull, share * around, True)
        if len(corners) <= 4:
            filled = len(corners) == 4 and cv2.contourArea(corners) >= MIN_FILL * area
            return corners[:, 0].astype(np.float64) if filled else None
    return None


def _is_cut(outline: Outline, shape: tuple[int, ...]) -> bool:
    low, high = outline.min(axis=(0, 1)), outline.max(axis=(0, 1))
    return bool(np.any(low == 0) or np.any(high == [shape[1] - 1, shape[0] - 1]))


def _reject(outline: Outline, reason: str) -> Rejected:
    x, y = outline.mean(axis=(0, 1))
    return Rejected(float(x), float(y), reason)


# --- the grid --------------------------------------------------------------------------------------------------------


def _lattice(quads: list[_Quad], step: float | None) -> dict[Cell, int]:
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


def _links(quads: list[_Quad], step: float | None) -> list[set[int]]:
    """For each quadrilateral, its neighbours: nearest along one of its axes, at the usual step, and the same back."""
    if not quads:
        return []
    centres = np.array([q.centre for q in quads])
    nearest = [_nearest_along(quad, centres) for quad in quads]
    mutual = [(k, j, a) for k, found in enumerate(nearest) for j, a in found.items() if k in nearest[j]]
    usual = step or float(np.median([a for _, _, a in mutual])) if mutual else 1.0
    steady = {(k, j) for k, j, a in mutual if abs(a / usual - 1) < STEP_TOLERANCE}
    return [{j for j in nearest[k] if {(k, j), (j, k)} <= steady} for k in range(len(quads))]


def _nearest_along(quad: _Quad, centres: FloatArray) -> dict[int, float]:
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


def _spread_out(first: int, quads: list[_Quad], links: list[set[int]]) -> dict[Cell, int]:
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
    cells: dict[Cell, int], columns: int, rows: int, quads: list[_Quad], rejected: list[Rejected]
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
    cells: dict[Cell, int], columns: int, rows: int, count: int, quads: list[_Quad], rejected: list[Rejected]
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


def _missing(cells: dict[Cell, int], quads: list[_Quad]) -> str:
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


def _centroids(image: Image, mask: Mask, quads: list[_Quad]) -> tuple[FloatArray, FloatArray]:
    """Area centroids (n, 2) px and areas (n,) px^2 of quadrilaterals, by how much of each pixel they cover."""
    kernel = np.ones((2 * RIM_PX + 1, 2 * RIM_PX + 1), np.uint8)
    dark = cv2.dilate(mask, kernel) == 0
    black_dn = float(np.median(image[dark])) if dark.any() else float(image.min())
    found = [_centroid(image, dark, black_dn, quad) for quad in quads]
    return np.array([xy for xy, _ in found]), np.array([area for _, area in found])


def _centroid(image: Image, dark: Chosen, black_dn: float, quad: _Quad) -> tuple[FloatArray, float]:
    """Centroid (2,) px and area px^2: inside counts fully, the blurred rim by its grey level between black and white.

    White is a plane through the inside, since the board may be lit aslant; black is the dark just around the square.
    """
    low = np.maximum(quad.outline.min(axis=(0, 1)) - 2 * RIM_PX, 0)
    high = quad.outline.max(axis=(0, 1)) + 2 * RIM_PX + 1
    window = (slice(low[1], high[1]), slice(low[0], high[0]))
    grey = image[window].astype(np.float64)
    filled = np.zeros(grey.shape, np.uint8)
    cv2.drawContours(filled, [quad.outline], -1, 1, cv2.FILLED, offset=(-int(low[0]), -int(low[1])))
    square = np.ones((3, 3), np.uint8)
    inside = cv2.erode(filled, square, iterations=RIM_PX - 1, borderValue=0) > 0
    reach = cv2.dilate(filled, square, iterations=RIM_PX) > 0
    around = dark[window]
    black = float(np.median(grey[around])) if np.count_nonzero(around) > MIN_AREA_PX else black_dn
    white = _white(grey, filled > 0, inside)
    cover = np.where(inside, 1.0, np.where(reach, (grey - black) / np.maximum(white - black, 1.0), 0.0))
    y, x = np.indices(grey.shape)
    area = float(cover.sum())
    return np.array([np.sum(cover * x), np.sum(cover * y)]) / area + low, area


def _white(grey: FloatArray, filled: Chosen, inside: Chosen) -> FloatArray:
    """The square's own brightness everywhere (h, w): a plane through its inside, or its peak where there is none."""
    if np.count_nonzero(inside) < MIN_AREA_PX:
        return np.full(grey.shape, np.percentile(grey[filled], 90))
    y, x = np.indices(grey.shape)
    terms = np.stack([np.ones_like(grey), x, y], axis=-1)
    plane = np.linalg.lstsq(terms[inside], grey[inside], rcond=None)[0]
    return np.asarray(terms @ plane)
