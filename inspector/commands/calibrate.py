"""The command `inspector calibrate`: points or a board's image in, a calibration file, tables and a picture out."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from inspector import calibration_file, csv_table, imagefile, optics
from inspector.csv_table import InputRefused
from inspector.estimate.calibration import BoardRefused, Fit, Method, Points, SensorConstants, angles_deg, fit
from inspector.estimate.height_gain import SamplesRefused
from inspector.model import CAMERA_PARAMETERS, FloatArray, Image

COLUMNS = ("xw_mm", "yw_mm", "zw_mm", "Xf_px", "Yf_px")
"""Columns that a file of points must have, in any order and among others."""
TABLE_5_1 = SensorConstants()
"""The thesis' sensor, the default."""
REFUSALS = (
    InputRefused, BoardRefused, SamplesRefused, imagefile.FrameUnreadable, calibration_file.CalibrationError, OSError
)  # fmt: skip
"""All that the command refuses with a message and no traceback."""


@dataclass(frozen=True)
class BoardOptions:
    """What is known of a board. ``square_mm`` None: found from the squares' areas."""

    pitch_mm: float
    columns: int
    rows: int
    square_mm: float | None = None


@dataclass(frozen=True)
class SensorOptions:
    """Sensor constants as asked for. None: the image's size, or Table 5.1's; the centre is half the size."""

    width_px: int | None = None
    height_px: int | None = None
    dx_mm: float = TABLE_5_1.dx_mm
    dy_mm: float = TABLE_5_1.dy_mm
    cx_px: float | None = None
    cy_px: float | None = None
    sx: float = TABLE_5_1.sx

    def constants(self, width_px: int, height_px: int) -> SensorConstants:
        """The constants, with a size for where none was asked for. Raises InputRefused."""
        size = [("width_px", self.width_px or width_px), ("height_px", self.height_px or height_px)]
        scale = [("dx_mm", self.dx_mm), ("dy_mm", self.dy_mm), ("sx", self.sx)]
        problems = [
            f"--{name.replace('_', '-')} {value:g}" for name, value in [*size, *scale] if not 0 < value < np.inf
        ]
        if problems:
            raise InputRefused(f"{', '.join(problems)}: allowed: above 0")
        width, height = size[0][1], size[1][1]
        cx = width / 2 if self.cx_px is None else self.cx_px
        cy = height / 2 if self.cy_px is None else self.cy_px
        return SensorConstants(width, height, self.dx_mm, self.dy_mm, cx, cy, self.sx)


@dataclass(frozen=True)
class Outcome:
    """A fit with what its picture and report need: names of the points, the image, and remarks."""

    fit: Fit
    names: tuple[str, ...]
    image: Image
    remarks: tuple[str, ...] = ()


@contextmanager
def refusals() -> Iterator[None]:
    """Turn whatever the command refuses into its message on standard error and exit status 1."""
    try:
        yield
    except REFUSALS as error:
        raise SystemExit(f"error: {error}") from error


def check_sources(points: Path | None, board: Path | None, heights: Path | None, calibration: Path | None) -> None:
    """Refuse all but one thing to calibrate from. Raises InputRefused."""
    if sum(given is not None for given in (points, board, heights)) != 1:
        raise InputRefused("give exactly one of --points FILE.csv, --board IMAGE and --heights FILE.csv")
    if (heights is None) != (calibration is None):
        raise InputRefused(
            "--heights FILE.csv and --calibration IN.yaml go together: the samples' frames and their camera"
        )


def source(
    points: Path | None,
    board: Path | None,
    pitch_mm: float | None,
    columns: int | None,
    rows: int | None,
    square_mm: float | None,
) -> Path | tuple[Path, BoardOptions]:
    """What to calibrate from, as the options say. Raises InputRefused."""
    if points is not None:
        return points
    assert board is not None
    if pitch_mm is None or columns is None or rows is None:
        raise InputRefused("--board needs --pitch-mm, --columns and --rows of the board")
    if not pitch_mm > 0 or (square_mm is not None and not 0 < square_mm < pitch_mm):
        raise InputRefused("allowed: --pitch-mm above 0, --square-mm above 0 and below the pitch")
    return board, BoardOptions(pitch_mm, columns, rows, square_mm)


