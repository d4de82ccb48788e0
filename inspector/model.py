"""The nouns that pass from stage to stage: frozen, with their units in their names.

World frame: the panel is the plane z = 0, z points out of the paint towards the camera, millimetres.
Image frame: pixel centres lie on integers, (0, 0) is the centre of the top-left pixel, x right, y down, pixels.
Grey values are digital numbers (DN) as the sensor gave them. Heights that leave the program are micrometres.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, TypeAlias

from inspector.line_statistics import Statistics

if TYPE_CHECKING:  # registers are served by these nouns before there are arrays
    import numpy as np
    import numpy.typing as npt

FloatArray: TypeAlias = "npt.NDArray[np.float64]"
IntArray: TypeAlias = "npt.NDArray[np.intp]"
Image: TypeAlias = "npt.NDArray[np.uint8] | npt.NDArray[np.uint16]"

CAMERA_PARAMETERS = (
    "rotation_x_rad",
    "rotation_y_rad",
    "rotation_z_rad",
    "translation_x_mm",
    "translation_y_mm",
    "translation_z_mm",
    "f_mm",
    "kappa1_per_mm2",
)
"""What a fit adjusts in a camera, as :meth:`inspector.optics.Camera.perturbed` takes it; a covariance is of these."""


class Verdict(enum.IntEnum):
    """What the line is told of a frame or a panel. Zero is no verdict, so a zeroed register is never a PASS."""

    NOT_INSPECTED = 0
    PASS = 1
    FAIL = 2


class Reason(enum.IntFlag):
    """Why a verdict is what it is; each name is one bit of the PLC's reason word."""

    HEIGHT_LIMIT = 1 << 0
    HEIGHT_WITHIN_GUARD_BAND = 1 << 1
    COUNT_LIMIT = 1 << 2
    DENSITY_LIMIT = 1 << 3
    ZONE_LIMIT = 1 << 4
    UNPAIRED_LIMIT = 1 << 5
    UNMEASURED_SEED = 1 << 6
    PANEL_INCOMPLETE = 1 << 7
    FRAME_UNREADABLE = 1 << 8
    FRAME_WRONG_SHAPE = 1 << 9
    FRAME_BLACK = 1 << 10
    FRAME_OVERLIT = 1 << 11
    TOO_MANY_HIGHLIGHTS = 1 << 12
    DEVICE_FAULT = 1 << 13
    EXPOSURE_NOT_AS_SET = 1 << 14
    LAMP_NOT_AS_SET = 1 << 15


class Flag(enum.IntFlag):
    """What is unusual about a highlight, a pair or a defect."""

    SATURATED = 1 << 0
    MERGED = 1 << 1
    AT_EDGE = 1 << 2
    TOO_SMALL = 1 << 3
    TOO_LARGE = 1 << 4
    HOT_PIXEL = 1 << 5
    INCONSISTENT = 1 << 6
    PAINT_POOL = 1 << 7
    PARTNER_OUTSIDE_FRAME = 1 << 8
    PARTNER_HIDDEN = 1 << 9
    DUST = 1 << 10
    AMBIGUOUS = 1 << 11
    FAINT = 1 << 12
    TOUCHING = 1 << 13
    SUNK = 1 << 14
    CROWDED = 1 << 15
    """In a tangle of spots too large to be fitted: where it is, is known to half a pixel only."""

    def names(self) -> tuple[str, ...]:
        """The set flags' names in lower case, lowest bit first."""
        return tuple(str(f.name).lower() for f in Flag if f in self)


class State(enum.IntEnum):
    """Station states, named as in OPC 40100-1 (machine vision), section 8."""

    PREOPERATIONAL = 0
    INITIALIZED = 1
    READY = 2
    SINGLE_EXECUTION = 3
    CONTINUOUS_EXECUTION = 4
    HALTED = 5
    ERROR = 6


@dataclass(frozen=True, slots=True)
class Frame:
    """One grey image with what it was really taken at.

    ``image`` is (H, W) uint8 or uint16; ``exposure_us`` and ``lamp_v`` are as read back, None when not known.
    """

    image: Image
    name: str
    frame_id: int = 0
    exposure_us: float | None = None
    lamp_v: float | None = None
    taken_at_s: float = 0.0
    """Unix time of the exposure, seconds; for records."""
    taken_s: float = 0.0
    """The same on the machine's monotonic clock, seconds; for travel."""


