"""Carries IEC 61131-3 structured text out, as far as the integrator's block needs it: parsed by blark, made Python.

Integers are Python's, of any size; a name that is not declared raises. Time moves only as the test says.
"""

from __future__ import annotations

import gc
import re
from collections.abc import Callable, Mapping
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

from blark import transform as st
from blark.parse import parse_source_code

OPERATORS = {"=": "==", "<>": "!=", "AND": "&", "OR": "|", "MOD": "%", "/": "/"}


class Ton:
    """The standard's on-delay timer."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock, self._since, self.Q = clock, None, False

    def __call__(self, IN: bool, PT: float) -> None:  # the standard's names
        self._since = (self._clock() if self._since is None else self._since) if IN else None
        self.Q = self._since is not None and self._clock() - self._since >= PT


def _divided(left: float, right: float) -> float:
    return left // right if isinstance(left, int) and isinstance(right, int) else left / right


def _conversions() -> dict[str, Callable[[Any], Any]]:
    limits = {"WORD": 16, "UINT": 16, "UDINT": 32}
    made: dict[str, Callable[[Any], Any]] = {}
    for source in (*limits, "INT"):
        made |= {f"{source}_TO_{kind}": lambda v, bits=bits: v & ((1 << bits) - 1) for kind, bits in limits.items()}
        made[f"{source}_TO_REAL"] = float
        made[f"{source}_TO_INT"] = lambda v: v - 0x10000 if v & 0x8000 else v
    return made


def _text(node: Any) -> str:
    """An expression in Python."""
    match node:
        case st.BinaryOperation():
            left, right, operator = _text(node.left), _text(node.right), str(node.op).upper()
            if operator == "/":
                return f"_divided({left}, {right})"
            return f"({left} {OPERATORS.get(operator, operator)} {right})"
        case st.UnaryOperation():
            return f"(not {_text(node.expr)})" if str(node.op).upper() == "NOT" else f"({node.op}{_text(node.expr)})"
        case st.ParenthesizedExpression():
            return f"({_text(node.expr)})"
        case st.FunctionCall():
            return f"_call['{node.name}']({_arguments(node.parameters)})"
        case st.SimpleVariable():
            return f"v.{node.name}"
        case st.MultiElementVariable():
            return _text(node.name) + "".join(_element(each) for each in node.elements)
        case st.Boolean():
            return str(str(node.value).upper() == "TRUE")
        case st.Integer() | st.Real():
            return _literal(str(node))
    raise TypeError(f"{type(node).__name__}: {node}")


def _element(node: Any) -> str:
    if isinstance(node, st.FieldSelector):
        return f".{node.field.name}"
    return "".join(f"[{_text(each)}]" for each in node.subscripts)


def _arguments(parameters: Any) -> str:
    return ", ".join(f"{p.name.name}={_text(p.value)}" if p.name else _text(p.value) for p in parameters)


def _literal(text: str) -> str:
    if duration := re.fullmatch(r"(?:TIME|T)#([\d.]+)(ms|s)", text, re.IGNORECASE):
        return str(float(duration[1]) * (0.001 if duration[2].lower() == "ms" else 1.0))
    number = re.sub(r"^[A-Z]+#", "", text)
    return f"0x{number[3:]}" if number.startswith("16#") else number.capitalize()


def _lines(statements: Any, indent: str) -> list[str]:
    made = [line for each in (statements.statements if statements else []) for line in _statement(each, indent)]
    return made or [f"{indent}pass"]


def _statement(node: Any, indent: str) -> list[str]:
    inner = indent + "    "
    match node:
        case st.AssignmentStatement():
            # A structure is assigned by value.
            return [f"{indent}{_text(name)} = _copy({_text(node.expression)})" for name in node.variables]
        case st.FunctionCallStatement():
            return [f"{indent}{_text(node.name)}({_arguments(node.parameters)})"]
        case st.ReturnStatement():
            return [f"{indent}return"]
        case st.IfStatement():
            lines = [f"{indent}if {_text(node.if_expression)}:", *_lines(node.statements, inner)]
            for clause in node.else_ifs:
                lines += [f"{indent}elif {_text(clause.if_expression)}:", *_lines(clause.statements, inner)]
            if node.else_clause:
                lines += [f"{indent}else:", *_lines(node.else_clause.statements, inner)]
            return lines
        case st.CaseStatement():
            lines = [f"{indent}_case = {_text(node.expression)}"]
            for nth, case in enumerate(node.cases):
                matches = ", ".join(_text(match) for match in case.matches)
                lines += [f"{indent}{'elif' if nth else 'if'} _case in ({matches},):", *_lines(case.statements, inner)]
            return lines
    raise TypeError(f"{type(node).__name__}: {node}")


class Declared(SimpleNamespace):
    """Variables: one that was not declared cannot be assigned either."""

    def __setattr__(self, name: str, value: Any) -> None:
        if name not in self.__dict__:
            raise NameError(f"{name} is not declared")
        super().__setattr__(name, value)


@lru_cache
def _parsed(source: str) -> dict[str, Any]:
    """The source's types, functions and blocks by name; parsing takes seconds."""
    gc.disable()  # nothing of a parse is rubbish before its end, and looking for it takes a third of the time
    try:
        parsed = parse_source_code(source)
    finally:
        gc.enable()
    if parsed.exception:
        raise parsed.exception
    return {str(getattr(item, "name", None) or item.declaration.name): item for item in parsed.transform().items}


