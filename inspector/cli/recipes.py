"""The commands `inspector recipe`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

recipe_app = typer.Typer(help="The recipes of a station: what a colour and part type decide.", no_args_is_help=True)

SettingsFile = Annotated[Path, typer.Option("--config", help="Settings file, YAML.")]
WantedRecipe = Annotated[str, typer.Argument(metavar="RECIPE", help="Its id or name.")]


@recipe_app.command("list")
def recipe_list(config: SettingsFile) -> None:
    """A line for each recipe; the one in use has a star. Exit status: 0 done, 78 settings refused."""
    from inspector.commands import recipe_commands

    raise typer.Exit(recipe_commands.list_recipes(config))


@recipe_app.command("show")
def recipe_show(config: SettingsFile, recipe: WantedRecipe) -> None:
    """A recipe with its defaults filled in. Exit status: 0 done, 1 no such recipe, 78 settings refused."""
    from inspector.commands import recipe_commands

    raise typer.Exit(recipe_commands.show(config, recipe))


@recipe_app.command("check")
def recipe_check(config: SettingsFile) -> None:
    """Say whether every recipe is right for the station. Exit status: 0 all are, 78 what is wrong is on stderr."""
    from inspector.commands import recipe_commands

    raise typer.Exit(recipe_commands.check(config))


@recipe_app.command("use")
def recipe_use(config: SettingsFile, recipe: WantedRecipe) -> None:
    """Write the choice into the settings file. Exit status: 0 done, 1 no such recipe or not written, 78 refused."""
    from inspector.commands import recipe_commands

    raise typer.Exit(recipe_commands.use(config, recipe))