@dataclass(frozen=True, slots=True)
class Highlights:
    """The bright spots of one frame, as arrays of one row a spot, brightest part of the image first to last row.

    ``xy_px`` (n, 2); ``covariance_px2`` (n, 2, 2) of the centroid; ``flux_dn`` (n,) sum over the local background,
    with ``flux_sigma`` (n,) the standard deviation of its logarithm;
    ``peak_dn`` (n,) largest grey value over the background; ``area_px`` (n,); ``flags`` (n,) of :class:`Flag`.
    ``binary_px`` (n, 2) is the plain centroid of the lit pixels of the spot's component, as the thesis took it;
    ``blur_px2`` (n, 3) the covariance xx, xy, yy of the spot's own shape.
    """

    xy_px: FloatArray
    covariance_px2: FloatArray
    flux_dn: FloatArray
    flux_sigma: FloatArray
    peak_dn: FloatArray
    area_px: IntArray
    flags: IntArray
    binary_px: FloatArray
    blur_px2: FloatArray
    threshold_dn: float = 0.0
    background_dn: float = 0.0
    noise_dn: float = 0.0
    full_scale_dn: float = 255.0
    """Where the sensor clips, as far as the frame tells."""

    def __len__(self) -> int:
        return len(self.xy_px)


@dataclass(frozen=True, slots=True)
class HighlightPairs:
    """Which highlight is a seed's direct spot and which its mirror: indices into :class:`Highlights`.

    ``direct`` and ``mirror`` (k,); ``unpaired`` (m,) with ``unpaired_flags`` (m,) saying what each may be;
    ``flags`` (k,). ``rays`` (n, 9) are the viewing rays of all n highlights, as :func:`inspector.reflection.rays` gives
    them: pairing needs them, and heights again.
    """

    direct: IntArray
    mirror: IntArray
    unpaired: IntArray
    flags: IntArray
    unpaired_flags: IntArray
    rays: FloatArray


@dataclass(frozen=True, slots=True)
class Defect:
    """A seed: where it stands on the panel and how high it is. ``height_sigma_um`` is None if the method has none."""

    x_mm: float
    y_mm: float
    height_um: float
    height_sigma_um: float | None
    direct_px: tuple[float, float]
    mirror_px: tuple[float, float]
    flags: Flag = Flag(0)
    residual_sigma: float | None = None
    """Residual of the pair's redundant equation over its uncertainty; None if the method has none."""
    sunk_bias_um: float | None = None
    """How far off a seed sunk to half its radius is read; apart from ``height_sigma_um``; None: the method has none."""
    place_sigma_mm: float | None = None
    """Standard deviation of its place, of the larger of x and y; None if the method has none."""


@dataclass(frozen=True, slots=True)
class Unpaired:
    """A highlight that belongs to no pair, and what it may be."""

    x_px: float
    y_px: float
    flags: Flag = Flag(0)


@dataclass(frozen=True, slots=True)
class FrameResult:
    """What one frame says. ``reasons_text`` has one sentence for each reason; empty for a plain PASS."""

    frame: str
    verdict: Verdict
    reasons: Reason = Reason(0)
    reasons_text: tuple[str, ...] = ()
    defects: tuple[Defect, ...] = ()
    unpaired: tuple[Unpaired, ...] = ()
    elapsed_us: float = 0.0
    highlights: Highlights | None = field(default=None, compare=False, repr=False)
    """The spots it was judged by; None where the frame was refused before."""


@dataclass(frozen=True, slots=True)
class PlcSide:
    """What the registers show of the handshake with the PLC (:mod:`inspector.handshake`)."""

    answers: int = 0
    """Bits of :class:`inspector.handshake.Answer`."""
    results_waiting: int = 0
    command_echo: int = 0
    command_result: int = 0
    control: tuple[int, ...] = ()
    """The block's words as they were written; those missing are 0."""


