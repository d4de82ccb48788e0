"""Everything a station is told: one tree, one YAML file, read strictly before anything is touched.

``load`` gives settings that hold together, or a :class:`SettingsError` with every problem there is.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from pydantic import ConfigDict, Field

from firmware_bridge import settings as bridge
from firmware_bridge.camera_settings import CameraSettings
from firmware_bridge.strict import Strict
from inspector import lamp_curve_file, panel_proof, recipe_folder, recipe_proof, yaml_document
from inspector.acquire.light import LightSettings
from inspector.archive.archive_settings import ArchiveSettings
from inspector.calibration_file import CalibrationError, CalibrationFile
from inspector.calibration_file import load as load_calibration
from inspector.cycle_settings import CycleSettings, DigitalInput, HardwareLine
from inspector.judge.spc.settings import StatisticsSettings
from inspector.metrics.settings import MetricsSettings
from inspector.page_settings import PageSettings
from inspector.panel_settings import PanelSettings
from inspector.publish.plc_settings import PlcSettings
from inspector.publish.result_log import LogSettings
from inspector.recipe import Recipe, find
from inspector.yaml_document import Document, Place, Problem


class SettingsError(ValueError):
    """Settings cannot be used; ``problems`` has all of them, the message one line for each."""

    def __init__(self, problems: tuple[Problem, ...]) -> None:
        super().__init__("\n".join(map(str, problems)))
        self.problems = problems


def _or_file(schema: dict[str, Any]) -> None:
    """A recipe may stand in a file of its own, or be one of ``recipes``: say so in the JSON schema."""
    reference = schema.pop("$ref")
    text = {"type": "string", "description": "File of the recipe; with recipes given, the name of one"}
    schema["anyOf"] = [{"$ref": reference}, text, {"type": "integer", "description": "With recipes: the id of one"}]


def _or_folder(schema: dict[str, Any]) -> None:
    """Recipes are mostly the files of a folder: say so in the JSON schema."""
    in_place = {"type": schema.pop("type"), "items": schema.pop("items")}
    schema["anyOf"] = [in_place, {"type": "string", "description": "Folder with a YAML file for each recipe"}]


ShiftTimes = Annotated[str, Field(pattern=r"^([01]\d|2[0-3]):[0-5]\d-([01]\d|2[0-3]):[0-5]\d$")]
Shifts = dict[Annotated[str, Field(pattern=r"^[^/]+$")], ShiftTimes]
"""Shifts by name; one that ends no later than it begins ends on the next day."""


class Settings(Strict):
    """A station. Paths in the file are relative to the file; those here are ready for use."""

    station: str = Field("station", min_length=1)
    """Name shown to people."""
    calibration: Path
    """Calibration file, made by `inspector calibrate`."""
    camera: CameraSettings
    """Where frames come from."""
    module: bridge.ModuleSettings
    """The I/O module that sets the lamp's level."""
    lamp: bridge.LampSettings = bridge.LampSettings.default()
    """The lamp."""
    plc: PlcSettings = PlcSettings.default()
    """What the PLC polls."""
    recipe: Recipe = Field(Recipe.default(), json_schema_extra=_or_file)
    """What the paint colour and part type decide; in place, or the name of a file that has it; where `recipes` are
    given, the id or name of one of them."""
    recipes: tuple[Recipe, ...] = Field((), strict=False, json_schema_extra=_or_folder)
    """Recipes that PLC and people choose from, each with an id and a name of its own: a folder of files, or in
    place."""
    recipe_choice_file: Annotated[Path, Field(strict=False)] | None = None
    """File in which the PLC's last choice of a recipe is kept over restarts; null: in the archive's
    folder, or without an archive `recipe` holds after each."""
    cycle: CycleSettings = CycleSettings.default()
    """The inspection cycle."""
    panel: PanelSettings = PanelSettings.default()
    """What makes a panel of frames; by default each frame is one."""
    light: LightSettings | None = None
    """The reference patch by which the light is kept constant; null: there is none."""
    log: LogSettings = LogSettings.default()
    """What is logged."""
    metrics: MetricsSettings | None = None
    """Measured values for Prometheus; null: they are not served."""
    statistics: StatisticsSettings = StatisticsSettings.default()
    """Statistics of the paint line."""
    page: PageSettings = PageSettings.default()
    """The operator's page."""
    statistics_file: Annotated[Path, Field(strict=False)] | None = None
    """File in which the statistics are kept over restarts; null: in the archive's folder, or without an archive
    they begin anew with each."""
    archive: ArchiveSettings | None = None
    """Where results and frames are kept; null: nowhere."""
    shifts: Shifts = Field({})
    """Names of the plant's shifts and their times of day, such as early: 06:00-14:00; for reports."""

    def under(self, folder: Path) -> Settings:
        """The same settings with relative paths taken from ``folder``; files that keep something over restarts and are
        not named are in the archive's folder, if there is one."""
        return self._with_files()._under(folder)

    def _with_files(self) -> Settings:
        if self.archive is None:
            return self
        kept = self.archive.folder
        sequence_file = self.plc.sequence_file or kept / "sequence.json"
        return self.model_copy(
            update={
                "plc": self.plc.model_copy(update={"sequence_file": sequence_file}),
                "recipe_choice_file": self.recipe_choice_file or kept / "recipe.json",
                "statistics_file": self.statistics_file or kept / "statistics.json",
            }
        )

    def _under(self, folder: Path) -> Settings:
        return self.model_copy(
            update={
                "calibration": folder / self.calibration,
                "camera": self.camera.under(folder),
                "lamp": self.lamp.under(folder),
                "plc": self.plc.under(folder),
                "page": self.page.under(folder),
                "recipe_choice_file": self.recipe_choice_file and folder / self.recipe_choice_file,
                "statistics_file": self.statistics_file and folder / self.statistics_file,
                "archive": self.archive and self.archive.under(folder),
            },
        )


