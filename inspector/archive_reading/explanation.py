"""How one verdict came about, in numbers: the stages' own functions called again on the recorded frame.

What comes out is plain data (JSON), every number to its last digit; :mod:`.explained` makes a page of it. Where a frame
is gone, what the stored rows tell is told.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from inspector import imagefile, reflection
from inspector.archive import result_json
from inspector.archive_reading.kept import KeptFrame, KeptResult
from inspector.archive_reading.selection import iso
from inspector.detect import pairs as pairs_stage
from inspector.detect.pairs import LEAST_ODDS, Pairing
from inspector.estimate import heights as heights_stage
from inspector.estimate import thesis
from inspector.estimate.heights import UM_PER_MM
from inspector.judge import panel as panel_stage
from inspector.judge import verdict as verdict_stage
from inspector.model import Defect, Flag, FrameResult, Highlights, PanelFrame, PanelFrames, Unpaired, Verdict
from inspector.optics import Calibration
from inspector.recipe import Limits
from inspector.reinspection import Reinspection
from inspector.settings_version import VersionWrong

Said = dict[str, Any]
UNPAIRED_WHY = {
    Flag.PAINT_POOL: "lies between the two spots of a pair, in line with them: paint at the seed's foot",
    Flag.AMBIGUOUS: "fits a couple, but its partner serves in a likelier one, or the odds are too small",
    Flag.MERGED: "drawn out the way a seed's two spots lie: two that run into one",
    Flag.PARTNER_OUTSIDE_FRAME: "its partner would lie outside the frame",
    Flag.PARTNER_HIDDEN: "its partner is hidden",
    Flag.HOT_PIXEL: "sharper than the lens can draw: a hot pixel",
    Flag.TOO_SMALL: "smaller than min_area_px",
    Flag.TOO_LARGE: "larger than max_area_px",
    Flag.DUST: "no spot lies where a partner would: dust or a scratch",
}
"""What each flag of a lone highlight says, the telling ones first."""


def explain(kept: KeptResult, only: int | None = None) -> Said:
    """The explanation of a result; ``only``: of this one of its frames, from 0."""
    again = Reinspection(kept.version) if kept.version else None
    frames = [_frame(frame, again) for frame in kept.frames if only is None or frame.row["number"] == only]
    said: Said = {
        "result": _result(kept),
        "settings": _settings(kept),
        "frames": [told for told, _ in frames],
        "stored_seeds": [_defect(defect) for defect in kept.defects],
    }
    if again is not None:
        several = kept.row["frame_count"] > 1
        found = [result for _, result in frames if result is not None]
        known = only is None and bool(frames) and len(found) == len(frames)
        unpaired = _panel_unpaired(kept.frames) if several else [spot for result in found for spot in result.unpaired]
        area_m2 = kept.row["area_m2"] or again.station.area_m2
        said["judgement"] = judgement(kept.defects, unpaired, again.version.recipe.limits, area_m2, known)
        if several and only is None:
            said["panel"] = _panel(kept, again, found)
    said["same"] = _same(said)
    return said


def _same(said: Said) -> bool | None:
    """Whether all that was recomputed is as it was recorded, to the last bit; None: nothing could be."""
    found = [frame["same"] for frame in said["frames"]]
    found += [said["panel"]["same"]] if "panel" in said else []
    known = [one for one in found if one is not None]
    return all(known) if known else None


def _result(kept: KeptResult) -> Said:
    row = kept.row
    return {
        "id": row["id"],
        "sequence": row["sequence"],
        "at": iso(row["at_s"]),
        "panel_id": row["panel_id"],
        "verdict": Verdict(row["verdict"]).name,
        "reasons": row["reasons"],
        "reasons_text": row["reasons_text"],
        "fault_code": row["fault_code"],
        "frame_count": row["frame_count"],
    }


def _settings(kept: KeptResult) -> Said:
    row, version = kept.row, kept.version
    said: Said = {
        "version": row["settings"],
        "recipe_id": row["recipe_id"],
        "recipe_name": kept.recipe_name,
        "recipe": row["recipe"],
        "why": kept.why,
    }
    if version is None:
        return said
    camera, light = version.calibration.camera, version.calibration.light
    return said | {
        "method": version.recipe.method,
        "detection": version.recipe.detection.model_dump(mode="json"),
        "limits": version.recipe.limits.model_dump(mode="json"),
        "camera": {
            **{name: getattr(camera, name) for name in ("f_mm", "kappa1_per_mm2", "sx", "cx_px", "cy_px")},
            **{name: getattr(camera, name) for name in ("dx_mm", "dy_mm", "width_px", "height_px", "view_angle_deg")},
            "centre_mm": camera.centre_mm.tolist(),
            "rotation": camera.rotation.tolist(),
            "translation_mm": camera.translation_mm.tolist(),
        },
        "lamp": {
            "direction": None if light.direction is None else light.direction.tolist(),
            "position_mm": None if light.position_mm is None else light.position_mm.tolist(),
            "alpha_deg": version.calibration.lamp_angle_deg,
        },
        "height_gain": version.calibration.height_gain,
        "nominal_view_angle_deg": version.calibration.view_angle_deg,
    }


def _frame(frame: KeptFrame, again: Reinspection | None) -> tuple[Said, FrameResult | None]:
    """One frame: how it was taken, and where it is kept every step from its pixels to its verdict; and what is found
    in it now."""
    row = frame.row
    names = ("number", "name", "exposure_us", "exposure_set_us", "lamp_v", "lamp_set_v", "travel_mm", "kept", "image")
    said: Said = {name: row[name] for name in names} | {
        "taken_at": iso(row["taken_at_s"]),
        "verdict": Verdict(row["verdict"]).name,
        "recomputed": False,
        "same": None,
        "why": frame.why,
    }
    if frame.item is None or frame.item.inspected is None or again is None:
        return said, None
    try:
        own = Reinspection(frame.item.version())
        result = own.frame(imagefile.read(frame.item.image), frame.item.recorded.file)
    except (VersionWrong, imagefile.FrameUnreadable) as error:
        return said | {"why": str(error)}, None
    said |= {
        "recomputed": True,
        "same": result_json.same(result, frame.item.inspected.result),
        "verdict": result.verdict.name,
        "reasons_text": list(result.reasons_text),
    }
    return said | _steps(result, own), result


def _steps(result: FrameResult, again: Reinspection) -> Said:
    """From highlights to seeds; nothing where the frame was refused before."""
    spots, calibration = result.highlights, again.version.calibration
    if spots is None:
        return {}
    pairing = pairs_stage.pairing(spots, calibration)
    return {
        "background_dn": spots.background_dn,
        "noise_dn": spots.noise_dn,
        "threshold_dn": spots.threshold_dn,
        "full_scale_dn": spots.full_scale_dn,
        "highlights": _highlights(spots, pairing),
        "couples": _couples(spots, pairing, calibration),
        "seeds": _seeds(result, spots, pairing, again),
    }


def _highlights(spots: Highlights, pairing: Pairing) -> list[Said]:
    serves = {int(d): f"direct of pair {n}" for n, d in enumerate(pairing.pairs.direct)}
    serves |= {int(m): f"mirror of pair {n}" for n, m in enumerate(pairing.pairs.mirror)}
    lone = dict(zip(pairing.pairs.unpaired.tolist(), pairing.pairs.unpaired_flags.tolist(), strict=True))
    return [
        {
            "number": n,
            "xy_px": spots.xy_px[n].tolist(),
            "covariance_px2": spots.covariance_px2[n].tolist(),
            "flux_dn": float(spots.flux_dn[n]),
            "flux_sigma": float(spots.flux_sigma[n]),
            "peak_dn": float(spots.peak_dn[n]),
            "area_px": int(spots.area_px[n]),
            "flags": Flag(int(lone.get(n, spots.flags[n]))).names(),
            "serves": serves.get(n) or "alone: " + _why_alone(lone[n]),
        }
        for n in range(len(spots))
    ]


def _why_alone(flags: int) -> str:
    return next((why for flag, why in UNPAIRED_WHY.items() if flags & flag), "nothing explains it")


def _couples(spots: Highlights, pairing: Pairing, calibration: Calibration) -> list[Said]:
    """Every couple that was considered, the likeliest first, with why it was taken or not."""
    found, chosen = pairing.considered, {k: n for n, k in enumerate(pairing.chosen)}
    ends = (np.array(found.direct, np.intp), np.array(found.mirror, np.intp))
    seeds = reflection.solve(pairing.pairs.rays, spots.covariance_px2, *ends, calibration)
    with np.errstate(invalid="ignore"):
        residual = np.sqrt(seeds.chi2).tolist()
    taken = {end: n for k, n in chosen.items() for end in (found.direct[k], found.mirror[k])}
    couples = []
    for k in sorted(range(len(found.cost)), key=found.cost.__getitem__):
        odds, d, m = pairing.log_odds(k), found.direct[k], found.mirror[k]
        if k in chosen:
            why = f"pair {chosen[k]}: of the best set of couples in which no spot serves twice"
        elif odds <= LEAST_ODDS:
            why = f"not taken: its log odds are not above {LEAST_ODDS:g}"
        else:
            others = sorted({taken[end] for end in (d, m) if end in taken})
            why = f"not taken: a spot of it serves in pair {', '.join(map(str, others))}, which is likelier in all"
        couples.append(
            {
                "direct": d,
                "mirror": m,
                "radius_mm": float(seeds.radius_mm[k]),
                "residual_sigma": residual[k],
                "log_odds": odds,
                "pair": chosen.get(k),
                "why": why,
            }
        )
    return couples


def _seeds(result: FrameResult, spots: Highlights, pairing: Pairing, again: Reinspection) -> list[Said]:
    """Each seed of the frame, in the result's order, with the equations' values."""
    pairs, calibration = pairing.pairs, again.version.calibration
    if len(pairs.direct) == 0:
        return []
    exact, method = heights_stage.exact(spots, pairs, calibration), again.version.recipe.method
    ends = (spots.xy_px if method == "exact" else spots.binary_px)[pairs.direct].tolist()
    place = {tuple(end): n for n, end in enumerate(ends)}
    steps = {side: _optics(spots, getattr(pairs, side), pairs.rays, exact, calibration, side) for side in SIDES}
    chain = _thesis(spots, pairing, calibration)
    said = []
    for number, defect in enumerate(result.defects):
        n = place[defect.direct_px]
        said.append(
            {
                "number": number,
                "pair": n,
                "direct": steps["direct"][n],
                "mirror": steps["mirror"][n],
                "x_mm": float(exact.seeds.x_mm[n]),
                "y_mm": float(exact.seeds.y_mm[n]),
                "radius_mm": float(exact.seeds.radius_mm[n]),
                "covariance": exact.seeds.covariance[n].tolist(),
                "chi2": float(exact.seeds.chi2[n]),
                "sunk": bool(exact.sunk[n]),
                "exact_height_um": float(exact.height_um[n]),
                "spots_sigma_um": float(exact.spots_sigma_um[n]),
                "calibration_sigma_um": None
                if exact.calibration_sigma_um is None
                else float(exact.calibration_sigma_um[n]),
                "exact_sigma_um": float(exact.sigma_um[n]),
                "thesis": chain[n],
                "defect": _defect(defect),
            }
        )
    return said


SIDES = ("direct", "mirror")


def _optics(
    spots: Highlights, ends: Any, rays: Any, exact: heights_stage.Measured, calibration: Calibration, side: str
) -> list[Said]:
    """One spot of each pair: from its pixel to its viewing ray, and to the normal that the seed must have there."""
    camera, seeds = calibration.camera, exact.seeds
    xy_px = spots.xy_px[ends]
    sensor_mm, ray = camera.sensor(xy_px), rays[ends, :3]
    undistorted_mm = camera.undistort(sensor_mm)
    resting = np.column_stack([seeds.x_mm, seeds.y_mm, seeds.radius_mm, seeds.radius_mm])
    mirrored = reflection.MIRROR if side == "mirror" else np.ones(3)
    normal = reflection.unit(calibration.light.toward(resting[:, :3]) - ray * mirrored)
    expected_px = reflection.highlights(resting, calibration)[SIDES.index(side)]
    foot_mm = camera.back_project(xy_px)
    return [
        {
            "highlight": int(end),
            "xy_px": xy_px[n].tolist(),
            "sensor_mm": sensor_mm[n].tolist(),
            "undistorted_mm": undistorted_mm[n].tolist(),
            "ray": ray[n].tolist(),
            "foot_mm": foot_mm[n].tolist(),
            "normal": normal[n].tolist(),
            "point_mm": (resting[n, :3] + resting[n, 2] * normal[n]).tolist(),
            "expected_px": expected_px[n].tolist(),
        }
        for n, end in enumerate(ends)
    ]


def _thesis(spots: Highlights, pairing: Pairing, calibration: Calibration) -> list[Said]:
    """The chain of the thesis for each pair, from the plain centroids carried back to the panel; mm but for h in um."""
    ends = (spots.binary_px[end] for end in (pairing.pairs.direct, pairing.pairs.mirror))
    direct_mm, mirror_mm = (calibration.camera.back_project(end) for end in ends)
    return [thesis_of(*both, calibration) for both in zip(direct_mm, mirror_mm, strict=True)]


def thesis_of(direct_mm: Any, mirror_mm: Any, calibration: Calibration) -> Said:
    """The thesis' chain for one pair of places (2,) mm on the panel."""
    alpha, beta = calibration.lamp_angle_deg, calibration.view_angle_deg
    chain = thesis.chain(direct_mm[None], mirror_mm[None], alpha, beta)
    values = {name: float(value[0]) for name, value in asdict(chain).items()}
    height_um = values["height_mm"] * calibration.height_gain * UM_PER_MM
    return values | {"alpha_deg": alpha, "beta_deg": beta, "height_um": height_um}


