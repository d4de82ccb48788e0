"""The explanation of a verdict as a page for people: each step with its equation, its numbers, and what came of it."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from inspector.archive_reading.document import Document, Section, Table

Said = Mapping[str, Any]
MOST_ROWS = 200
"""Of more highlights or couples so many are told; --format json has all."""


def page(said: Said) -> Document:
    """The page."""
    result = said["result"]
    panel = f", panel {result['panel_id']}" if result["panel_id"] else ""
    title = f"Result {result['sequence']}{panel}: how its verdict came about"
    sections = [_summary(said), _settings(said["settings"])]
    for frame in said["frames"]:
        sections += _frame(frame, said["settings"])
    if not any(frame["recomputed"] for frame in said["frames"]):
        sections.append(_stored(said["stored_seeds"]))
    if "panel" in said:
        sections.append(_panel(said["panel"]))
    if "judgement" in said:
        sections.append(_judgement(said["judgement"], said["settings"]))
    return Document(title, f"{result['at']}, id {result['id']}", result["verdict"], sections)


def _summary(said: Said) -> Section:
    same = {
        True: "Recomputed from the recorded frames, the result is the recorded one to the last bit.",
        False: "Recomputed from the recorded frames, the result DIFFERS from the recorded one: the program or the frame"
        " is another; the numbers below are the recomputed ones.",
        None: "Nothing could be recomputed: what follows is what the store's rows tell.",
    }
    reasons = json.loads(said["result"]["reasons_text"]) or ["no reason to fail"]
    return Section("Verdict", paragraphs=[*reasons, same[said["same"]]])


def _settings(of: Said) -> Section:
    facts = [
        ("settings", of["version"]),
        ("recipe", f"{of['recipe_id']} ({of['recipe_name'] or 'name not kept'}), {of['recipe']}"),
    ]
    if "camera" not in of:
        return Section("Settings", facts, [f"They cannot be used: {of['why']}"])
    camera, lamp, limits = of["camera"], of["lamp"], of["limits"]
    where = "far, towards" if lamp["position_mm"] is None else "at, mm"
    facts += [
        ("method", of["method"]),
        ("camera's centre C, mm", _vector(camera["centre_mm"])),
        ("f, mm", f"{camera['f_mm']:.6g}"),
        ("kappa1, 1/mm2", f"{camera['kappa1_per_mm2']:.6g}"),
        ("image centre, px", f"{camera['cx_px']:g}, {camera['cy_px']:g}"),
        (f"lamp {where}", _vector(lamp["position_mm"] or lamp["direction"])),
        ("height gain", f"{of['height_gain']:g}"),
        ("height limit, um", f"{limits['max_height_um']}"),
        ("guard band", f"{limits['guard_band_sigma']:g} sigma, decides {limits['guard_band']}"),
    ]
    return Section("Settings it was found by", facts)


def _frame(frame: Said, settings: Said) -> Iterator[Section]:
    asked = f"{frame['exposure_set_us']:g} us asked, {_known(frame['exposure_us'])} us read"
    facts = [
        ("taken", str(frame["taken_at"])),
        ("exposure", asked),
        ("lamp", f"{frame['lamp_set_v']:g} V asked, {_known(frame['lamp_v'])} V read"),
        ("travel", f"{frame['travel_mm']:g} mm"),
        ("frame alone", frame["verdict"]),
        ("image", str(frame["image"])),
    ]
    title = f"Frame {frame['number']}: {frame['name']}"
    if not frame["recomputed"]:
        yield Section(title, facts, [f"Cannot be looked at again: {frame['why']}."])
        return
    same = "to the last bit as recorded" if frame["same"] else "OTHER than recorded"
    yield Section(title, facts, [f"Inspected again: {same}."])
    if "highlights" not in frame:
        yield Section("Refused", paragraphs=frame["reasons_text"], level=3)
        return
    yield _detection(frame, settings["detection"])
    yield _pairing(frame)
    for seed in frame["seeds"]:
        yield _seed(seed, settings)


def _detection(frame: Said, detection: Said) -> Section:
    how = (
        f"    threshold = threshold_dn = {detection['threshold_dn']:g} DN"
        if detection["threshold_dn"] is not None
        else f"    threshold = ground + {detection['threshold_sigma']:g} noise = {frame['threshold_dn']:.3f} DN"
        "    (the highest over the frame; the ground is that of its brightest tile, or each tile's own)"
    )
    facts = [
        ("background", f"{frame['background_dn']:.3f} DN"),
        ("noise", f"{frame['noise_dn']:.3f} DN"),
        ("threshold", f"{frame['threshold_dn']:.3f} DN"),
        ("full scale", f"{frame['full_scale_dn']:g} DN"),
    ]
    header = ["spot", "x, px", "y, px", "sigma x, px", "sigma y, px", "cov xy, px2", "flux, DN", "peak, DN", "area, px"]
    rows = [
        [
            str(spot["number"]),
            *(f"{v:.4f}" for v in spot["xy_px"]),
            *(f"{spot['covariance_px2'][n][n] ** 0.5:.4f}" for n in (0, 1)),
            f"{spot['covariance_px2'][0][1]:.2e}",
            f"{spot['flux_dn']:.1f}",
            f"{spot['peak_dn']:.1f}",
            str(spot["area_px"]),
            " ".join(spot["flags"]),
            spot["serves"],
        ]
        for spot in frame["highlights"][:MOST_ROWS]
    ]
    table = Table([*header, "flags", "serves as"], rows)
    return Section("Highlights", facts, [how, *_more(frame["highlights"])], [table], level=3)


def _pairing(frame: Said) -> Section:
    text = (
        "Each ordered couple of spots along the direction from direct to mirror spot is a candidate. The residual is "
        "that of its one spare equation; the log odds, that it is a seed rather than chance, count residual, "
        "brightness and size. The set of the highest odds in which no spot serves twice is taken."
    )
    rows = [
        [
            f"{couple['direct']} - {couple['mirror']}",
            f"{couple['radius_mm']:.4f}",
            f"{couple['residual_sigma']:.2f}",
            f"{couple['log_odds']:.2f}",
            couple["why"],
        ]
        for couple in frame["couples"][:MOST_ROWS]
    ]
    marks = ["pass" if couple["pair"] is not None else "" for couple in frame["couples"][:MOST_ROWS]]
    table = Table(["direct - mirror", "R, mm", "residual, sigma", "log odds", "outcome"], rows, marks)
    return Section("Pairs", paragraphs=[text, *_more(frame["couples"])], tables=[table], level=3)


def _more(items: Sequence[object]) -> list[str]:
    return [f"The first {MOST_ROWS} of {len(items)}; --format json has all."] if len(items) > MOST_ROWS else []


def _seed(seed: Said, settings: Said) -> Section:
    defect, thesis = seed["defect"], seed["thesis"]
    rows = [[side, *_optics(seed[side])] for side in ("direct", "mirror")]
    table = Table(
        [
            "spot",
            "pixel",
            "on the sensor Xd, mm",
            "undistorted Xu, mm",
            "ray d",
            "normal n",
            "foot, mm",
            "expected, px",
        ],
        rows,
    )
    covariance = seed["covariance"]
    gain = settings["height_gain"]
    sigma_r_mm = covariance[2][2] ** 0.5
    equations = [
        "    Xd = (pixel - centre) pitch (B.16, B.17);  Xu = Xd (1 + kappa1 |Xd|^2);  d = R^-1 (Xu, f), of length 1",
        "    n = unit(L - d), mirror spot: n = unit(L - d M), M = (1, 1, -1): known before the seed is",
        "    (X, Y, c) + R n lies on the ray from C, the mirror spot's on that from C M: linear in X, Y, R",
        f"    X = {seed['x_mm']:.6f}  Y = {seed['y_mm']:.6f}  R = c = {seed['radius_mm']:.6f} mm,"
        f"  chi2 of the spare equation {seed['chi2']:.4f}",
    ]
    if seed["sunk"]:
        equations.append("    the spare equation says sunk: h = c + R with c as fourth unknown, gain included")
    else:
        equations.append(f"    h = c + R = 2 R x gain {gain:g} = {seed['exact_height_um']:.4f} um")
    equations += [*_sigma(seed, sigma_r_mm, gain), _chain(thesis)]
    said = f"Told: {_height(defect)}, at x {defect['x_mm']:.3f}, y {defect['y_mm']:.3f} mm; flags: "
    told = said + (" ".join(defect["flags"]) or "none")
    compared = (
        f"The exact model and the thesis differ by {thesis['height_um'] - seed['exact_height_um']:+.1f} um; the result "
        f"is by the method {settings['method']}."
    )
    return Section(f"Seed {seed['number']}: {_height(defect)}", (), [told, *equations, compared], [table], level=3)


def _optics(spot: Said) -> list[str]:
    return [
        f"{spot['xy_px'][0]:.4f}, {spot['xy_px'][1]:.4f}",
        _vector(spot["sensor_mm"]),
        _vector(spot["undistorted_mm"]),
        _vector(spot["ray"]),
        _vector(spot["normal"]),
        _vector(spot["foot_mm"], 3),
        _vector(spot["expected_px"], 3),
    ]


def _sigma(seed: Said, sigma_r_mm: float, gain: float) -> list[str]:
    spots = f"    sigma of the spots' places {seed['spots_sigma_um']:.4f} um"
    if not seed["sunk"]:
        spots += f" = 2 x gain {gain:g} x sigma R {sigma_r_mm * 1000:.5f} um"
    if seed["calibration_sigma_um"] is None:
        return [spots, "    the calibration says nothing of its own uncertainty"]
    both = f"in squares {seed['exact_sigma_um']:.4f} um"
    return [spots, f"    sigma of the calibration {seed['calibration_sigma_um']:.4f} um;  {both}"]


def _chain(thesis: Said) -> str:
    return (
        f"    thesis (sec. 4.3), alpha {thesis['alpha_deg']:.2f}, beta {thesis['beta_deg']:.2f} deg:"
        f" X = {thesis['spacing_mm']:.5f} (5.1),"
        f" EA = X cos beta = {thesis['ea_mm']:.5f} (4.4),"
        f" CA = EA / cos(2 beta - 90) = {thesis['ca_mm']:.5f} (4.1),"
        f" h = CA sin(90 - beta) = {thesis['first_stage_mm']:.5f} (4.2),"
        f" a = {thesis['height_mm']:.5f} mm (4.5), x gain: {thesis['height_um']:.1f} um"
    )


def _stored(seeds: Sequence[Said]) -> Section:
    header = ["seed", "x, mm", "y, mm", "height, um", "direct, px", "mirror, px", "residual, sigma", "flags"]
    rows = [
        [
            str(n),
            f"{seed['x_mm']:.3f}",
            f"{seed['y_mm']:.3f}",
            _height(seed),
            _vector(seed["direct_px"], 3),
            _vector(seed["mirror_px"], 3),
            _known(seed["residual_sigma"]),
            " ".join(seed["flags"]),
        ]
        for n, seed in enumerate(seeds)
    ]
    return Section(
        "Seeds as stored", tables=[Table(header, rows)] if rows else [], paragraphs=[] if rows else ["None."]
    )


def _panel(panel: Said) -> Section:
    if panel["same"] is None:
        return Section("Seeds over frames", paragraphs=[f"Cannot be judged again: {panel['why']}."])
    rows = [
        [
            str(n),
            _height(seed["seed"]),
            "; ".join(
                f"frame {one['frame']}: {_height(one)} at {one['x_mm']:.2f}, {one['y_mm']:.2f} mm"
                for one in seed["sightings"]
            ),
        ]
        for n, seed in enumerate(panel["seeds"])
    ]
    text = "Sightings of one place and height are one seed; of several the best measured is told, not their mean."
    same = "Judged again: " + ("to the last bit as recorded." if panel["same"] else "OTHER than recorded.")
    return Section("Seeds over frames", (), [text, same], [Table(["seed", "told", "sightings"], rows)])


def _judgement(of: Said, settings: Said) -> Section:
    tables = []
    for scope in of["scopes"]:
        limit = "no limit" if scope["max_height_um"] is None else f"{scope['max_height_um']:g}"
        rows = [
            [
                f"seed {one['seed']} {scope['where']}",
                f"{one['height_um']:.2f}",
                f"{one['guard_um']:.2f}",
                limit,
                one["outcome"],
            ]
            for one in scope["heights"]
        ]
        marks = [{"over": "fail", "within guard band": "near"}.get(one["outcome"], "") for one in scope["heights"]]
        if rows:
            tables.append(Table(["height", "value, um", "guard band, um", "limit, um", "outcome"], rows, marks))
        if scope["max_count"] is not None:
            over = scope["count"] > scope["max_count"]
            row = [
                f"seeds {scope['where']}",
                str(scope["count"]),
                str(scope["max_count"]),
                "over" if over else "within",
            ]
            tables.append(Table(["count", "value", "limit", "outcome"], [row], ["fail" if over else ""]))
    facts = [
        ("seeds per m2", f"{_known(of['seeds_per_m2'])} (limit {of['max_per_m2'] or 'none'})"),
        ("lone highlights", f"{_known(of['unpaired'])} (limit for unexplained ones {_limit(of['max_unpaired'])})"),
        ("seeds not judged", ", ".join(map(str, of["not_judged"])) or "none"),
    ]
    said = [f"{one['reason']}: {one['text']} ({'fails' if one['fails'] else 'reported'})" for one in of["findings"]]
    texts = [
        "A height fails where height - guard band > limit, with guard band = "
        f"{of['guard_band_sigma']:g} x its sigma; where the limit lies within it, guard_band decides.",
        *(said or ["Nothing was found against it."]),
    ]
    return Section("Limits", facts, texts, tables)


def _height(defect: Said) -> str:
    sigma = "" if defect["height_sigma_um"] is None else f" ± {defect['height_sigma_um']:.1f}"
    return f"{defect['height_um']:.1f}{sigma} um"


def _vector(values: Sequence[float], digits: int = 5) -> str:
    return ", ".join(f"{value:.{digits}f}" for value in values)


def _known(value: float | int | None) -> str:
    return "not known" if value is None else f"{value:.5g}"


def _limit(value: int | None) -> str:
    return "none" if value is None else str(value)
