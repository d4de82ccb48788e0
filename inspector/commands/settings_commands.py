"""What `inspector config` prints."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import typer
import yaml

from inspector import settings
from inspector.settings import Settings, SettingsError


def check(file: Path) -> int:
    """Say whether a settings file is right, or all that is wrong; the exit status."""
    try:
        found = settings.check(file)
    except SettingsError as error:
        return _refused(error)
    typer.echo(f"{file}: right; station {found.station!r}, hash {settings.configuration_hash(found):08x}")
    return 0


def show(file: Path) -> int:
    """Print settings with their defaults, as YAML; the exit status."""
    try:
        found = settings.load(file)
    except SettingsError as error:
        return _refused(error)
    values = found.model_dump(mode="json")
    if found.recipes:
        values["recipe"] = found.recipe.id
    yaml.safe_dump(values, sys.stdout, sort_keys=False, allow_unicode=True)
    return 0


def schema() -> str:
    """The JSON schema of a settings file."""
    return json.dumps(Settings.model_json_schema(), indent=2) + "\n"


def _refused(error: SettingsError) -> int:
    for problem in error.problems:
        typer.echo(str(problem), err=True)
    count = len(error.problems)
    typer.echo(f"refused: {count} problem{'s' if count > 1 else ''}", err=True)
    return 1
