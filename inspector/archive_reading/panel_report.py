"""The report on one result: verdict, seeds, map, frames with what was found in them, and what it was found by."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from datetime import datetime
from html import escape

import numpy as np

from inspector import imagefile, overlay, panel_map
from inspector.archive_reading import document
from inspector.archive_reading.document import Document, Picture, Section, Table
from inspector.archive_reading.kept import KeptFrame, KeptResult
from inspector.judge import verdict as verdict_stage
from inspector.judge.verdict import Standing
from inspector.model import Defect, PanelResult, PanelSpot, Reason, Verdict
from inspector.optics import Camera
from inspector.recipe import Limits
from inspector.reinspection import Reinspection

QUALITY, THUMB_QUALITY, THUMB_PX = 88, 78, 420
"""Of JPEG images, and how wide a small one is."""


def page(kept: KeptResult) -> Document:
    """The report."""
    row = kept.row
    panel = f"Panel {row['panel_id']}, result {row['sequence']}" if row["panel_id"] else f"Result {row['sequence']}"
    reasons = json.loads(row["reasons_text"]) or ["No reason to fail."]
    sections = [Section("Verdict", _taken(kept), reasons), _seeds(kept), *_map(kept)]
    sections.append(Section("Frames", pictures=[_picture(frame) for frame in kept.frames], paragraphs=_gone(kept)))
    sections.append(_by(kept))
    return Document(panel, local(row["at_s"]), Verdict(row["verdict"]).name, sections)


def local(unix_s: float | None) -> str:
    """A time by the clock on the wall, with its zone."""
    if unix_s is None:
        return ""
    return datetime.fromtimestamp(unix_s).astimezone().strftime("%Y-%m-%d %H:%M:%S %Z")


def _taken(kept: KeptResult) -> list[tuple[str, str]]:
    row = kept.row
    asked = ", ".join(sorted({f"{frame.row['exposure_set_us']:g}" for frame in kept.frames})) or "-"
    return [
        ("recipe", f"{row['recipe_id']} {kept.recipe_name or ''}"),
        ("seeds", str(row["defect_count"])),
        ("highest", "-" if row["largest_height_um"] is None else f"{row['largest_height_um']:.1f} um"),
        ("lone highlights", str(row["unpaired_count"])),
        ("frames", str(row["frame_count"])),
        ("lamp asked / read", f"{row['lamp_set_v']:.3f} / {row['lamp_read_v']:.3f} V"),
        ("exposure asked / read", f"{asked} / {row['exposure_us']:g} us"),
        ("cycle", f"{row['cycle_us'] / 1000:.1f} ms"),
        ("fault", str(row["fault_code"] or "none")),
    ]


def _seeds(kept: KeptResult) -> Section:
    """Every seed; one over the limit stands out."""
    limits = kept.version.recipe.limits if kept.version else None
    header = ["seed", "x, mm", "y, mm", "height, um", "± sigma, um", "residual, sigma", "flags", "limit"]
    rows, marks = [], []
    for n, seed in enumerate(kept.defects):
        outcome = _outcome(seed, limits)
        sigma = "-" if seed.height_sigma_um is None else f"{seed.height_sigma_um:.1f}"
        residual = "-" if seed.residual_sigma is None else f"{seed.residual_sigma:.2f}"
        places = [f"{seed.x_mm:.2f}", f"{seed.y_mm:.2f}", f"{seed.height_um:.1f}", sigma, residual]
        rows.append([str(n), *places, " ".join(seed.flags.names()), outcome])
        marks.append({Standing.OVER.value: "fail", Standing.WITHIN_GUARD_BAND.value: "near"}.get(outcome, ""))
    if not rows:
        return Section("Seeds", paragraphs=["None."])
    return Section("Seeds", tables=[Table(header, rows, marks)])


def _outcome(seed: Defect, limits: Limits | None) -> str:
    """The worst of where the height stands by the limits that hold for the seed."""
    if limits is None:
        return "not known"
    if not verdict_stage.is_judged(seed, limits):
        return "not judged"
    found = [
        verdict_stage.standing(seed, scope.max_height_um, limits)
        for scope in verdict_stage.scopes([seed], limits)
        if scope.max_height_um is not None and scope.defects
    ]
    worst = (Standing.OVER, Standing.WITHIN_GUARD_BAND, Standing.UNDER)
    return next((one.value for one in worst if one in found), "no limit")


def _map(kept: KeptResult) -> Iterator[Section]:
    if kept.version is None:
        yield Section("Map", paragraphs=[f"Cannot be drawn: {kept.why}."])
        return
    again = Reinspection(kept.version)
    camera, station = again.station.calibration.camera, again.panel_station
    shown = PanelResult(
        Verdict(kept.row["verdict"]),
        Reason(kept.row["reasons"]),
        defects=kept.defects,
        unpaired=tuple(_lone(kept, camera)),
        travels_mm=tuple(frame.row["travel_mm"] for frame in kept.frames) or (0.0,),
    )
    x, y = station.direction.tolist()
    limits = kept.version.recipe.limits
    drawn = panel_map.svg(shown, camera, (x, y), limits, station.settings.area, banner=False)
    yield Section(
        "Map", pictures=[Picture(drawn, "Seeds at their places, heights in um; above the limit as triangles")]
    )


def _lone(kept: KeptResult, camera: Camera) -> Sequence[PanelSpot]:
    """The lone highlights, as far as a frame that is kept tells them."""
    last = kept.frames[-1].item if kept.frames else None
    if last is None or last.inspected is None:
        return ()
    if last.inspected.panel is not None:
        return last.inspected.panel.unpaired
    spots = last.inspected.result.unpaired
    if not spots:
        return ()
    places = camera.back_project(np.array([(spot.x_px, spot.y_px) for spot in spots])).tolist()
    return [PanelSpot(spot.x_px, spot.y_px, spot.flags, x, y) for spot, (x, y) in zip(spots, places, strict=True)]


def _gone(kept: KeptResult) -> list[str]:
    return [] if kept.frames else ["No frame was taken for this result."]


def _picture(frame: KeptFrame) -> Picture:
    row = frame.row
    lamp = "not known" if row["lamp_v"] is None else f"{row['lamp_v']:.3f} V"
    caption = f"Frame {row['number']}: {row['name']}, {local(row['taken_at_s'])}, lamp {lamp}"
    markup = drawn(frame)
    if markup is None:
        return Picture(f'<p class="gone">{missing(frame)}</p>', caption)
    return Picture(markup, caption)


def missing(frame: KeptFrame) -> str:
    """Why there is no picture of a frame, as markup."""
    return escape(f"No picture: {frame.why or 'its image cannot be read'}.")


def drawn(frame: KeptFrame, small: bool = False) -> str | None:
    """The frame with what was found in it, as markup; None where it is not there any more."""
    import cv2

    if frame.item is None or frame.item.inspected is None:
        return None
    try:
        image = imagefile.read(frame.item.image)
    except imagefile.FrameUnreadable:
        return None
    picture = overlay.draw(image, frame.item.inspected.result)
    if small:
        high = round(picture.shape[0] * THUMB_PX / picture.shape[1])
        picture = cv2.resize(picture, (THUMB_PX, high), interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)
    quality = [cv2.IMWRITE_JPEG_QUALITY, THUMB_QUALITY if small else QUALITY]
    data = cv2.imencode(".jpg", picture, quality)[1].tobytes()
    return document.embedded(data, "jpeg", f"frame {frame.row['number']} with what was found in it")


def _by(kept: KeptResult) -> Section:
    row, facts = kept.row, []
    if kept.version is not None:
        recipe, limits = kept.version.recipe, kept.version.recipe.limits
        facts = [
            ("method", recipe.method),
            ("exposure of the recipe", f"{recipe.exposure_us:g} us"),
            ("lamp of the recipe", f"{recipe.lamp_percent:g} %"),
            ("height limit", _limit(limits.max_height_um, "um")),
            ("guard band", f"{limits.guard_band_sigma:g} sigma decides {limits.guard_band}"),
            ("count limit", _limit(limits.max_count, "seeds")),
            ("density limit", _limit(limits.max_per_m2, "seeds per m2")),
            ("zones", ", ".join(zone.name for zone in limits.zones) or "none"),
        ]
    named = [("settings", row["settings"]), ("recipe's hash", row["recipe"]), ("result's id", str(row["id"]))]
    return Section("Found by", [*facts, *named], [] if kept.version else [f"Settings cannot be used: {kept.why}."])


def _limit(value: float | None, unit: str) -> str:
    return "none" if value is None else f"{value:g} {unit}"
