"""The calibration file, version 1: YAML that this program and others write, and that is read strictly.

``read`` gives the geometry the stages use; ``write`` puts one there so that a reader finds the old file or the new one.
"""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, Self

import yaml
from pydantic import ConfigDict, Field, PositiveFloat, PositiveInt, ValidationError, field_validator, model_validator

from firmware_bridge import whole_file
from firmware_bridge.strict import Strict
from inspector import calibration_proof, yaml_document
from inspector.model import CAMERA_PARAMETERS, FloatArray

if TYPE_CHECKING:  # a start looks a file through before it serves registers, and works with arrays after
    from inspector import optics

ROTATION_ROUNDING = 1e-5
"""How far R R^T may be from the unit matrix: entries of six decimals give 2e-6."""
UNIT_ROUNDING = 1e-3
"""How far a direction's length may be from one: entries of three decimals give 9e-4."""
NOTHING_OPPOSITE = "the camera looks straight down, so nothing is opposite it; give light.azimuth_deg"


class CalibrationError(ValueError):
    """A calibration file cannot be used; the message has one line for each problem, with YAML path and value."""


class _Finite(Strict):
    model_config = ConfigDict(allow_inf_nan=False)


Vector = Annotated[list[float], Field(min_length=3, max_length=3)]
Pixel = Annotated[list[float], Field(min_length=2, max_length=2)]
Matrix = Annotated[list[Vector], Field(min_length=3, max_length=3)]


class CameraEntry(_Finite):
    """Key ``camera``."""

    model: Literal["tsai"]
    """Camera model: tsai (one radial coefficient, from the distorted to the undistorted sensor plane)."""
    width_px: PositiveInt
    """Frame width, pixels."""
    height_px: PositiveInt
    """Frame height, pixels."""
    f_mm: PositiveFloat
    """Effective focal length, mm."""
    kappa1_per_mm2: float
    """Radial distortion, 1/mm^2."""
    sx: PositiveFloat
    """Horizontal scale uncertainty; 1 for digital cameras."""
    cx_px: float
    """Image centre, x, pixels."""
    cy_px: float
    """Image centre, y, pixels."""
    dx_mm: PositiveFloat
    """Pixel pitch in x, mm."""
    dy_mm: PositiveFloat
    """Pixel pitch in y, mm."""
    rotation: Matrix
    """World to camera, three rows."""
    translation_mm: Vector
    """World to camera, mm."""

    @field_validator("rotation")
    @classmethod
    def _is_rotation(cls, rows: list[list[float]]) -> list[list[float]]:
        away, determinant = calibration_proof.off_orthonormal(rows), calibration_proof.determinant(rows)
        if not (away <= ROTATION_ROUNDING and determinant > 0):
            raise ValueError(
                f"not a rotation (R R^T is off the unit matrix by {away:.2g}, determinant {determinant:.6g});"
                " allowed: orthonormal, right-handed, rounded to six decimals or finer"
            )
        return rows

    @model_validator(mode="after")
    def _looks_at_the_front(self) -> Self:
        height_mm = calibration_proof.height_mm(self.rotation, self.translation_mm)
        if not height_mm > 0:
            raise ValueError(
                f"rotation and translation_mm put the camera at z = {height_mm:.6g} mm; allowed: above the panel, z > 0"
            )
        return self

    def to_camera(self) -> optics.Camera:
        """The camera that the stages use."""
        import numpy as np

        from inspector import optics

        values = self.model_dump(exclude={"model", "rotation", "translation_mm"})
        rotation, translation_mm = np.array(self.rotation, np.float64), np.array(self.translation_mm, np.float64)
        return optics.Camera(**values, rotation=rotation, translation_mm=translation_mm)


