"""Frames of a panel -> one result in panel coordinates, each seed counted once. Pure.

Panel coordinates are the world's at the first frame: a seed that frame k shows at p is on the panel at p - s u, where s
is how far the panel had moved along the unit vector u.

Of several sightings of one seed the best measured is kept, not an average: they share calibration and lamp, so their
errors are not independent, and an average would state too small a sigma.

A panel that was not seen whole is never a PASS. It is a FAIL if what was seen makes it one whatever is in the rest:
measured seeds too high or too many. Otherwise it is NOT_INSPECTED.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from inspector import reflection
from inspector.judge.coverage import View
from inspector.judge.overlap import Sightings, groups
from inspector.judge.verdict import NO_SEED, SURELY_A_SEED, judge
from inspector.model import (
    Defect,
    Extent,
    Flag,
    FloatArray,
    PanelFrames,
    PanelResult,
    PanelSpot,
    Reason,
    Unpaired,
    Verdict,
)
from inspector.optics import Calibration
from inspector.panel_settings import PanelSettings, Travel
from inspector.recipe import Limits

UM_PER_MM = 1000.0
OF_THE_FRAME = Flag.AT_EDGE
"""Flags that tell where a seed lay in its frame: another frame that saw it elsewhere takes them back."""
DOUBTFUL = Flag.AT_EDGE | Flag.MERGED | Flag.INCONSISTENT | Flag.AMBIGUOUS
"""A sighting without any of these is better than one with, whatever their sigmas."""
BOTH_SPOTS = 2
"""Of a seed's spots: 0 direct, 1 mirror, and this where they run into one."""


@dataclass(frozen=True)
class PanelStation:
    """What a panel is judged with: the geometry, the recipe's limits, and how panels are made of frames."""

    calibration: Calibration
    limits: Limits
    settings: PanelSettings

    @property
    def travel(self) -> Travel | None:
        """How the panel moves."""
        return self.settings.travel

    @cached_property
    def direction(self) -> FloatArray:
        """The travel's unit vector (2,) in the world."""
        return np.array(self.travel.direction if self.travel else (1.0, 0.0))

    @cached_property
    def view(self) -> View | None:
        """What a frame sees of the panel."""
        x, y = self.direction.tolist()
        return View.of(self.calibration.camera, (x, y))


@dataclass(frozen=True)
class _Seen:
    """A defect or a lone spot in the frame that shows it; ``thing`` has its frame's coordinates."""

    frame: int
    travel_mm: float
    xy_mm: tuple[float, float]
    """On the panel."""
    thing: Defect | Unpaired


def judge_panel(gathered: PanelFrames, station: PanelStation) -> PanelResult:
    """The panel's result; ``gathered.frames`` may be in any order, and empty."""
    frames = sorted(gathered.frames, key=lambda frame: frame.travel_mm)
    travels_mm = tuple(frame.travel_mm for frame in frames)
    seeds = _seeds(gathered, station)
    lone = _unexplained(gathered, seeds, station)
    defects = tuple(sorted((_merged(group) for group in seeds), key=_highest_first))
    missing, reasons = _missing(gathered, station, travels_mm)
    extent = station.view.seen(travels_mm) if station.view and travels_mm else Extent()
    verdict, why, texts = judge(defects, lone, _certain(station.limits) if missing else station.limits, extent.area_m2)
    if missing and verdict is Verdict.PASS:
        verdict = Verdict.NOT_INSPECTED
    return PanelResult(
        verdict=verdict,
        reasons=reasons | why,
        reasons_text=(*missing, *texts),
        defects=defects,
        unpaired=lone,
        panel_id=gathered.panel_id,
        travels_mm=travels_mm,
        extent=extent,
        elapsed_us=sum(frame.result.elapsed_us for frame in frames),
    )


def sightings(gathered: PanelFrames, station: PanelStation) -> list[tuple[Defect, list[tuple[int, Defect]]]]:
    """Each seed of the panel as its result tells it, highest first, with its sightings: the frame's index, and what
    that frame shows."""
    seeds = [(_merged(group), [(s.frame, _defect(s)) for s in group]) for group in _seeds(gathered, station)]
    return sorted(seeds, key=lambda seed: _highest_first(seed[0]))


