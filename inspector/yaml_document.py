"""YAML read strictly, and what is wrong with it: place in the file, YAML path, value, and what is allowed.

Scalars are those of YAML 1.2's core schema, as in JSON (``no`` is a text, ``1e-5`` a number); a key given twice is a
problem, not the last one's win.
"""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError

Place = tuple[int | str, ...]
Schema = Mapping[str, Any]
ModelT = TypeVar("ModelT", bound=BaseModel)

VALUE_CHARACTERS = 60
"""Longer values are cut in messages."""
SECRET = re.compile(r"passw|passphrase|secret|token|credential", re.IGNORECASE)
"""Keys, right or misspelt, whose values no message shows."""
IN_ADDRESS = re.compile(r"(//[^/@\s]*?:)[^/@\s]*@")
"""A password in an address, with what stands before it."""
HIDDEN = "(hidden)"


@dataclass(frozen=True, slots=True)
class Problem:
    """One thing that is wrong: ``where`` it stands (file:line), its YAML path, the value as text, what is allowed."""

    where: str
    path: str
    value: str
    allowed: str

    def __str__(self) -> str:
        return ": ".join(part for part in (self.where, self.path, self.value, self.allowed) if part)


@dataclass(frozen=True)
class Document:
    """What a file says: plain mappings, lists and scalars, where each stands, and the keys given twice."""

    source: str
    data: object = None
    marks: dict[Place, str] = field(default_factory=dict)
    problems: tuple[Problem, ...] = ()

    def problem(self, place: Place, value: object, allowed: str) -> Problem:
        """A problem with what stands at ``place``, or with its nearest surrounding that stands in the file."""
        ends = (place[:end] for end in range(len(place), -1, -1))
        mark = next((self.marks[known] for known in ends if known in self.marks), self.source)
        hidden = not isinstance(value, _Verbatim) and any(SECRET.search(str(part)) for part in place)
        return Problem(mark, path_text(place), HIDDEN if hidden else short(value), allowed)

    def including(self, key: str, part: Document) -> Document:
        """This document with the value of its top-level ``key`` taken from another file; without it, if that failed."""
        assert isinstance(self.data, dict)
        data = {name: value for name, value in self.data.items() if name != key}
        if part.data is not None or not part.problems:
            data[key] = part.data
        marks = self.marks | {(key, *place): mark for place, mark in part.marks.items()}
        joint = {p.path: f"{key}{p.path}" if p.path.startswith("[") else f"{key}.{p.path}" for p in part.problems}
        problems = tuple(replace(p, path=joint[p.path].rstrip(".")) for p in part.problems)
        return Document(self.source, data, marks, self.problems + problems)


class _Loader(yaml.SafeLoader):
    """SafeLoader with the scalars of JSON and no others."""


_Loader.yaml_implicit_resolvers = {}