class LightEntry(_Finite):
    """Key ``light``: exactly one of ``direction``, ``alpha_deg`` (with or without ``azimuth_deg``), ``position_mm``."""

    direction: Vector | None = None
    """Unit vector from the panel to a lamp far away."""
    alpha_deg: float | None = Field(None, ge=0, lt=90)
    """Angle of a lamp far away from the panel's normal, degrees."""
    azimuth_deg: float | None = Field(None, ge=-360, le=360)
    """Direction of the lamp along the panel, degrees from x towards y; null: opposite the camera."""
    position_mm: Vector | None = None
    """Where a near lamp is, mm."""
    angular_sigma_deg: float | None = Field(None, ge=0, le=90)
    """Angular size of the lamp (standard deviation), degrees; null: not known."""

    @field_validator("direction")
    @classmethod
    def _is_unit(cls, direction: list[float] | None) -> list[float] | None:
        if direction is not None:
            length = math.hypot(*direction)
            if not (abs(length - 1) <= UNIT_ROUNDING and direction[2] > 0):
                raise ValueError(f"length {length:.6g}, z {direction[2]:.6g}; allowed: length 1, z > 0 (panel to lamp)")
        return direction

    @field_validator("position_mm")
    @classmethod
    def _is_above(cls, position: list[float] | None) -> list[float] | None:
        if position is not None and not position[2] > 0:
            raise ValueError("the lamp is not above the panel; allowed: z > 0")
        return position

    @model_validator(mode="after")
    def _is_one(self) -> Self:
        given = [key for key in ("direction", "alpha_deg", "position_mm") if getattr(self, key) is not None]
        if len(given) != 1:
            raise ValueError(
                f"{' and '.join(given) or 'nothing'} given; allowed: exactly one of direction, alpha_deg, position_mm"
            )
        if self.azimuth_deg is not None and self.alpha_deg is None:
            raise ValueError("azimuth_deg without alpha_deg; allowed: both, or alpha_deg alone")
        return self

    def to_light(self, camera: optics.Camera) -> optics.Light:
        """The lamp that the stages use; ``camera`` says what is opposite it."""
        import numpy as np

        from inspector import optics

        if self.position_mm is not None:
            return optics.Light(None, np.array(self.position_mm, dtype=np.float64), self.angular_sigma_deg)
        if self.direction is not None:
            direction = np.array(self.direction, dtype=np.float64)
            length = np.linalg.norm(direction)
            # A direction that is unit but for its last bit stays as it is, so that a file survives a round trip.
            return optics.Light(
                direction if abs(length - 1) < 1e-12 else direction / length, None, self.angular_sigma_deg
            )
        assert self.alpha_deg is not None
        return optics.Light(lamp_direction(camera, self.alpha_deg, self.azimuth_deg), None, self.angular_sigma_deg)


class SensorEntry(_Finite):
    """Key ``sensor``."""

    gamma: PositiveFloat = 1.0
    """Exponent of the sensor's response; 1 is linear."""
    black_dn: float | None = Field(None, ge=0)
    """Grey value without light, DN; null: estimated from each frame."""
    saturation_dn: PositiveFloat = 255.0
    """Grey value at which the sensor clips, DN."""

    @model_validator(mode="after")
    def _has_range(self) -> Self:
        if self.black_dn is not None and not self.black_dn < self.saturation_dn:
            raise ValueError(f"black_dn {self.black_dn:g}; allowed: less than saturation_dn {self.saturation_dn:g}")
        return self


class UncertaintyEntry(_Finite):
    """Key ``uncertainty``: the covariance of the fitted parameters, as ``optics.Camera.perturbed`` defines them."""

    parameters: list[str] = Field(min_length=1)
    """Names of the rows, of model.CAMERA_PARAMETERS."""
    covariance: list[list[float]]
    """Symmetric matrix, in the parameters' units."""

    @field_validator("parameters")
    @classmethod
    def _are_known(cls, names: list[str]) -> list[str]:
        if len(set(names)) != len(names) or not set(names) <= set(CAMERA_PARAMETERS):
            raise ValueError(f"allowed: each at most once of {', '.join(CAMERA_PARAMETERS)}")
        return names

    @model_validator(mode="after")
    def _is_covariance(self) -> Self:
        n = len(self.parameters)
        if [len(row) for row in self.covariance] != [n] * n:
            raise ValueError(f"covariance is not {n} x {n}; allowed: one row and one column for each parameter")
        if not calibration_proof.is_covariance(self.covariance):
            raise ValueError("covariance is not one; allowed: symmetric, without negative eigenvalues")
        return self


class PointResidual(_Finite):
    """One point of a fit: where it is, where it was seen, and by how much that is off its prediction."""

    world_mm: Vector
    """The point in the world, mm."""
    seen_px: Annotated[list[float], Field(min_length=2, max_length=2)]
    """Where it was seen, pixels."""
    residual_px: Annotated[list[float], Field(min_length=2, max_length=2)]
    """Seen less predicted, pixels."""


class Residuals(_Finite):
    """Key ``residuals``: what the fit left over; kept for people, not used."""

    method: Literal["reprojection", "tsai"]
    """How the camera was fitted."""
    mean_px: float
    """Mean distance between seen and predicted, pixels."""
    rms_px: float
    """Root mean square of that distance, pixels."""
    largest_px: float
    """Largest of those distances, pixels."""
    points: list[PointResidual]
    """Every point of the fit."""


