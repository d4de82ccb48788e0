"""The base of every settings model. A model costs its making only when it is used: the service's start waits for it."""

from __future__ import annotations

import ast
import functools
import inspect
import textwrap
from itertools import pairwise
from typing import Any, Self

from pydantic import BaseModel, ConfigDict, GetJsonSchemaHandler
from pydantic_core import CoreSchema


class Strict(BaseModel):
    """Base of every settings model: unknown keys and silent conversions are errors; instances do not change.

    In the JSON schema a key's description is the docstring below its attribute. It is read from the source when a
    schema is asked for: pydantic itself would read it for every class at every start, at more than the class' cost.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False, defer_build=True)

    @classmethod
    def default(cls) -> Self:
        """The model of an empty mapping, for a default: not validated, so that nothing is made for it."""
        return cls.model_construct()  # type: ignore[return-value]  # the plugin of mypy knows this class only

    @classmethod
    def __get_pydantic_json_schema__(cls, core_schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        schema = handler(core_schema)
        properties = handler.resolve_ref_schema(schema).get("properties", {})
        for name, text in attribute_docstrings(cls).items():
            if name in properties:
                properties[name].setdefault("description", text)
        return schema


@functools.cache
def attribute_docstrings(model: type[BaseModel]) -> dict[str, str]:
    """The docstring below each annotated attribute of a model and of those it is derived from."""
    found: dict[str, str] = {}
    for base in reversed(model.__mro__):
        if issubclass(base, Strict) and base is not Strict:
            found |= _own_docstrings(base)
    return found


def _own_docstrings(model: type[BaseModel]) -> dict[str, str]:
    (class_,) = ast.parse(textwrap.dedent(inspect.getsource(model))).body
    assert isinstance(class_, ast.ClassDef)
    return {
        attribute.target.id: inspect.cleandoc(text)
        for attribute, below in pairwise(class_.body)
        if isinstance(attribute, ast.AnnAssign) and isinstance(attribute.target, ast.Name)
        if isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant)
        if isinstance(text := below.value.value, str)
    }