def run(source: Path | tuple[Path, BoardOptions], sensor: SensorOptions, method: Method) -> Outcome:
    """Calibrate from a file of points, or from a board's image.

    Raises InputRefused, BoardRefused, imagefile.FrameUnreadable.
    """
    if isinstance(source, Path):
        return from_points(source, sensor.constants(TABLE_5_1.width_px, TABLE_5_1.height_px), method)
    image = imagefile.read(source[0])
    height, width = image.shape
    if sensor.width_px not in (None, width) or sensor.height_px not in (None, height):
        raise InputRefused(
            f"{source[0]}: {width} x {height} pixels, but --width-px and --height-px say {sensor.width_px or width} x"
            f" {sensor.height_px or height}: take the image with the whole sensor, or leave them out"
        )
    return from_board(image, source[1], sensor.constants(width, height), method)


def from_points(path: Path, sensor: SensorConstants, method: Method) -> Outcome:
    """Calibrate from a file of points. Raises InputRefused, BoardRefused."""
    fitted = fit(read_points(path), sensor, method)
    blank = np.zeros((sensor.height_px, sensor.width_px), np.uint8)
    return Outcome(fitted, tuple(str(n + 1) for n in range(len(fitted.points))), blank)


def from_board(image: Image, board: BoardOptions, sensor: SensorConstants, method: Method) -> Outcome:
    """Calibrate from a board's image (H, W). Raises BoardRefused."""
    from inspector.estimate.board import find
    from inspector.estimate.squares import fit_squares

    found = find(image, board.pitch_mm, board.columns, board.rows, board.square_mm)
    fitted = fit_squares(found.squares, sensor, method)
    names = tuple(f"{i},{j}" for i in range(1, board.columns + 1) for j in range(1, board.rows + 1))
    whence = "found from their areas" if board.square_mm is None else "as given"
    remarks = (f"squares of {fitted.side_mm:.3f} mm, {whence}", *(f"left out: {r}" for r in found.rejected))
    return Outcome(fitted.fit, names, image, remarks)


def read_points(path: Path) -> Points:
    """The points in a CSV file with the columns :data:`COLUMNS`. Raises InputRefused with every problem at once."""
    table = np.array(csv_table.numbers(path, COLUMNS, csv_table.read(path, COLUMNS))).reshape(-1, len(COLUMNS))
    return Points(table[:, :3], table[:, 3:])


def calibration(
    fitted: Fit, alpha_deg: float, azimuth_deg: float | None, view_angle_deg: float | None
) -> optics.Calibration:
    """The fit with its lamp and nominal view angle (None: the camera's own), for the stages. Raises InputRefused."""
    camera = fitted.camera
    if not 0 <= alpha_deg < 90:
        raise InputRefused(f"--alpha-deg {alpha_deg:g}: allowed: from 0 to below 90, from the panel's normal")
    if view_angle_deg is not None and not 0 < view_angle_deg < 90:
        raise InputRefused(f"--view-angle-deg {view_angle_deg:g}: allowed: between 0 and 90, from the panel's normal")
    return optics.Calibration(
        camera=camera,
        light=optics.Light(calibration_file.lamp_direction(camera, alpha_deg, azimuth_deg)),
        view_angle_deg=camera.view_angle_deg if view_angle_deg is None else view_angle_deg,
        covariance=fitted.covariance,
        covariance_of=CAMERA_PARAMETERS,
    )


def residuals(fitted: Fit) -> calibration_file.Residuals:
    """What the fit left over, as the file keeps it."""
    away, seen = fitted.distances_px, zip(fitted.points.world_mm, fitted.points.xy_px, fitted.residuals_px, strict=True)
    return calibration_file.Residuals(
        method=fitted.method,
        mean_px=float(np.mean(away)),
        rms_px=float(np.sqrt(np.mean(away**2))),
        largest_px=float(np.max(away)),
        points=[
            calibration_file.PointResidual(world_mm=w.tolist(), seen_px=p.tolist(), residual_px=r.tolist())
            for w, p, r in seen
        ],
    )