def _certain(limits: Limits) -> Limits:
    """The limits that no unseen part of the panel can bring the panel back within."""
    return limits.model_copy(update={"max_per_m2": None, "max_unpaired": None, "unmeasured_seed": "report"})


def _missing(
    gathered: PanelFrames, station: PanelStation, travels_mm: Sequence[float]
) -> tuple[tuple[str, ...], Reason]:
    """What keeps the panel from having been seen whole, as sentences and as bits."""
    texts, reasons = [*gathered.missing], Reason(0)
    for number, frame in enumerate(gathered.frames, 1):
        if frame.result.verdict is Verdict.NOT_INSPECTED:
            reasons |= frame.result.reasons
            texts.append(f"frame {number} of {len(gathered.frames)}: {'; '.join(frame.result.reasons_text)}")
    if len(gathered.frames) < station.settings.needed:
        texts.append(f"{len(gathered.frames)} frames instead of {station.settings.needed}")
    texts += _not_covered(station, travels_mm)
    return tuple(texts), reasons | Reason.PANEL_INCOMPLETE if texts else reasons


def _not_covered(station: PanelStation, travels_mm: Sequence[float]) -> Iterator[str]:
    """What the frames left out between them, and of the area that the panel is known to have."""
    view, area = station.view, station.settings.area
    if not travels_mm:
        return
    if view is None:
        if area is not None or len(travels_mm) > 1:
            yield "the frame is not all on the panel, so what was seen of it is not known"
    elif area is not None:
        unseen = view.unseen_share(area, travels_mm)
        if unseen > 0:
            yield f"{unseen:.1%} of the panel was not seen"
    elif (gap_mm := view.longest_gap_mm(travels_mm)) > 0:
        yield f"{gap_mm:.1f} mm between two frames were not seen"


def _seeds(gathered: PanelFrames, station: PanelStation) -> list[list[_Seen]]:
    """Sightings of each seed, in an order that does not depend on the frames'."""
    sightings = [
        _Seen(n, frame.travel_mm, _on_panel((defect.x_mm, defect.y_mm), frame.travel_mm, station), defect)
        for n, frame in enumerate(gathered.frames)
        for defect in frame.result.defects
    ]
    reach = [_place_reach_mm(_defect(s).place_sigma_mm, station) for s in sightings]
    return _grouped(sightings, reach, station, lambda a, b: _height_difference(_defect(a), _defect(b), station))


def _grouped(
    sightings: list[_Seen], reach_mm: list[float], station: PanelStation, other: Callable[[_Seen, _Seen], float]
) -> list[list[_Seen]]:
    """Sightings of one thing together: by place, and by what ``other`` says of two (above 1: they are not one)."""
    order = sorted(range(len(sightings)), key=lambda n: (sightings[n].travel_mm, sightings[n].xy_mm))
    sorted_, reach = [sightings[n] for n in order], [reach_mm[n] for n in order]
    travels = [s.travel_mm for s in sightings]
    # Travel's uncertainty grows with the distance; the longest there is bounds what is looked at.
    widest_mm = _travel_reach_mm(max(travels) - min(travels), station) if travels else 0.0

    def difference(i: int, j: int) -> float:
        a, b = sorted_[i], sorted_[j]
        allowed_mm = math.hypot(reach[i], reach[j], _travel_reach_mm(b.travel_mm - a.travel_mm, station))
        allowed_mm += station.settings.same_seed.place_mm
        apart_mm = math.dist(a.xy_mm, b.xy_mm)
        if apart_mm > allowed_mm:
            return math.inf
        look = other(a, b)
        return math.inf if look > 1 else ((apart_mm / allowed_mm if allowed_mm else 0.0) + look) / 2

    place_mm = station.settings.same_seed.place_mm
    seen = Sightings(
        [s.frame for s in sorted_],
        np.array([s.xy_mm for s in sorted_]).reshape(-1, 2),
        np.array([r + (widest_mm + place_mm) / 2 for r in reach]),
    )
    return [[sorted_[n] for n in group] for group in groups(seen, difference)]


