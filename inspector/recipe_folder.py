"""A folder of recipes: a YAML file for each, with an id and a name that no other has."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from inspector import yaml_document
from inspector.yaml_document import Document, Problem

SUFFIXES = (".yaml", ".yml")
"""Other files of the folder, and hidden ones, are left alone."""


def files(folder: Path) -> list[Path]:
    """The folder's recipe files by name. Raises OSError."""
    return sorted(p for p in folder.iterdir() if p.suffix in SUFFIXES and not p.name.startswith("."))


def document(folder: Path) -> Document:
    """The recipes of a folder as one list, each with its place in its own file; and every problem in reading them."""
    source = str(folder)
    try:
        found = files(folder)
    except OSError as error:
        return Document(source, problems=(Problem(source, "", "", f"cannot be read: {error.strerror}"),))
    if not found:
        return Document(
            source, problems=(Problem(source, "", "", "no recipe in it; allowed: one *.yaml file or more"),)
        )
    recipes: list[object] = []
    whole = Document(source, recipes)
    for file in found:
        part = yaml_document.read(file)
        place, problems = len(recipes), part.problems
        if part.data is None and not problems:
            problems = (Problem(str(file), "", "", "empty; allowed: a recipe"),)
        if part.data is not None:
            recipes.append(part.data)
            marks = {(place, *below): mark for below, mark in part.marks.items()}
            whole = replace(whole, marks=whole.marks | marks)
            problems = tuple(replace(p, path=f"[{place}].{p.path}".rstrip(".")) for p in problems)
        whole = replace(whole, problems=whole.problems + problems)
    return whole


def not_unique(settings: Document) -> Iterator[Problem]:
    """Problems of the list ``recipes`` of a settings document: ids and names that are missing, or another's."""
    recipes = settings.data.get("recipes") if isinstance(settings.data, dict) else None
    first: dict[str, tuple[int | str, ...]] = {}
    for n, recipe in enumerate(recipes if isinstance(recipes, list) else ()):
        for key in ("id", "name") if isinstance(recipe, dict) else ():
            place = ("recipes", n, key)
            if key not in recipe:
                missing = settings.problem(place, None, f"required; allowed: {key} that no other recipe has")
                yield replace(missing, value="missing")
                continue
            value = recipe[key]
            if key == "name" and isinstance(value, str) and value.isdigit():
                yield settings.problem(place, value, "a number would be taken for an id; allowed: a name with a letter")
            known = first.setdefault(f"{key} {value!r}", place)
            if known != place:
                taken = settings.problem(known, value, "").where
                yield settings.problem(place, value, f"already given at {taken}; allowed: {key} of its own")