def save(output: Path, outcome: Outcome, geometry: optics.Calibration, overlay: Path) -> None:
    """Write the picture, then the calibration file. Raises InputRefused, OSError."""
    _write_overlay(overlay, outcome)
    calibration_file.write(output, geometry, residuals(outcome.fit))


# --- report ----------------------------------------------------------------------------------------------------------


def report(outcome: Outcome) -> str:
    """Parameters with uncertainties, the verification table (Table 5.4's form) and the residuals, as text."""
    fitted = outcome.fit
    title = f"Calibration by {fitted.method}, {len(fitted.points)} points"
    return "\n".join(
        [title, *outcome.remarks, "", *_parameters(fitted), "", *_verification(outcome), "", *_left(outcome)]
    )


def _parameters(fitted: Fit) -> Iterator[str]:
    camera = fitted.camera
    sigma = np.sqrt(np.diag(fitted.covariance))
    yield f"{'parameter':<16}{'value':>14}{'std. uncertainty':>18}"
    yield f"{'f_mm':<16}{camera.f_mm:14.6f}{sigma[6]:18.2g}"
    yield f"{'kappa1_per_mm2':<16}{camera.kappa1_per_mm2:14.8f}{sigma[7]:18.2g}"
    for name, value, s in zip(("Tx_mm", "Ty_mm", "Tz_mm"), camera.translation_mm, sigma[3:6], strict=True):
        yield f"{name:<16}{value:14.6f}{s:18.2g}"
    for name, value, s in zip(
        ("Rx_deg", "Ry_deg", "Rz_deg"), angles_deg(camera.rotation), _angle_sigmas(fitted), strict=True
    ):
        yield f"{name:<16}{value:14.6f}{s:18.2g}"
    x, y, z = camera.centre_mm
    yield f"camera at ({x:.2f}, {y:.2f}, {z:.2f}) mm; view angle {camera.view_angle_deg:.3f} deg from the normal"


def _angle_sigmas(fitted: Fit) -> FloatArray:
    """Standard uncertainties (3,), degrees, of Rx, Ry, Rz, which follow from the rotation vector's."""
    step = 1e-6
    base = np.array(angles_deg(fitted.camera.rotation))
    moved = [angles_deg(fitted.camera.perturbed(step * np.eye(8)[k]).rotation) for k in range(3)]
    jacobian = (np.array(moved) - base).T / step
    return np.sqrt(np.diag(jacobian @ fitted.covariance[:3, :3] @ jacobian.T))


def _verification(outcome: Outcome) -> Iterator[str]:
    fitted = outcome.fit
    nominal, computed, error = fitted.points.world_mm, fitted.computed_mm, fitted.percent_errors
    yield f"{'point':>6}" + "".join(f"{f'{c} nominal_mm':>14}{'computed_mm':>13}{'error_%':>10}" for c in "xy")
    for name, n, c, e in zip(outcome.names, nominal, computed, error, strict=True):
        yield f"{name:>6}" + "".join(f"{n[k]:14.4f}{c[k]:13.4f}{_percent(e[k]):>10}" for k in (0, 1))
    mean = [float(np.mean(column[np.isfinite(column)])) if np.isfinite(column).any() else np.nan for column in error.T]
    yield f"{'mean':>6}" + "".join(f"{'':14}{'':13}{_percent(value):>10}" for value in mean)


def _percent(value: float) -> str:
    return f"{value:.4f}" if np.isfinite(value) else "-"


def _left(outcome: Outcome) -> Iterator[str]:
    left = residuals(outcome.fit)
    worst = outcome.names[int(np.argmax(outcome.fit.distances_px))]
    yield f"reprojection: mean {left.mean_px:.4f} px, rms {left.rms_px:.4f} px"
    yield f"largest residual {left.largest_px:.4f} px, point {worst}"


# --- picture ---------------------------------------------------------------------------------------------------------


def _write_overlay(path: Path, outcome: Outcome) -> None:
    import cv2

    from inspector.estimate.calibration_overlay import draw

    suffix = path.suffix or ".png"
    try:
        _, data = cv2.imencode(suffix, draw(outcome.image, outcome.fit, outcome.names))
    except cv2.error as error:
        raise InputRefused(f"{path}: no picture format is called {suffix!r}; end the name in .png") from error
    path.write_bytes(data.tobytes())
