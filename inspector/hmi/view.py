"""What the page shows, from what was read: one JSON-able tree with every word in it. Pure.

A verdict is shown only while the station answers and its heartbeat moves; everything else is NO_STATION, and what a
fault or a zero says is NOT_INSPECTED.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from inspector.faults import Fault
from inspector.handshake_table import Answer
from inspector.hmi.commands import DEADLINE_S, Asked
from inspector.hmi.history import Seen
from inspector.hmi.look import Link, Look
from inspector.hmi.texts import Texts
from inspector.line_statistics import Action, Rule, Spread, Trend
from inspector.model import Flag, Reason, State, Verdict
from inspector.publish.registers import Status
from inspector.publish.statistics_registers import StatisticsStatus
from inspector.recipe import Recipe

Tree = dict[str, Any]
NO_STATION = "NO_STATION"
LISTED_SEEDS = 5
NOTES = {
    Status.SIMULATED: "note.simulated",
    Status.LAMP_WEAK: "note.lamp_weak",
    Status.SETTINGS_REFUSED: "note.settings_refused",
    Status.SATURATED_VALUE: "note.saturated",
    Status.LIST_TRUNCATED: "note.list_truncated",
}


@dataclass(frozen=True, slots=True)
class Known:
    """What the page knows beside the registers: the recipes of the settings, and the plant's words for its actions."""

    recipes: tuple[Recipe, ...]
    advice: Mapping[int, str]
    texts: Texts


def shown(look: Look, known: Known, now_s: float) -> Tree:
    """The whole tree. ``now_s``: the clock of the look."""
    link, texts = look.link(now_s), known.texts
    block = look.block if link is Link.UP else None
    tree: Tree = {
        "link": {"kind": link.value, "text": texts[f"link.{link.value}"], "why": look.why},
        "verdict": _verdict(block, texts),
        "fault": _fault(block, texts),
        "notes": [],
        "command": _command(look.asked, known),
        "history": [_row(seen, texts) for seen in look.seen],
    }
    if block is not None:
        tree |= {
            "state": _state(block["state"], texts),
            "notes": _notes(block, texts),
            "recipe": _recipe(block["recipe_id"], known),
            "station": _station(block, texts),
            "seeds": [_seed(seed, texts) for seed in look.defects[:LISTED_SEEDS]],
            "map": map_key(look),
            "statistics": _statistics(look.statistics, known),
        }
    return tree


def map_key(look: Look) -> str:
    """What a map is told from others by; empty while there is none: of a panel that was not inspected, one without
    seeds would look like a clean panel."""
    if look.block is None or not look.listed_for or not (look.block["verdict"] or look.defects):
        return ""
    return "-".join(map(str, (*look.listed_for, look.block["recipe_hash"])))


def _state(code: int, texts: Texts) -> Tree:
    """The state, OPC's name and what it means; the bare code of a newer station's."""
    name = next((state.name for state in State if state == code), str(code))
    return {"name": name, "text": texts.get(f"state.{name}", "")}


def _verdict(block: Mapping[str, Any] | None, texts: Texts) -> Tree:
    """The verdict in one word, and what was found; PASS and FAIL only where the status stands behind them."""
    if block is None:
        return {"name": NO_STATION, "word": texts["verdict.NO_STATION"], "lines": [texts["link.remedy"]], "age": ""}
    status, verdict = Status(block["status"]), Verdict.NOT_INSPECTED
    if Status.RESULTS_VALID in status and Status.FAULT not in status and block["verdict"] in (1, 2):
        verdict = Verdict(block["verdict"])
    reasons = Reason(block["reasons"] | block["reasons_high"] << 16)
    lines = [] if verdict is Verdict.NOT_INSPECTED else [_found(block, texts)]
    lines += [texts[f"reason.{reason.name}"] for reason in reasons if f"reason.{reason.name}" in texts]
    has_result = block["result_age_ms"] is not None
    age = _age(block["result_age_ms"] / 1000, texts) if has_result else texts["value.no_result"]
    panel = texts["value.panel"].format(panel=block["panel_id"]) if has_result else ""
    return {"name": verdict.name, "word": texts[f"verdict.{verdict.name}"], "lines": lines, "age": age, "panel": panel}