def _defect(defect: Defect) -> Said:
    return {
        "x_mm": defect.x_mm,
        "y_mm": defect.y_mm,
        "height_um": defect.height_um,
        "height_sigma_um": defect.height_sigma_um,
        "direct_px": list(defect.direct_px),
        "mirror_px": list(defect.mirror_px),
        "flags": defect.flags.names(),
        "residual_sigma": defect.residual_sigma,
        "sunk_bias_um": defect.sunk_bias_um,
        "place_sigma_mm": defect.place_sigma_mm,
    }


def judgement(
    defects: Sequence[Defect], unpaired: Sequence[Unpaired], limits: Limits, area_m2: float, known: bool
) -> Said:
    """Each limit with what was compared with it. ``known``: all lone highlights are among ``unpaired``."""
    judged = [defect for defect in defects if verdict_stage.is_judged(defect, limits)]
    return {
        "not_judged": [n for n, defect in enumerate(defects) if defect not in judged],
        "scopes": [_scope(scope, defects, limits) for scope in verdict_stage.scopes(judged, limits)],
        "seeds_per_m2": len(judged) / area_m2 if area_m2 else None,
        "max_per_m2": limits.max_per_m2,
        "unpaired": len(unpaired) if known else None,
        "max_unpaired": limits.max_unpaired,
        "guard_band_sigma": limits.guard_band_sigma,
        "findings": [
            {"reason": finding.reason.name, "fails": finding.fails, "text": finding.text}
            for finding in verdict_stage.findings(defects, unpaired, limits, area_m2)
        ],
    }


