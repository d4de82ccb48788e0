"""YAML read strictly, and pydantic's complaints as lines that name the YAML path, the value and what is allowed."""

from __future__ import annotations

import re
from typing import Any, get_args

import yaml
from pydantic import BaseModel, ValidationError

VALUE_CHARACTERS = 60
"""Longer values are cut in messages."""


class _Loader(yaml.SafeLoader):
    """SafeLoader that refuses a key given twice and reads 1e-5 as the number it is in YAML 1.2 and JSON."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            name = str(key.value)
            if name in seen:
                raise yaml.constructor.ConstructorError(None, None, f"key {name!r} is given twice", key.start_mark)
            seen.add(name)
        return super().construct_mapping(node, deep)


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"^[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$"), list("-+.0123456789")
)


def load(text: str) -> object:
    """The document in ``text``.

    Raises yaml.YAMLError, whose text names line and column, and ValueError for what looks like a date and is none.
    """
    return yaml.load(text, Loader=_Loader)


def problems(error: ValidationError, model: type[BaseModel]) -> list[str]:
    """One line for each problem: YAML path, value, and what is allowed. ``model`` is what was validated."""
    return [_line(e["type"], e["loc"], e["msg"], e["input"], model) for e in error.errors(include_url=False)]


def _line(kind: str, place: tuple[int | str, ...], message: str, value: object, model: type[BaseModel]) -> str:
    where = _path(place)
    if kind == "missing":
        return f"{where}: missing, but required"
    if kind == "extra_forbidden":
        return f"{where}: unknown key; allowed here: {', '.join(_keys(model, place[:-1]))}"
    message = message.removeprefix("Value error, ")
    return f"{where}: {_short(value)}: {message}"


def _path(place: tuple[int | str, ...]) -> str:
    """('camera', 'rotation', 0, 2) -> "camera.rotation[0][2]"."""
    text = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in place)
    return text.removeprefix(".") or "(document)"


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= VALUE_CHARACTERS else text[: VALUE_CHARACTERS - 3] + "..."


def _keys(model: type[BaseModel], place: tuple[int | str, ...]) -> list[str]:
    """The keys that the model at ``place`` under ``model`` knows; those of all variants where there are several."""
    models = [model]
    for part in place:
        if isinstance(part, str):
            fields = [m.model_fields[part].annotation for m in models if part in m.model_fields]
            models = [found for annotation in fields for found in _models(annotation)] or models
    return list(dict.fromkeys(key for m in models for key in m.model_fields))


def _models(annotation: object) -> list[type[BaseModel]]:
    """The models named in a type such as ``X``, ``X | None`` or ``tuple[X, ...]``."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [found for part in get_args(annotation) for found in _models(part)]
