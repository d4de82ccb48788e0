"""The last settings that brought the station to Ready, kept over restarts: begun with where the file is refused.

One file of the folder that systemd gives the service for its state has them whole, with their calibration. Settings
that were taken back (:mod:`inspector.service.settings_trial`) stay refused over restarts, until a reload asks for
them again.
"""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from firmware_bridge import whole_file
from inspector.faults import Fault
from inspector.settings import Settings, SettingsError, configuration_hash, load
from inspector.yaml_document import Problem

log = logging.getLogger(__name__)

NAME, CALIBRATION_NAME = "last-good.json", "last-good-calibration.yaml"
TAKEN_BACK = "these settings were taken back, since the station did not become ready with them"


def state_folder(environment: Mapping[str, str] = os.environ) -> Path | None:
    """The folder for the service's state, as systemd names it (StateDirectory=); None outside of it."""
    named = environment.get("STATE_DIRECTORY", "").split(":")[0]
    return Path(named) if named else None


@dataclass(frozen=True, slots=True)
class Begun:
    """The settings that the service begins with, as they were read; ``refused``: they are the last good ones in place
    of the file's, of which ``taken_back`` is the name of the version if that is why (None: another reason)."""

    settings: Settings
    refused: bool = False
    taken_back: str | None = None


def begin(file: Path, folder: Path | None) -> Begun:
    """The settings in ``file``, or, where they are refused, the last good ones, if there are any.

    Raises SettingsError if there are none.
    """
    kept = _read(folder, file)
    found, refusal = _loaded(file)
    if found is not None and (not kept.get("taken_back") or kept["taken_back"] != version_name(found)):
        return Begun(found)
    good = _usable(kept, folder)
    if good is None:
        if found is None:
            raise refusal
        return Begun(found)
    log_problems(refusal)
    log.error("fault %d: the last good settings are used; correct %s, then reload", Fault.SETTINGS_REFUSED, file)
    return Begun(good, refused=True, taken_back=kept["taken_back"])


def version_name(settings: Settings) -> str:
    """As versions of settings are named. Raises OSError."""
    return f"{configuration_hash(settings):08x}"


def _loaded(file: Path) -> tuple[Settings | None, SettingsError]:
    """The settings, or none; and what is then to be said of them."""
    try:
        return load(file), SettingsError((Problem(str(file), "", "", TAKEN_BACK),))
    except SettingsError as error:
        return None, error


def _read(folder: Path | None, file: Path) -> dict[str, Any]:
    """What is kept of the settings in ``file``; nothing if it cannot be read, which the log says."""
    if folder is None or not (folder / NAME).exists():
        return {}
    try:
        said = json.loads((folder / NAME).read_text(encoding="utf-8"))
        return {key: said[key] for key in ("good", "taken_back")} if said["file"] == str(file) else {}
    except (OSError, ValueError, KeyError, TypeError) as error:
        log.error("%s: cannot be used: %s", folder / NAME, error)
        return {}


def _usable(kept: Mapping[str, Any], folder: Path | None) -> Settings | None:
    """The good settings in it; None if there are none, or none of this program's, which the log says."""
    try:
        return restored(kept["good"]["settings"], kept["good"]["calibration"], folder) if kept else None
    except (OSError, ValueError, KeyError, TypeError) as error:
        log.error("the last good settings cannot be used: %s", error)
        return None


def restored(values: Mapping[str, Any], calibration: str, folder: Path | None) -> Settings:
    """Settings by what was kept of them; where their calibration is another one by now, it is put into ``folder`` as it
    was (None: it is not).

    Raises OSError, and ValueError for settings that are none of this program's.
    """
    settings = Settings.model_validate_json(json.dumps(values))
    try:
        same = settings.calibration.read_text(encoding="utf-8") == calibration
    except (OSError, UnicodeDecodeError):
        same = False
    if same or folder is None:
        return settings
    whole_file.write(folder / CALIBRATION_NAME, calibration)
    return settings.model_copy(update={"calibration": folder / CALIBRATION_NAME})


def keep(file: Path, folder: Path, good: Mapping[str, Any], taken_back: str | None) -> None:
    """Over a restart: the version of the settings in ``file`` that is good, as JSON has it, and the name of one that
    was taken back. A folder that cannot be written is said in the log."""
    text = json.dumps({"file": str(file), "taken_back": taken_back, "good": good}, ensure_ascii=False, indent=1) + "\n"
    kept = folder / NAME
    try:
        if not kept.exists() or kept.read_bytes() != text.encode():
            whole_file.write(kept, text)
    except OSError as error:
        log.error("%s: the last good settings are not kept over a restart: %s", kept, error)


def log_problems(error: SettingsError) -> None:
    """Say everything that is wrong with refused settings."""
    for problem in error.problems:
        log.error("settings refused: %s", problem)