def _travel_reach_mm(moved_mm: float, station: PanelStation) -> float:
    travel, sigmas = station.travel, station.settings.same_seed.sigmas
    return sigmas * travel.sigma_between_mm(moved_mm) if travel else 0.0


def _place_reach_mm(sigma_mm: float | None, station: PanelStation) -> float:
    """By how much a sighting's own uncertainty lets its place be off, mm."""
    return station.settings.same_seed.sigmas * sigma_mm if sigma_mm is not None and math.isfinite(sigma_mm) else 0.0


def _height_difference(a: Defect, b: Defect, station: PanelStation) -> float:
    """0 for the same height, 1 for as different as one seed's may be; a seed without a height is like any other."""
    if not (math.isfinite(a.height_um) and math.isfinite(b.height_um)):
        return 0.0
    same = station.settings.same_seed
    allowed_um = same.height_share * max(abs(a.height_um), abs(b.height_um))
    sigmas = [d.height_sigma_um for d in (a, b) if d.height_sigma_um is not None and math.isfinite(d.height_sigma_um)]
    allowed_um += same.sigmas * math.hypot(*sigmas)
    apart_um = abs(a.height_um - b.height_um)
    return apart_um / allowed_um if allowed_um > 0 else (0.0 if apart_um == 0 else math.inf)


def _merged(group: Sequence[_Seen]) -> Defect:
    """The best sighting of a seed, at its place on the panel, with what all of them say of it."""
    best = min(group, key=_worse)
    said, always = Flag(0), ~Flag(0)
    for sighting in group:
        said |= sighting.thing.flags
        always &= sighting.thing.flags
    flags = said & ~OF_THE_FRAME | always & OF_THE_FRAME
    return replace(_defect(best), x_mm=best.xy_mm[0], y_mm=best.xy_mm[1], flags=flags)


def _worse(sighting: _Seen) -> tuple[object, ...]:
    """Sorts the best sighting first: with a height, without doubts, of the smallest sigma; then the higher one."""
    defect = _defect(sighting)
    sigma_um = math.inf if defect.height_sigma_um is None else defect.height_sigma_um
    if not math.isfinite(defect.height_um):
        return (True, True, math.inf, 0.0, sighting.xy_mm)
    return (False, bool(defect.flags & DOUBTFUL), sigma_um, -defect.height_um, sighting.xy_mm)


def _highest_first(defect: Defect) -> tuple[float, float, float]:
    height_um = defect.height_um if math.isfinite(defect.height_um) else math.inf
    return -height_um, defect.x_mm, defect.y_mm


def _unexplained(gathered: PanelFrames, seeds: list[list[_Seen]], station: PanelStation) -> tuple[PanelSpot, ...]:
    """Lone spots that no measured seed of the panel explains; one that several frames show is told once."""
    bests = [(min(group, key=_worse), {sighting.frame for sighting in group}) for group in seeds]
    measured = [
        (best, shown_in) for best, shown_in in bests if math.isfinite(_defect(best).height_um + sum(best.xy_mm))
    ]
    lone: list[_Seen] = []
    for n, frame in enumerate(gathered.frames):
        spots = frame.result.unpaired
        if not spots:
            continue
        pixels = np.array([(spot.x_px, spot.y_px) for spot in spots])
        elsewhere = [best for best, shown_in in measured if n not in shown_in]
        known = _explained(spots, pixels, elsewhere, frame.travel_mm, station)
        places = station.calibration.camera.back_project(pixels)
        lone += [
            _Seen(n, frame.travel_mm, _on_panel((x, y), frame.travel_mm, station), spot)
            for i, (spot, (x, y)) in enumerate(zip(spots, places.tolist(), strict=True))
            if i not in known
        ]
    alike = _grouped(lone, [0.0] * len(lone), station, lambda a, b: 0.0 if _kind(a) == _kind(b) else math.inf)
    return tuple(_spot(group) for group in alike)