class RecordSettings(Strict):
    """The part of a station's settings that reading its archive needs; the rest may be wrong meanwhile."""

    model_config = ConfigDict(extra="ignore")

    archive: ArchiveSettings | None = None
    """Where results and frames are kept; null: nowhere."""
    shifts: Shifts = Field({})
    """Names of the plant's shifts and their times of day."""


def load_records(path: Path) -> RecordSettings:
    """Archive and shifts of a settings file, whatever else it says. Raises SettingsError with their problems."""
    records, problems = yaml_document.validate(yaml_document.read(path), RecordSettings)
    if records is None or problems:
        raise SettingsError(problems)
    return records.model_copy(update={"archive": records.archive and records.archive.under(path.parent)})


class DeviceSettings(Strict):
    """The part of a station's settings that its I/O module needs; before a calibration there is no more."""

    model_config = ConfigDict(extra="ignore")

    module: bridge.ModuleSettings
    """The I/O module that sets the lamp's level."""
    lamp: bridge.LampSettings = bridge.LampSettings.default()
    """The lamp."""


def load_devices(path: Path) -> DeviceSettings:
    """Module and lamp of a settings file, whatever else it says. Raises SettingsError with every problem of these."""
    document = _with_lamp_curve(yaml_document.read(path), path.parent)
    devices, problems = yaml_document.validate(document, DeviceSettings)
    if devices is None or problems:
        raise SettingsError(problems)
    return devices