@dataclass(frozen=True, slots=True)
class Extent:
    """What was inspected, in panel coordinates: area (0: not known), the box about it (x_min, y_min, x_max, y_max)
    and the length of its rim."""

    area_m2: float = 0.0
    bounds_mm: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    rim_mm: float = 0.0


@dataclass(frozen=True, slots=True)
class PanelFrame:
    """A frame's part in its panel: what it says, and how far the panel had moved since its first frame, mm."""

    result: FrameResult
    travel_mm: float = 0.0


@dataclass(frozen=True, slots=True)
class PanelFrames:
    """The frames of one panel as they came. ``panel_id`` None: nobody gave one; ``missing`` has a sentence for each
    thing that keeps the panel from having been seen whole."""

    panel_id: int | None = None
    frames: tuple[PanelFrame, ...] = ()
    missing: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class PanelSpot(Unpaired):
    """A highlight that no frame of the panel explains; ``x_mm``, ``y_mm`` is where its ray meets the panel."""

    x_mm: float = float("nan")
    y_mm: float = float("nan")


@dataclass(frozen=True, slots=True)
class PanelResult:
    """What the frames of a panel say together. Places are panel coordinates: those of the world, at the first frame."""

    verdict: Verdict
    reasons: Reason = Reason(0)
    reasons_text: tuple[str, ...] = ()
    defects: tuple[Defect, ...] = ()
    unpaired: tuple[PanelSpot, ...] = ()
    panel_id: int | None = None
    """As the PLC gave it; None if it gave none."""
    travels_mm: tuple[float, ...] = ()
    """Of each frame, how far the panel had moved since its first one."""
    extent: Extent = Extent()
    """What was seen of the panel."""
    elapsed_us: float = 0.0
    """Time the inspections of its frames took."""
    gathered: PanelFrames | None = field(default=None, compare=False, repr=False)
    """The frames it was judged by; None where nobody has said."""


@dataclass(frozen=True, slots=True)
class Snapshot:
    """Everything that the result block of the register map shows, at one moment."""

    state: State = State.PREOPERATIONAL
    fault_code: int = 0
    sequence: int = 0
    acquisition_id: int = 0
    panel_id: int = 0
    panel_frames: int = 1
    """Frames of the panel that the result is of."""
    frames_so_far: int = 0
    """Frames of the panel under way, where panels have several."""
    extent: Extent | None = None
    """What was seen of the panel; None: what one frame sees."""
    recipe_id: int = 0
    verdict: Verdict = Verdict.NOT_INSPECTED
    reasons: Reason = Reason(0)
    defects: tuple[Defect, ...] = ()
    unpaired_count: int = 0
    result_at_s: float | None = None
    """Monotonic time the result was published, seconds; None while there is none."""
    elapsed_us: float = 0.0
    cycle_us: float = 0.0
    response_us: float | None = None
    """From the trigger of the result's last frame until the result was shown; None: not known."""
    panels_passed: int = 0
    panels_failed: int = 0
    panels_not_inspected: int = 0
    missed_triggers: int = 0
    late_triggers: int = 0
    overruns: int = 0
    lamp_set_v: float = 0.0
    lamp_read_v: float = 0.0
    lamp_ok: bool = False
    lamp_weak: bool = False
    """The lamp has used up most of what its level may be raised by: change the bulb soon."""
    camera_ok: bool = False
    exposure_us: float = 0.0
    configuration_hash: int = 0
    recipe_hash: int = 0
    plc: PlcSide = PlcSide()
    operator: PlcSide = PlcSide()
    """The same of the operator's block, which knows commands alone."""
    simulated: bool = False
    settings_refused: bool = False
    store_degraded: bool = False
    """A result that is shown may not be on the disk."""
    store_damaged: bool = False
    """The results' store was damaged and has been set aside; until somebody has seen it."""
    store_waiting: int = 0
    """Entries that wait for the store, while it is degraded."""
    clock_unsynchronised: bool = False
    statistics: Statistics | None = None
    """Of the paint line, after the newest result, also while older ones are shown; None while there are none."""
    statistics_sequence: int = 0
    """Sequence of that result."""
    extra: dict[str, float] = field(default_factory=dict)