class Program:
    """A source's function block, to be called; ``v`` are its variables."""

    def __init__(self, source: str, block: str, clock: Callable[[], float]) -> None:
        items = _parsed(source)
        self._clock, self._types = clock, items
        self._call: dict[str, Callable[..., Any]] = _conversions() | {"EXPT": pow}
        for name, item in items.items():
            if isinstance(item, st.Function):
                self._call[name] = self._function(name, item)
        self.v = self._variables(items[block])
        self._body = self._compiled(items[block])

    def __call__(self, **inputs: Any) -> None:
        for name, value in inputs.items():
            setattr(self.v, name, value)
        self._body(self.v)

    def _function(self, name: str, item: Any) -> Callable[..., Any]:
        body = self._compiled(item)

        def call(**inputs: Any) -> Any:
            v = self._variables(item, {name: 0})
            for each, value in inputs.items():
                setattr(v, each, value)
            body(v)
            return getattr(v, name)

        return call

    def _compiled(self, item: Any) -> Callable[[Any], None]:
        space: dict[str, Any] = {"_call": self._call, "_divided": _divided, "_copy": _copy}
        exec("\n".join(["def body(v):", *_lines(item.body, "    ")]), space)
        body: Callable[[Any], None] = space["body"]
        return body

    def _variables(self, item: Any, more: Mapping[str, Any] | None = None) -> Declared:
        values = dict(more or {})
        for section in item.declarations:
            for declared in section.items:
                for variable in declared.variables:
                    values[str(getattr(variable, "name", variable))] = self._initial(str(declared.init))
        return Declared(**values)

    def _initial(self, declared: str) -> Any:
        """The first value of a declaration such as ``UINT := 3``."""
        kind, _, value = (part.strip() for part in declared.partition(":="))
        if array := re.fullmatch(r"ARRAY\s*\[(\d+)\.\.(\d+)\] OF (\w+)", kind):
            return {i: self._initial(array[3]) for i in range(int(array[1]), int(array[2]) + 1)}
        if kind == "TON":
            return Ton(self._clock)
        if kind in self._types:
            members = self._types[kind].declaration.declarations
            return Declared(**{str(m.variables[0].name): self._initial(str(m.init)) for m in members})
        if kind == "BOOL":
            return value.upper() == "TRUE"
        return eval(_literal(value)) if value else 0


def _copy(value: Any) -> Any:
    if isinstance(value, Declared):
        return Declared(**{name: _copy(each) for name, each in vars(value).items()})
    return {key: _copy(each) for key, each in value.items()} if isinstance(value, dict) else value