def load(path: Path, *, secrets: bool = True) -> Settings:
    """The settings in a file, with its calibration file looked through. Raises SettingsError with every problem.

    ``secrets``: whether the service's are looked through too; who only reads the settings has no right to them.
    """
    document, choice = _with_recipes(_with_lamp_curve(yaml_document.read(path), path.parent), path.parent)
    document = _with_actions(document, path.parent)
    settings, problems = yaml_document.validate(document, Settings)
    calibration: CalibrationFile | None = None
    if isinstance(document.data, dict):
        calibration, wrong = _calibration(document, document.data.get("calibration"), path.parent)
        problems += (*wrong, *_device_problems(document, document.data, settings))
        problems += tuple(_port_problems(document, settings.model_dump() if settings else document.data))
    if settings and settings.recipes:
        settings, unknown = _choosing(document, settings, choice)
        problems += unknown
    if settings and calibration:
        problems += tuple(_recipe_problems(document, settings, calibration))
    if settings:
        problems += (*_pace_problems(document, settings), *_trigger_problems(document, settings))
        problems += (
            *_panel_problems(document, settings, calibration),
            *_disk_problems(document, settings, path.parent),
        )
        problems += tuple(_patch_problems(document, settings, calibration)) if calibration else ()
        problems += tuple(_tls_problems(document, settings, path.parent)) if secrets else ()
    if settings is None or calibration is None or problems:
        raise SettingsError(problems)
    return _drawn(settings.under(path.parent), calibration)


def _drawn(settings: Settings, calibration: CalibrationFile) -> Settings:
    """The same settings; a simulated camera that is asked for seeds is told where their highlights are."""
    camera = settings.camera
    if camera.kind != "simulated" or not camera.seeds:
        return settings
    from inspector import simulated_scene

    seen = simulated_scene.highlights(camera.seeds, camera.seed_share, calibration.to_calibration())
    return settings.model_copy(update={"camera": camera.model_copy(update={"spots": camera.spots + seen})})


def check(path: Path) -> Settings:
    """As :func:`load`, and recorded frames must be there too: the service itself waits for them as for any device."""
    settings = load(path)
    missing = [frame for frame in settings.camera.recordings if not frame.exists()]
    if missing:
        allowed = "allowed: an image file or a folder that is there (the service would wait for it)"
        raise SettingsError(tuple(Problem(str(path), "camera.paths", repr(str(frame)), allowed) for frame in missing))
    return settings


def configuration_hash(settings: Settings) -> int:
    """32 bits that change when any setting, or the calibration file's content, does. Raises OSError."""
    folder = settings.calibration.parent  # paths count relative to it, so that a moved installation keeps its hash
    values = settings.model_dump(
        exclude={
            "calibration": True,
            "lamp": {"hours_file"},
            "page": True,
            "plc": {"sequence_file"},
            "recipe_choice_file": True,
            "statistics_file": True,
            "archive": True,
            "shifts": True,
        }
    )
    text = json.dumps(values, sort_keys=True, default=lambda path: os.path.relpath(path, folder)).encode()
    digest = hashlib.sha256(text + settings.calibration.read_bytes()).digest()
    return int.from_bytes(digest[:4], "big")


def with_recipe(settings: Settings, wanted: int | str) -> Settings:
    """The settings with another of their recipes, by id or name. Raises SettingsError, naming those there are."""
    chosen = find(settings.recipes or (settings.recipe,), wanted)
    if chosen is None:
        raise SettingsError((Problem("", "recipe", repr(wanted), _choices(settings.recipes or (settings.recipe,))),))
    return settings.model_copy(update={"recipe": chosen})


def _choices(recipes: Sequence[Recipe]) -> str:
    listed = ", ".join(f"{recipe.id} ({recipe.name})" for recipe in sorted(recipes, key=lambda r: r.id))
    return f"no such recipe; allowed: {listed}"


def _with_recipes(document: Document, folder: Path) -> tuple[Document, object]:
    """The document with its recipes' own files taken in; and which of ``recipes`` it chooses, not itself validated."""
    if not isinstance(document.data, dict):
        return document, None
    recipe, recipes = document.data.get("recipe"), document.data.get("recipes")
    if isinstance(recipes, str):
        document = document.including("recipes", recipe_folder.document(folder / recipes))
    if recipes is None:
        if isinstance(recipe, str):
            document = document.including("recipe", yaml_document.read(folder / recipe))
        return document, None
    assert isinstance(document.data, dict)
    data = {key: value for key, value in document.data.items() if key != "recipe"}
    document = replace(document, data=data)
    return replace(document, problems=(*document.problems, *recipe_folder.not_unique(document))), recipe


