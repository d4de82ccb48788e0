"""A plant's own texts: a YAML file of keys and texts, read strictly."""

from __future__ import annotations

from pathlib import Path

from inspector import yaml_document
from inspector.hmi.texts import english
from inspector.yaml_document import Problem


def load(file: Path | None) -> tuple[dict[str, str], tuple[Problem, ...]]:
    """The table with a file's texts in place of its own, and what is wrong with that file."""
    told = english()
    if file is None:
        return told, ()
    document = yaml_document.read(file)
    if document.problems or not isinstance(document.data, dict):
        return told, document.problems or (Problem(str(file), "", "", "allowed: keys with their texts"),)
    problems: list[Problem] = []
    for key, text in document.data.items():
        if key not in told:
            problems.append(
                document.problem((str(key),), text, "no such text; `inspector page --print-texts` lists them")
            )
        elif not isinstance(text, str) or _blanks(text) != _blanks(told[key]):
            kept = " ".join(sorted(_blanks(told[key]))) or "none"
            problems.append(document.problem((key,), text, f"allowed: a text with these blanks: {kept}"))
        else:
            told[key] = text
    return told, tuple(problems)


def _blanks(text: str) -> set[str]:
    """What a text leaves open, as {count}."""
    return {part.split("}")[0] for part in text.split("{")[1:]}