def _scope(scope: verdict_stage.Scope, defects: Sequence[Defect], limits: Limits) -> Said:
    limit_um = scope.max_height_um
    return {
        "where": scope.where,
        "max_height_um": limit_um,
        "max_count": scope.max_count,
        "count": len(scope.defects),
        "heights": [
            {
                "seed": defects.index(defect),
                "height_um": defect.height_um,
                "guard_um": verdict_stage.guard_um(defect, limits),
                "outcome": verdict_stage.standing(defect, limit_um, limits).value
                if limit_um is not None
                else "no limit",
            }
            for defect in scope.defects
            if math.isfinite(defect.height_um)
        ],
    }


def _panel_unpaired(frames: Sequence[KeptFrame]) -> Sequence[Unpaired]:
    """What the panel's result says that no frame explains; nothing where it is not kept."""
    last = frames[-1].item if frames else None
    return last.inspected.panel.unpaired if last and last.inspected and last.inspected.panel else ()


def _panel(kept: KeptResult, again: Reinspection, found: Sequence[FrameResult]) -> Said:
    """Which sightings of several frames are one seed, and whether the panel is judged as it was."""
    said = [frame.item.inspected for frame in kept.frames if frame.item and frame.item.inspected]
    if not len(found) == len(said) == len(kept.frames):
        return {"same": None, "why": "not all of its frames are kept", "seeds": []}
    last = said[-1]
    frames = [PanelFrame(result, one.travel_mm) for result, one in zip(found, said, strict=True)]
    result = again.panel(frames, last.panel_id, last.missing)
    gathered = PanelFrames(last.panel_id, tuple(frames), last.missing)
    seeds = [
        {"seed": _defect(seed), "sightings": [{"frame": frame} | _defect(defect) for frame, defect in seen]}
        for seed, seen in panel_stage.sightings(gathered, again.panel_station)
    ]
    return {"same": last.panel is not None and result_json.same(result, last.panel), "why": "", "seeds": seeds}