def _choosing(document: Document, settings: Settings, choice: object) -> tuple[Settings | None, tuple[Problem, ...]]:
    """The settings with the recipe chosen among ``recipes``; of one recipe, that one needs no choice."""
    chosen = settings.recipes[0] if choice is None and len(settings.recipes) == 1 else find(settings.recipes, choice)
    if chosen is None:
        return None, (document.problem(("recipe",), choice, _choices(settings.recipes)),)
    return settings.model_copy(update={"recipe": chosen}), ()


def _recipe_problems(document: Document, settings: Settings, calibration: CalibrationFile) -> Iterator[Problem]:
    """What in a recipe does not fit the station, for every recipe that may come to be used."""
    recipes, reach = settings.recipes or (settings.recipe,), (settings.lamp.curve[0][0], settings.lamp.curve[-1][0])
    panel = settings.panel.area
    if panel is None and not settings.panel.several and any(recipe.limits.zones for recipe in recipes):
        panel = recipe_proof.seen_by(calibration.camera.to_camera())
    for n, recipe in enumerate(recipes):
        place: Place = ("recipes", n) if settings.recipes else ("recipe",)
        for below, value, allowed in recipe_proof.misfits(recipe, reach, panel):
            yield document.problem((*place, *below), value, allowed)


def _disk_problems(document: Document, settings: Settings, folder: Path) -> Iterator[Problem]:
    files = {
        "plc.sequence_file": settings.plc.sequence_file,
        "recipe_choice_file": settings.recipe_choice_file,
        "statistics_file": settings.statistics_file,
        "lamp.hours_file": settings.lamp.hours_file or Path(os.devnull),
    }
    wrong = settings.archive and settings.archive.disk_misfit(files, folder)
    if settings.archive and wrong:
        yield document.problem(("archive", "disk"), str(settings.archive.disk), wrong)


def _with_lamp_curve(document: Document, folder: Path) -> Document:
    """The document with the file of the lamp's measured curve, if it names one, taken in."""
    lamp = document.data.get("lamp") if isinstance(document.data, dict) else None
    curve = lamp.get("curve") if isinstance(lamp, dict) else None
    if not isinstance(curve, str):
        return document
    measured = lamp_curve_file.document(folder / curve)
    return document.including("lamp", Document(document.source, lamp).including("curve", measured))


def _with_actions(document: Document, folder: Path) -> Document:
    """The document with the file of the statistics' table of actions, if it names one, taken in."""
    statistics = document.data.get("statistics") if isinstance(document.data, dict) else None
    actions = statistics.get("actions") if isinstance(statistics, dict) else None
    if not isinstance(actions, str):
        return document
    table = yaml_document.read(folder / actions)
    return document.including("statistics", Document(document.source, statistics).including("actions", table))


def _calibration(document: Document, file: object, folder: Path) -> tuple[CalibrationFile | None, tuple[Problem, ...]]:
    """The calibration file's content, looked through; or None, and what is wrong with it."""
    if not isinstance(file, str):
        return None, ()  # said already
    try:
        return load_calibration(folder / file), ()
    except CalibrationError as error:
        heading, *lines = str(error).splitlines()
        return None, tuple(document.problem(("calibration",), file, line) for line in lines or [heading])


def _device_problems(document: Document, data: Mapping[str, object], settings: Settings | None) -> Iterator[Problem]:
    """What the bridge finds when module and lamp are each right but do not fit; else validation has said it."""
    module, lamp = (settings.module, settings.lamp) if settings else _devices_alone(data)
    if module is None or lamp is None:
        return
    for place, value, allowed in bridge.conflicts(module, lamp):
        yield document.problem(tuple(place.split(".")), value, f"allowed: {allowed}")


def _devices_alone(data: Mapping[str, object]) -> tuple[bridge.ModuleSettings | None, bridge.LampSettings | None]:
    """Module and lamp, each None if it is not right, where something is wrong somewhere."""
    module, _ = yaml_document.validate(Document("", data.get("module")), bridge.ModuleSettings)
    lamp, _ = yaml_document.validate(Document("", data.get("lamp", {})), bridge.LampSettings)
    return module, lamp