for _kind, _pattern, _first in (
    ("null", r"~|null|", ["~", "n", ""]),
    ("bool", r"true|false", ["t", "f"]),
    ("int", r"[-+]?(0|[1-9][0-9]*)|0x[0-9a-fA-F]+", list("-+0123456789")),
    ("float", r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|[-+]?\.inf|\.nan", list("-+.0123456789")),
):
    _Loader.add_implicit_resolver(f"tag:yaml.org,2002:{_kind}", re.compile(rf"^(?:{_pattern})$"), _first)


def read(path: Path) -> Document:
    """The file at ``path``; one that cannot be read or is not YAML is a document of one problem and no data."""
    source = str(path)
    try:
        return parse(path.read_text(encoding="utf-8"), source)
    except OSError as error:
        return Document(source, problems=(Problem(source, "", "", f"cannot be read: {error.strerror}"),))
    except UnicodeDecodeError as error:
        return Document(source, problems=(Problem(source, "", "", f"not a text in UTF-8, at byte {error.start}"),))


def parse(text: str, source: str) -> Document:
    """The document in ``text``; ``source`` names it in problems."""
    try:
        builder = _Builder(text, source)
        return Document(source, builder.data, builder.marks, tuple(builder.problems))
    except yaml.MarkedYAMLError as error:
        at = error.problem_mark
        where = f"{source}:{at.line + 1}:{at.column + 1}" if at else source
        complaint = ", ".join(filter(None, (error.context, error.problem)))
        return Document(source, problems=(Problem(where, "", "", f"not YAML: {complaint}"),))
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        complaint = str(error).replace("\n", ", ")
        return Document(source, problems=(Problem(source, "", "", f"not YAML: {complaint}"),))


class _Builder:
    """Plain data from YAML nodes, remembering where each stood."""

    def __init__(self, text: str, source: str) -> None:
        self._source = source
        self._loader = _Loader(text)
        self.marks: dict[Place, str] = {}
        self.problems: list[Problem] = []
        node = self._loader.get_single_node()
        self.data = None if node is None else self._build(node, ())

    def _build(self, node: yaml.Node, place: Place) -> object:
        self.marks.setdefault(place, f"{self._source}:{node.start_mark.line + 1}")
        if isinstance(node, yaml.MappingNode):
            return self._mapping(node, place)
        if isinstance(node, yaml.SequenceNode):
            return [self._build(item, (*place, n)) for n, item in enumerate(node.value)]
        value: object = self._loader.construct_object(node)
        return value

    def _mapping(self, node: yaml.MappingNode, place: Place) -> dict[str, object]:
        built: dict[str, object] = {}
        for key_node, value_node in node.value:
            key = str(key_node.value)
            below = (*place, key)
            mark = f"{self._source}:{key_node.start_mark.line + 1}"
            if key in built:
                self.problems.append(Problem(mark, path_text(below), "", f"given twice, first at {self.marks[below]}"))
                continue
            self.marks[below] = mark
            built[key] = self._build(value_node, below)
        return built


def validate(document: Document, model: type[ModelT]) -> tuple[ModelT | None, tuple[Problem, ...]]:
    """The document as a ``model``, or None, and every problem found on the way."""
    if document.data is None and document.problems:
        return None, document.problems
    try:
        # By way of JSON, pydantic's strict mode takes a list for a tuple and a text for a path, as YAML writes them.
        return model.model_validate_json(json.dumps(document.data)), document.problems
    except ValidationError as error:
        schema = model.model_json_schema()
        found = (_problem(document, dict(e), schema) for e in error.errors(include_url=False))
        return None, (*document.problems, *found)


def _problem(document: Document, error: Mapping[str, Any], schema: Schema) -> Problem:
    place, node = _descend(schema, error["loc"])
    kind, message = error["type"], str(error["msg"])
    if kind == "extra_forbidden":
        _, parent = _descend(schema, error["loc"][:-1])
        return document.problem(place, error["input"], _unknown(str(place[-1]), list(parent.get("properties", ()))))
    allowed = allowed_text(node)
    if kind == "missing":
        return document.problem(place, _Verbatim("missing"), f"required; allowed: {allowed}")
    if kind == "value_error":
        return document.problem(place, error["input"], message.removeprefix("Value error, "))
    return document.problem(place, error["input"], f"allowed: {allowed}" if allowed else message)


def _unknown(key: str, known: Sequence[str]) -> str:
    near = difflib.get_close_matches(key, known, n=1)
    hint = f" (did you mean {near[0]}?)" if near else ""
    return f"unknown key{hint}; allowed here: {', '.join(known)}"


def _descend(schema: Schema, place: Place) -> tuple[Place, Schema]:
    """Follow pydantic's ``loc`` down a JSON schema: the YAML path, without the tags of unions, and the schema there."""
    path: list[int | str] = []
    node = _plain(schema, schema)
    for part in place:
        variants = node.get("discriminator", {}).get("mapping", {})
        if part in variants:
            node = _plain({"$ref": variants[part]}, schema)
            continue
        path.append(part)
        node = _plain(_child(node, part), schema)
    return tuple(path), node


def _child(node: Schema, part: int | str) -> Schema:
    if isinstance(part, str):
        found = node.get("properties", {}).get(part, {})
    else:
        items = node.get("prefixItems", [])
        found = items[part] if part < len(items) else node.get("items", {})
    return found if isinstance(found, Mapping) else {}


def _plain(node: Schema, root: Schema) -> Schema:
    """The schema itself where there is a reference to it; of alternatives the model, the list, or what is not null."""
    while True:
        choices = [choice for choice in node.get("anyOf", ()) if choice.get("type") != "null"]
        models = [choice for choice in choices if "$ref" in choice or "items" in choice] or choices
        if "$ref" in node:
            node = root["$defs"][node["$ref"].removeprefix("#/$defs/")]
        elif len(models) == 1:
            node = models[0] | {"nullable": len(choices) < len(node["anyOf"])}
        else:
            return node


_KINDS = {
    "integer": "a whole number",
    "number": "a number",
    "string": "a text",
    "boolean": "true or false",
    "array": "a list",
    "object": "a mapping",
}


def allowed_text(node: Schema) -> str:
    """What a JSON schema allows, in words: "a whole number from 0 to 65535"; empty where it does not say."""
    if "discriminator" in node:
        kinds = ", ".join(node["discriminator"]["mapping"])
        return f"a mapping whose {node['discriminator']['propertyName']} is one of: {kinds}"
    choices = node.get("enum", [node["const"]] if "const" in node else [])
    text = f"one of: {', '.join(map(str, choices))}" if choices else _KINDS.get(node.get("type", ""), "")
    text += "".join(f" {word} {node[key]:g}" for key, word in _BOUNDS if key in node)
    text += "".join(f" of at {word} {node[key]} {what}" for key, word, what in _LENGTHS if key in node)
    return f"{text}, or null" if node.get("nullable") and text else text


_BOUNDS = (
    ("minimum", "from"),
    ("exclusiveMinimum", "above"),
    ("maximum", "to"),
    ("exclusiveMaximum", "below"),
)
_LENGTHS = (
    ("minItems", "least", "items"),
    ("maxItems", "most", "items"),
    ("minLength", "least", "characters"),
    ("maxLength", "most", "characters"),
)


class _Verbatim(str):
    """A word about a value, shown without quotes."""

    __slots__ = ()

    def __repr__(self) -> str:
        return str(self)


def path_text(place: Place) -> str:
    """('camera', 'paths', 0) -> "camera.paths[0]"; empty for the whole document."""
    text = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in place)
    return text.removeprefix(".")


def short(value: object) -> str:
    """A value for a message, cut if it is long; without what is nobody's business."""
    text = IN_ADDRESS.sub(rf"\1{HIDDEN}@", repr(_without_secrets(value)))
    return text if len(text) <= VALUE_CHARACTERS else text[: VALUE_CHARACTERS - 3] + "..."


def _without_secrets(value: object) -> object:
    if isinstance(value, dict):
        return {key: HIDDEN if SECRET.search(str(key)) else _without_secrets(below) for key, below in value.items()}
    return [_without_secrets(item) for item in value] if isinstance(value, list) else value


def mappings(data: object, place: Place = ()) -> Iterator[tuple[Place, Mapping[str, object]]]:
    """Every mapping in a document's data, with its place, outermost first."""
    if isinstance(data, dict):
        yield place, data
    items = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    for key, value in items:
        yield from mappings(value, (*place, key))
