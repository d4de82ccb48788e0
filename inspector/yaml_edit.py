"""Single values changed in a YAML text, everything else kept as it is, comments too."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import yaml

from firmware_bridge import whole_file


class CannotEdit(ValueError):
    """The text is not written in a way that can be changed here; the message says what to write by hand."""


def change(path: Path, place: tuple[str, ...], values: Mapping[str, float]) -> None:
    """Give keys of the mapping at ``place`` (block style) these numbers, whole or not at all.

    Raises CannotEdit, OSError.
    """
    text = path.read_text(encoding="utf-8")
    for key, value in values.items():
        text = changed(text, place, key, f"{value:g}")
    whole_file.write(path, text)


def changed(text: str, place: tuple[str, ...], key: str, value: str) -> str:
    """The text with ``key`` of the mapping at ``place`` set to a scalar; added as the first key if it is not there."""
    node = yaml.compose(text, Loader=yaml.SafeLoader)
    for name in place:
        node = _child(node, name)
    by_hand = f"write {'.'.join((*place, key))}: {value} by hand"
    if not isinstance(node, yaml.MappingNode) or not node.value:
        raise CannotEdit(f"no mapping {'.'.join(place) or 'at the top'} to write into; {by_hand}")
    old = _child(node, key)
    if isinstance(old, yaml.ScalarNode):
        return text[: old.start_mark.index] + value + text[old.end_mark.index :]
    if old is not None or node.flow_style:
        raise CannotEdit(f"{'.'.join((*place, key))} is not written as a line of its own; {by_hand}")
    first = node.value[0][0].start_mark
    return f"{text[: first.index]}{key}: {value}\n{' ' * first.column}{text[first.index :]}"


def _child(node: yaml.Node | None, key: str) -> yaml.Node | None:
    pairs = node.value if isinstance(node, yaml.MappingNode) else []
    found: yaml.Node | None = next((value for name, value in pairs if name.value == key), None)
    return found