class CalibrationFile(_Finite):
    """A whole calibration file, version 1."""

    version: Literal[1]
    """Version of the file's form."""
    camera: CameraEntry
    """The camera, its lens and where it stands."""
    light: LightEntry
    """Where the lamp is."""
    view_angle_deg: float | None = Field(None, gt=0, lt=90)
    """Nominal view angle beta that the thesis' method uses, degrees; null: the camera's own."""
    sensor: SensorEntry = SensorEntry.default()
    """How light becomes grey values."""
    """How grey values follow from light."""
    height_gain: PositiveFloat = 1.0
    """Factor on every height, fitted from measured samples."""
    uncertainty: UncertaintyEntry | None = None
    """How well the fit knows the camera; null when it was not fitted here."""
    residuals: Residuals | None = None
    """What the fit left over; null when it was not fitted here."""

    @model_validator(mode="after")
    def _knows_opposite(self) -> Self:
        by_opposite = self.light.alpha_deg is not None and self.light.azimuth_deg is None
        if by_opposite and not calibration_proof.opposite_is_known(self.camera.rotation):
            raise ValueError(NOTHING_OPPOSITE)
        return self

    def to_calibration(self) -> optics.Calibration:
        """The geometry that the stages use."""
        import numpy as np

        from inspector import optics

        camera, fitted = self.camera.to_camera(), self.uncertainty
        return optics.Calibration(
            camera=camera,
            light=self.light.to_light(camera),
            view_angle_deg=camera.view_angle_deg if self.view_angle_deg is None else self.view_angle_deg,
            sensor=optics.Sensor(**self.sensor.model_dump()),
            height_gain=self.height_gain,
            covariance=np.array(fitted.covariance) if fitted else None,
            covariance_of=tuple(fitted.parameters) if fitted else (),
        )


def lamp_direction(camera: optics.Camera, alpha_deg: float, azimuth_deg: float | None = None) -> FloatArray:
    """Unit vector (3,) from the panel to a lamp ``alpha_deg`` off its normal; by default opposite the camera.

    ``azimuth_deg`` is counted from x towards y. Opposite the camera is where the optical axis goes along the panel;
    raises ValueError where the camera looks straight down, for then nothing is opposite.
    """
    import numpy as np

    if azimuth_deg is None and not calibration_proof.opposite_is_known(camera.rotation.tolist()):
        raise ValueError(NOTHING_OPPOSITE)
    along = camera.rotation[2, :2]
    azimuth = np.arctan2(along[1], along[0]) if azimuth_deg is None else np.radians(azimuth_deg)
    alpha = np.radians(alpha_deg)
    return np.array([np.sin(alpha) * np.cos(azimuth), np.sin(alpha) * np.sin(azimuth), np.cos(alpha)])


def load(path: Path) -> CalibrationFile:
    """The file as written, residuals and all. Raises CalibrationError with every problem at once."""
    return _entry(yaml_document.read(path))


def parse(text: str, source: str) -> optics.Calibration:
    """The geometry in a calibration file's text; ``source`` names it in problems. Raises CalibrationError."""
    return _entry(yaml_document.parse(text, source)).to_calibration()


def _entry(document: yaml_document.Document) -> CalibrationFile:
    entry, problems = yaml_document.validate(document, CalibrationFile)
    if entry is None or problems:
        lines = "\n".join(map(str, problems))
        raise CalibrationError(f"{document.source} is not a calibration file, version 1:\n{lines}")
    return entry


def read(path: Path) -> optics.Calibration:
    """The geometry in a calibration file. Raises CalibrationError with every problem at once."""
    return load(path).to_calibration()


def write(path: Path, calibration: optics.Calibration, residuals: Residuals | None = None) -> None:
    """Put a calibration at ``path``, whole or not at all.

    Raises OSError, and CalibrationError for a calibration that could not be read back.
    """
    try:
        entry = CalibrationFile.model_validate(_document(calibration) | {"residuals": residuals})
    except ValidationError as error:
        raise CalibrationError(f"no calibration to write: {error}") from error
    save(path, entry)


def save(path: Path, entry: CalibrationFile) -> None:
    """Put a calibration file's content at ``path``, whole or not at all. Raises OSError."""
    text = yaml.safe_dump(
        entry.model_dump(mode="json", exclude_none=True), sort_keys=False, default_flow_style=None, width=120
    )
    whole_file.write(path, text)


def _document(calibration: optics.Calibration) -> dict[str, object]:
    """A calibration as the file's plain mappings, lists and numbers."""
    camera, light, fitted = calibration.camera, calibration.light, calibration.covariance
    arrays = {"rotation": camera.rotation.tolist(), "translation_mm": camera.translation_mm.tolist()}
    return {
        "version": 1,
        "camera": {"model": "tsai", **_fields(camera), **arrays},
        "light": {
            "direction": None if light.direction is None else light.direction.tolist(),
            "position_mm": None if light.position_mm is None else light.position_mm.tolist(),
            "angular_sigma_deg": light.angular_sigma_deg,
        },
        "view_angle_deg": calibration.view_angle_deg,
        "sensor": _fields(calibration.sensor),
        "height_gain": calibration.height_gain,
        "uncertainty": None
        if fitted is None
        else {"parameters": list(calibration.covariance_of), "covariance": fitted.tolist()},
    }


def _fields(noun: optics.Camera | optics.Sensor) -> dict[str, object]:
    return {field.name: getattr(noun, field.name) for field in dataclasses.fields(noun)}
