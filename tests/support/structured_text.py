"""Carries IEC 61131-3 structured text out, as far as the integrator's block needs it: parsed by lark, made Python.

Integers are Python's, of any size; a name that is not declared raises. Time moves only as the test says.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from types import CodeType, SimpleNamespace
from typing import Any

from lark import Lark, Transformer, v_args

GRAMMAR = Path(__file__).with_suffix(".lark")


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


@dataclass(frozen=True)
class Array:
    """The type ARRAY[first..last] OF each."""

    first: int
    last: int
    each: str


@dataclass(frozen=True)
class Variable:
    """A declaration; ``first`` is its first value in Python, None where it is the type's own."""

    name: str
    kind: str | Array
    first: str | None


@dataclass(frozen=True)
class Unit:
    """A structure, function or block by what it declares; ``code`` makes ``body(v)``, None of a structure."""

    name: str
    variables: tuple[Variable, ...]
    code: CodeType | None = None
    is_function: bool = False


def _binary(sign: str) -> Callable[..., str]:
    return lambda self, left, right: f"({left} {sign} {right})"


def _inner(lines: list[str]) -> list[str]:
    return [f"    {line}" for line in lines or ["pass"]]


@v_args(inline=True)
class _Python(Transformer[Any, Any]):
    """Expressions become text, statements lists of lines, and what is declared a unit by its name."""

    or_, and_, eq, ne, gt, lt = map(_binary, ("|", "&", "==", "!=", ">", "<"))
    ge, le, add, sub, mul, mod = map(_binary, (">=", "<=", "+", "-", "*", "%"))

    def div(self, left: str, right: str) -> str:
        return f"_divided({left}, {right})"

    def not_(self, value: str) -> str:
        return f"(not {value})"

    def neg(self, value: str) -> str:
        return f"(-{value})"

    def true(self) -> str:
        return "True"

    def false(self) -> str:
        return "False"

    def literal(self, text: str) -> str:
        base, _, value = text.rpartition("#")
        if base == "16":
            return f"0x{value}"
        return str(float(value[:-2]) / 1000 if value.endswith("ms") else float(value[:-1])) if base else value

    def variable(self, name: str) -> str:
        return f"v.{name}"

    def member(self, whole: str, name: str) -> str:
        return f"{whole}.{name}"

    def element(self, whole: str, index: str) -> str:
        return f"{whole}[{index}]"

    def named(self, name: str, value: str) -> str:
        return f"{name}={value}"

    def call(self, name: str, *arguments: str | None) -> str:
        return f"_call['{name}']({', '.join(filter(None, arguments))})"

    def do(self, name: str, *arguments: str | None) -> list[str]:
        return [f"v.{name}({', '.join(filter(None, arguments))})"]

    def assign(self, variable: str, value: str) -> list[str]:
        return [f"{variable} = _copy({value})"]  # a structure is assigned by value

    def leave(self) -> list[str]:
        return ["return"]

    def body(self, *statements: list[str]) -> list[str]:
        return [line for statement in statements for line in statement]

    def branch(self, condition: str, lines: list[str]) -> list[str]:
        return [f"if {condition}:", *_inner(lines)]

    def choice(self, first: list[str], *others: list[str] | None) -> list[str]:
        *more, last = others
        lines = [*first, *(line for head, *rest in filter(None, more) for line in (f"el{head}", *rest))]
        return lines if last is None else [*lines, "else:", *_inner(last)]

    def cases(self, value: str, *cases: Any) -> list[str]:
        lines = [f"_case = {value}"]
        for label, body in zip(cases[::2], cases[1::2], strict=True):
            lines += [f"{'if' if len(lines) == 1 else 'elif'} _case == {label}:", *_inner(body)]
        return lines

    def array(self, first: str, last: str, each: str) -> Array:
        return Array(int(first), int(last), each)

    def declaration(self, name: str, kind: str | Array, first: str | None) -> Variable:
        return Variable(str(name), kind, first)

    def section(self, *declared: Variable) -> tuple[Variable, ...]:
        return declared

    def structure(self, name: str, *members: Variable) -> Unit:
        return Unit(str(name), members)

    def function(self, name: str, kind: str, *parts: Any) -> Unit:
        return self._unit(name, ((Variable(str(name), kind, None),), *parts), is_function=True)

    def block(self, name: str, *parts: Any) -> Unit:
        return self._unit(name, parts)

    def _unit(self, name: str, parts: Any, is_function: bool = False) -> Unit:
        *sections, lines = parts
        source = "\n".join(["def body(v):", *_inner(lines)])
        variables = tuple(variable for section in sections for variable in section)
        return Unit(str(name), variables, compile(source, str(name), "exec"), is_function)

    def start(self, *units: Unit) -> dict[str, Unit]:
        return {unit.name: unit for unit in units}


class Declared(SimpleNamespace):
    """Variables: one that was not declared cannot be assigned either."""

    def __setattr__(self, name: str, value: Any) -> None:
        if name not in self.__dict__:
            raise NameError(f"{name} is not declared")
        super().__setattr__(name, value)


@lru_cache
def parsed(source: str) -> dict[str, Unit]:
    """The source's structures, functions and blocks by name."""
    return Lark(GRAMMAR.read_text(), parser="lalr", transformer=_Python()).parse(source)  # type: ignore[return-value]  # what the transformer makes of it


class Program:
    """A source's function block, to be called; ``v`` are its variables."""

    def __init__(self, source: str, block: str, clock: Callable[[], float]) -> None:
        self._clock, self._units = clock, parsed(source)
        self._call: dict[str, Callable[..., Any]] = _conversions() | {"EXPT": pow}
        self._call |= {name: self._function(unit) for name, unit in self._units.items() if unit.is_function}
        self.v = self._variables(self._units[block])()
        self._body = self._loaded(self._units[block])

    def __call__(self, **inputs: Any) -> None:
        for name, value in inputs.items():
            setattr(self.v, name, value)
        self._body(self.v)

    def _function(self, unit: Unit) -> Callable[..., Any]:
        body, variables = self._loaded(unit), self._variables(unit)

        def call(**inputs: Any) -> Any:
            v = variables()
            for name, value in inputs.items():
                setattr(v, name, value)
            body(v)
            return getattr(v, unit.name)

        return call

    def _loaded(self, unit: Unit) -> Callable[[Any], None]:
        space: dict[str, Any] = {"_call": self._call, "_divided": _divided, "_copy": _copy}
        assert unit.code is not None
        exec(unit.code, space)
        body: Callable[[Any], None] = space["body"]
        return body

    def _variables(self, unit: Unit) -> Callable[[], Declared]:
        """Makes its variables as they are at first."""
        makers = {variable.name: self._first(variable.kind, variable.first) for variable in unit.variables}
        return lambda: Declared(**{name: make() for name, make in makers.items()})

    def _first(self, kind: str | Array, value: str | None) -> Callable[[], Any]:
        if isinstance(kind, Array):
            each, indices = self._first(kind.each, None), range(kind.first, kind.last + 1)
            return lambda: {index: each() for index in indices}
        if kind == "TON":
            return lambda: Ton(self._clock)
        if kind in self._units:
            return self._variables(self._units[kind])
        known = eval(value) if value else False if kind == "BOOL" else 0
        return lambda: known


def _copy(value: Any) -> Any:
    if isinstance(value, Declared):
        return Declared(**{name: _copy(each) for name, each in vars(value).items()})
    return {key: _copy(each) for key, each in value.items()} if isinstance(value, dict) else value