def _found(block: Mapping[str, Any], texts: Texts) -> str:
    count = int(block["defect_count"] or 0)
    if count == 0:
        return texts["value.seeds.none"]
    seeds = texts["value.seeds.one" if count == 1 else "value.seeds.many"].format(count=count)
    return f"{seeds}, {_largest(block['largest_height_um'], texts)}"


def _largest(height_um: float | None, texts: Texts) -> str:
    if height_um is None:
        return texts["value.unmeasured"]
    return texts["value.largest"].format(height=f"{height_um:.0f}")


def _age(age_s: float, texts: Texts) -> str:
    """Seconds up to two minutes, then minutes, then hours."""
    unit, size_s = next(
        (u, s) for u, s, most_s in (("s", 1, 120), ("min", 60, 7200), ("h", 3600, 1e18)) if age_s < most_s
    )
    return texts[f"value.age.{unit}"].format(age=int(age_s // size_s))


def _fault(block: Mapping[str, Any] | None, texts: Texts) -> Tree | None:
    """The fault with meaning and remedy; a code of a newer station's is shown as it is."""
    code = int(block["fault_code"]) if block else 0
    if not code:
        return None
    name = next((fault.name for fault in Fault if fault == code), "?")
    meaning, remedy = texts.get(f"fault.{code}", ""), texts.get(f"fault.{code}.remedy", "")
    return {"code": code, "name": name, "meaning": meaning, "remedy": remedy}


def _notes(block: Mapping[str, Any], texts: Texts) -> list[str]:
    status = Status(block["status"])
    notes = [texts[key] for bit, key in NOTES.items() if bit in status]
    if Answer.ONLINE not in Answer(block["handshake"]):
        notes.append(texts["note.offline"])
    return notes


def _recipe(recipe_id: int, known: Known) -> str:
    recipe = next((r for r in known.recipes if r.id == recipe_id), None)
    if recipe is None:
        return known.texts["value.recipe.unknown"].format(id=recipe_id)
    return known.texts["value.recipe"].format(id=recipe.id, name=recipe.name)


def _station(block: Mapping[str, Any], texts: Texts) -> list[Tree]:
    """Rows of name, value and whether that is as it should be (None: neither)."""
    status = Status(block["status"])
    lamp, camera = Status.LAMP_OK in status, Status.CAMERA_OK in status
    levels = f"{_number(block['lamp_set_mv'], 0.001, 2)} / {_number(block['lamp_read_mv'], 0.001, 2)} V"
    missed, overruns = int(block["missed_triggers"] or 0), int(block["overruns"] or 0)
    rows: list[tuple[str, str, bool | None]] = [
        ("lamp", f"{texts['value.works' if lamp else 'value.fails']}, {levels}", lamp),
        ("camera", texts["value.works" if camera else "value.fails"], camera),
        ("exposure", f"{_number(block['exposure_us'])} µs", None),
        ("missed", str(missed), missed == 0),
        ("overruns", str(overruns), overruns == 0),
        ("late", _number(block["late_triggers"]), None),
        ("waiting", _number(block["results_waiting"]), None),
        ("passed", _number(block["panels_passed"]), None),
        ("failed", _number(block["panels_failed"]), None),
        ("not_inspected", _number(block["panels_not_inspected"]), None),
    ]
    return [{"label": texts[f"label.{name}"], "value": value, "good": good} for name, value, good in rows]


def _number(value: float | None, scale: float = 1, digits: int = 0) -> str:
    return "–" if value is None else f"{value * scale:.{digits}f}"


def _seed(seed: Mapping[str, Any], texts: Texts) -> Tree:
    height_um, sigma_um = seed["height_um"], seed["height_sigma_um"]
    height = texts["value.unmeasured"] if height_um is None else f"{height_um:.0f} µm"
    sigma = "" if height_um is None or sigma_um is None else f" ± {sigma_um:.0f}"
    flags = ", ".join(texts[f"flag.{flag.name}"] for flag in Flag(int(seed["flags"])))
    return {"height": height + sigma, "place": _place(seed["x_mm"], seed["y_mm"]), "flags": flags}


def _place(x_mm: float | None, y_mm: float | None) -> str:
    return f"{_number(x_mm, digits=1)} | {_number(y_mm, digits=1)} mm"


def _statistics(area: Mapping[str, Any] | None, known: Known) -> Tree:
    """What the paint line's statistics say; nothing of them where they are not valid."""
    texts = known.texts
    status = StatisticsStatus(int(area["statistics_status"])) if area else StatisticsStatus(0)
    if area is None or StatisticsStatus.VALID not in status:
        return {"valid": False, "alarm": "", "text": texts["value.no_statistics"], "advice": "", "rows": []}
    rule, action = _member(Rule, area["alarm_rule"]), int(area["action"])
    alarm = StatisticsStatus.ALARM in status
    action_name = next((a.name for a in Action if a == action), "")
    advice = known.advice.get(action) or (texts[f"action.{action_name}"] if action_name else str(action))
    percent = _number(area["confidence"], 100)
    sure = (
        f" ({texts['value.confidence'].format(percent=percent)})" if action and area["confidence"] is not None else ""
    )
    text = (texts[f"rule.{rule}"] if rule else str(area["alarm_rule"])) if alarm else texts["value.no_alarm"]
    rows = {
        "per_panel": _number(area["recent_per_panel"], digits=2),
        "ratio": "–" if area["ratio"] is None else f"× {area['ratio']:.2f}",
        "trend": texts[f"trend.{_member(Trend, area['trend']) or 'UNKNOWN'}"],
        "spread": texts[f"spread.{_member(Spread, area['spread']) or 'UNKNOWN'}"],
        "median": f"{_number(area['median_height_um'])} µm",
        "p95": f"{_number(area['p95_height_um'])} µm",
        "blind": f"{_number(area['not_inspected_share'], 100)} %",
    }
    if StatisticsStatus.REPEATED_PLACE in status:
        rows["place"] = _place(area["repeated_x_mm"], area["repeated_y_mm"])
    listed = [{"label": texts[f"label.{name}"], "value": value, "good": None} for name, value in rows.items()]
    return {"valid": True, "alarm": alarm, "text": text, "advice": advice + sure if action else "", "rows": listed}


def _member(kind: type[Rule] | type[Trend] | type[Spread], code: Any) -> str:
    """The name of a code; empty for one of a newer station's."""
    return next((member.name for member in kind if member == code), "")


def _command(asked: Asked | None, known: Known) -> Tree | None:
    """The command under way, or how the last one ended."""
    if asked is None:
        return None
    texts, code = known.texts, int(asked.code)
    what = texts[f"command.{asked.deed.name}"].format(argument=_recipe(asked.argument, known))
    how = texts[f"outcome.{asked.outcome.value}"].format(code=code, seconds=f"{DEADLINE_S:g}")
    why = texts[f"result.{asked.code.name}"] if asked.outcome.value == "failed" else ""
    return {
        "number": asked.number,
        "outcome": asked.outcome.value,
        "code": code,
        "text": f"{what}: {how}",
        "why": why,
    }


def _row(seen: Seen, texts: Texts) -> Tree:
    return {
        "sequence": seen.sequence,
        "at_s": seen.at_s,
        "verdict": seen.verdict.name,
        "word": texts[f"verdict.{seen.verdict.name}"],
        "reasons": ", ".join(texts[f"reason.{r.name}"] for r in seen.reasons if f"reason.{r.name}" in texts),
        "seeds": seen.seeds,
        "largest": "–" if seen.seeds == 0 else _number(seen.largest_um),
        "panel": texts["value.panel"].format(panel=seen.panel_id) if seen.panel_id != seen.sequence else "",
        "gap": texts["value.gap"].format(count=seen.unseen) if seen.unseen else "",
    }