def _kind(sighting: _Seen) -> tuple[bool, bool, bool]:
    """What the verdict makes of a lone spot: only spots of one kind may be the same."""
    flags = sighting.thing.flags
    return bool(flags & SURELY_A_SEED), bool(flags & NO_SEED), bool(flags & Flag.DUST)


def _spot(group: Sequence[_Seen]) -> PanelSpot:
    spot, flags = group[0].thing, Flag(0)
    assert isinstance(spot, Unpaired)
    for sighting in group:
        flags |= sighting.thing.flags
    return PanelSpot(spot.x_px, spot.y_px, flags, *group[0].xy_mm)


def _explained(
    spots: Sequence[Unpaired], pixels: FloatArray, measured: Sequence[_Seen], travel_mm: float, station: PanelStation
) -> set[int]:
    """Which lone spots of a frame are those of seeds that other frames measured: where that seed's would be here.

    Each of a seed's two spots explains one lone spot at most; a lone spot that is said to be both at once may be
    anywhere between them.
    """
    if not measured:
        return set()
    camera, gain = station.calibration.camera, station.calibration.height_gain
    foot = np.array([seed.xy_mm for seed in measured]) + travel_mm * station.direction
    radius = np.array([_defect(seed).height_um for seed in measured]) / (2 * gain * UM_PER_MM)
    ends = reflection.highlights(np.column_stack([foot, radius, radius]), station.calibration)
    seen_mm = camera.back_project(pixels)
    direct_mm, mirror_mm = (camera.back_project(end) for end in ends)
    half_mm = np.hypot(*(direct_mm - mirror_mm).T) / 2
    expected = ((direct_mm, 0 * half_mm), (mirror_mm, 0 * half_mm), ((direct_mm + mirror_mm) / 2, half_mm))
    candidates: list[tuple[float, int, tuple[int, int]]] = []
    for n, seed in enumerate(measured):
        for end, (at_mm, blur_mm) in enumerate(expected):
            reach_mm = _spot_reach_mm(seed, at_mm[n] - foot[n], travel_mm, station) + blur_mm[n]
            apart_mm = np.hypot(*(seen_mm - at_mm[n]).T)
            for i in np.flatnonzero(apart_mm <= reach_mm).tolist():
                if end < BOTH_SPOTS or spots[i].flags & Flag.MERGED:
                    candidates.append((float(apart_mm[i]), i, (n, end)))
    return _one_to_one(candidates)


def _one_to_one(candidates: list[tuple[float, int, tuple[int, int]]]) -> set[int]:
    """Lone spots that are taken by a seed's spot, the nearest first, each by one and each taking one."""
    taken: set[int] = set()
    used: set[tuple[int, int]] = set()
    for _, i, end in sorted(candidates):
        if i not in taken and end not in used:
            taken.add(i)
            used.add(end)
    return taken


def _spot_reach_mm(seed: _Seen, from_foot_mm: FloatArray, travel_mm: float, station: PanelStation) -> float:
    """How far a seed's spot may be from where it is expected, mm on the panel: by its place, travel and height."""
    defect, same = _defect(seed), station.settings.same_seed
    share = same.height_share
    if defect.height_sigma_um is not None and math.isfinite(defect.height_sigma_um) and defect.height_um > 0:
        share += same.sigmas * defect.height_sigma_um / defect.height_um
    moved_mm = _travel_reach_mm(travel_mm - seed.travel_mm, station)
    place_mm = math.hypot(_place_reach_mm(defect.place_sigma_mm, station), moved_mm)
    return same.place_mm + place_mm + share * float(np.hypot(*from_foot_mm))


def _on_panel(xy_mm: tuple[float, float], travel_mm: float, station: PanelStation) -> tuple[float, float]:
    return xy_mm[0] - travel_mm * float(station.direction[0]), xy_mm[1] - travel_mm * float(station.direction[1])


def _defect(sighting: _Seen) -> Defect:
    assert isinstance(sighting.thing, Defect)
    return sighting.thing
