"""What `inspector recipe` does: the recipes of a station listed, shown, proven and chosen."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import typer
import yaml

from inspector import settings, yaml_edit
from inspector.recipe import Recipe, content_hash
from inspector.service import recipe_choice
from inspector.settings import Settings, SettingsError, with_recipe

EXIT_DONE, EXIT_NOT_DONE, EXIT_SETTINGS_REFUSED = 0, 1, 78
"""Exit statuses: done; no such recipe, or it cannot be written; the settings are refused (EX_CONFIG)."""


def list_recipes(config: Path) -> int:
    """A line for each recipe, the one in use marked; the exit status."""

    def show(found: Settings) -> int:
        used = recipe_choice.resumed(found).recipe
        typer.echo(f"  {'id':>5}  {'hash':8}  {'exposure_us':>11}  {'lamp_%':>6}  {'limit_um':>8}  name")
        for recipe in sorted(_all(found), key=lambda r: r.id):
            typer.echo(f"{'*' if recipe.id == used.id else ' '} {_row(recipe)}")
        if used != found.recipe:
            typer.echo(f"* chosen by the PLC; {config} says {found.recipe.id}")
        return EXIT_DONE

    return _with(config, show)


def show(config: Path, wanted: str) -> int:
    """One recipe with its defaults filled in, as YAML; the exit status."""

    def print_one(found: Settings) -> int:
        recipe = with_recipe(found, _key(wanted)).recipe
        typer.echo(f"# hash {content_hash(recipe):08x}")
        yaml.safe_dump(recipe.model_dump(mode="json"), sys.stdout, sort_keys=False, allow_unicode=True)
        return EXIT_DONE

    return _with(config, print_one)


def check(config: Path) -> int:
    """Whether every recipe fits the station, or all that is wrong; the exit status."""

    def say(found: Settings) -> int:
        for recipe in sorted(_all(found), key=lambda r: r.id):
            typer.echo(f"{recipe.id} ({recipe.name}): right, hash {content_hash(recipe):08x}")
        typer.echo("The camera's own range of exposures is asked when a recipe comes into use.")
        return EXIT_DONE

    return _with(config, say)


def use(config: Path, wanted: str) -> int:
    """Make a recipe the settings' choice, which the PLC's earlier one then gives way to; the exit status."""

    def write(found: Settings) -> int:
        if not found.recipes:
            typer.echo(f"{config}: there is one recipe; name a folder of them under `recipes`", err=True)
            return EXIT_NOT_DONE
        recipe = with_recipe(found, _key(wanted)).recipe
        try:
            yaml_edit.change(config, (), {"recipe": recipe.id})
            if found.recipe_choice_file is not None:
                found.recipe_choice_file.unlink(missing_ok=True)
        except (yaml_edit.CannotEdit, OSError) as error:
            typer.echo(f"{config}: {error}", err=True)
            return EXIT_NOT_DONE
        typer.echo(f"{config}: recipe {recipe.id} ({recipe.name}), hash {content_hash(recipe):08x}")
        typer.echo("A running station takes it over at: systemctl reload inspector (or kill -HUP)")
        return EXIT_DONE

    return _with(config, write)


def _with(config: Path, work: Callable[[Settings], int]) -> int:
    """Do the work with the settings of a file; what is refused goes to stderr."""
    try:
        found = settings.load(config)
    except SettingsError as error:
        return _refused(error, EXIT_SETTINGS_REFUSED)
    try:
        return work(found)
    except SettingsError as error:
        return _refused(error, EXIT_NOT_DONE)


def _refused(error: SettingsError, status: int) -> int:
    for problem in error.problems:
        typer.echo(str(problem), err=True)
    return status


def _all(found: Settings) -> tuple[Recipe, ...]:
    return found.recipes or (found.recipe,)


def _key(wanted: str) -> int | str:
    return int(wanted) if wanted.isdigit() else wanted


def _row(recipe: Recipe) -> str:
    limit_um = recipe.limits.max_height_um
    limit = "-" if limit_um is None else f"{limit_um:g}"
    exposure, lamp = f"{recipe.exposure_us:>11g}", f"{recipe.lamp_percent:>6g}"
    return f"{recipe.id:>5}  {content_hash(recipe):08x}  {exposure}  {lamp}  {limit:>8}  {recipe.name}"