def _pace_problems(document: Document, settings: Settings) -> Iterator[Problem]:
    """A module's watchdog must not take a cycle that waits for its camera for a dead station."""
    watchdog_s, longest_s = settings.module.watchdog_s, settings.camera.deadline_s + settings.module.deadline_s
    if watchdog_s is not None and watchdog_s <= longest_s:
        allowed = (
            f"allowed: more than {longest_s:g}, for which a cycle may wait (camera.deadline_s + module.deadline_s)"
        )
        yield document.problem(("module", "watchdog_s"), watchdog_s, allowed)


def _trigger_problems(document: Document, settings: Settings) -> Iterator[Problem]:
    """A trigger on an input that the module has not would never come."""
    trigger, bank = settings.cycle.trigger, settings.module.profile_row.digital_inputs
    count = bank.count if bank else 0
    if isinstance(trigger, DigitalInput) and trigger.channel >= count:
        allowed = f"0 to {count - 1}" if count else "none: choose another trigger or module"
        what = f"{settings.module.profile} has {count} digital inputs; allowed: {allowed}"
        yield document.problem(("cycle", "trigger", "channel"), trigger.channel, what)


def _panel_problems(document: Document, settings: Settings, calibration: CalibrationFile | None) -> Iterator[Problem]:
    """What of the making of panels does not fit the station, of whose camera nothing may be known."""
    trigger = settings.cycle.trigger
    camera = calibration.camera.to_camera() if calibration and settings.panel.several else None
    bank = settings.module.profile_row.digital_inputs
    channel = trigger.channel if isinstance(trigger, DigitalInput) else None
    by_line = isinstance(trigger, HardwareLine)
    for misfit in panel_proof.misfits(settings.panel, bank.count if bank else 0, channel, by_line, camera):
        yield document.problem(*misfit)


def _patch_problems(document: Document, settings: Settings, calibration: CalibrationFile) -> Iterator[Problem]:
    """The reference by which the light is kept constant must be in the frame."""
    if settings.light is None:
        return
    camera, patch = calibration.camera, settings.light.patch
    if patch.x_px + patch.width_px > camera.width_px or patch.y_px + patch.height_px > camera.height_px:
        allowed = f"allowed: within the calibrated frame, {camera.width_px} x {camera.height_px} px"
        yield document.problem(("light", "patch"), patch.model_dump(), allowed)


def _tls_problems(document: Document, settings: Settings, folder: Path) -> Iterator[Problem]:
    """Certificates that cannot be used: the service would serve nothing."""
    if settings.plc.tls is None:
        return
    from inspector.publish import plc_tls  # only stations with TLS pay for it

    try:
        plc_tls.context(settings.plc.tls.under(folder))
    except plc_tls.TlsError as error:
        value = str(getattr(settings.plc.tls, error.key))
        yield document.problem(("plc", "tls", error.key), value, f"{error.why}; allowed: {error.remedy}")


def _port_problems(document: Document, data: object) -> Iterator[Problem]:
    """Ports that two parts would open: a serial device under any of its names, a TCP port of this machine."""
    first: dict[object, str] = {}
    for place, mapping in yaml_document.mappings(data):
        claim = _claim(mapping)
        if claim is None:
            continue
        here = (*place, "port")
        if claim in first:
            yield document.problem(here, mapping["port"], f"already used by {first[claim]}; allowed: a port of its own")
        first.setdefault(claim, yaml_document.path_text(here))


def _claim(mapping: Mapping[str, object]) -> object:
    """What a mapping with a key ``port`` takes for itself; None if nothing that another could want too."""
    port = mapping.get("port")
    if isinstance(port, str):
        return os.path.realpath(port)
    if isinstance(port, int) and port > 0:
        host = str(mapping.get("host", "127.0.0.1"))
        return port, "this machine" if host.startswith("127.") or host in _THIS_MACHINE else host
    return None


_THIS_MACHINE = ("localhost", "0.0.0.0", "::", "::1")
