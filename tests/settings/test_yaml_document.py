"""Reading YAML strictly: every problem with its line, no silent conversions, nothing that hangs or crashes."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import Field

from inspector.recipe import Strict
from inspector.yaml_document import parse, read, validate


class Dog(Strict):
    kind: Literal["dog"]
    legs: int = Field(4, ge=0, le=4)


class Fish(Strict):
    kind: Literal["fish"]
    length_mm: float = Field(gt=0)


class Zoo(Strict):
    name: str = Field("zoo", min_length=1)
    pet: Annotated[Dog | Fish, Field(discriminator="kind")] = Dog(kind="dog")
    shelves: tuple[tuple[int, int], ...] = ()
    depth_mm: float | None = Field(None, le=3)
    colour: Literal["red", "green"] = "red"
    path: Path = Path("x")
    open: bool = True


def problems(text: str) -> list[str]:
    return [str(problem) for problem in validate(parse(text, "f.yaml"), Zoo)[1]]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("nmae: x", "f.yaml:1: nmae: 'x': unknown key (did you mean name?); allowed here: name, pet, shelves"),
        ("\npet: {kind: dog, legs: 5}", "f.yaml:2: pet.legs: 5: allowed: a whole number from 0 to 4"),
        ("pet:\n  kind: dog\n  legs: '3'", "f.yaml:3: pet.legs: '3': allowed: a whole number from 0 to 4"),
        ("pet:\n  kind: fish", "f.yaml:1: pet.length_mm: missing: required; allowed: a number above 0"),
        ("pet: {kind: cat}", "f.yaml:1: pet: {'kind': 'cat'}: allowed: a mapping whose kind is one of: dog, fish"),
        ("pet: {legs: 4}", "f.yaml:1: pet: {'legs': 4}: allowed: a mapping whose kind is one of: dog, fish"),
        ("shelves: [[1, 2], [3, x]]", "f.yaml:1: shelves[1][1]: 'x': allowed: a whole number"),
        ("depth_mm: 4", "f.yaml:1: depth_mm: 4: allowed: a number to 3, or null"),
        ("depth_mm: .nan", "f.yaml:1: depth_mm: nan: allowed: a number to 3, or null"),
        ("colour: blue", "f.yaml:1: colour: 'blue': allowed: one of: red, green"),
        ("open: yes", "f.yaml:1: open: 'yes': allowed: true or false"),
        ("name: ''", "f.yaml:1: name: '': allowed: a text of at least 1 characters"),
        ("name: no", None),
        ("depth_mm: 1e-5", None),
        ("name: 2020-01-01", None),
        ("path: a/b", None),
        ("name: a\nname: b", "f.yaml:2: name: given twice, first at f.yaml:1"),
        ("pet: {kind: dog, kind: fish}", "f.yaml:1: pet.kind: given twice, first at f.yaml:1"),
        ("", "f.yaml: None: allowed: a mapping"),
        ("[1]", "f.yaml:1: [1]: allowed: a mapping"),
        ("name: [", "f.yaml:1:8: not YAML: "),
        ("a: b: c", "f.yaml:1:5: not YAML: "),
        ("--- {}\n--- {}", "f.yaml:2:1: not YAML: "),
        ("name: !!python/object:os.system x", "f.yaml:1:7: not YAML: "),
        ("name: \x00", "f.yaml: not YAML: "),
        ("name: &a [*a]", "f.yaml: not YAML: "),
        ("[" * 5000, "f.yaml: not YAML: "),
    ],
)
def test_each_problem_says_where_what_and_what_is_allowed(text: str, expected: str | None) -> None:
    found = problems(text)
    if expected is None:
        assert found == []
    else:
        (line,) = found
        assert line.startswith(expected)


def test_all_problems_come_at_once() -> None:
    found = problems("nmae: 1\npet: {kind: dog, legs: 9}\ncolour: blue\ncolour: red\nshelves: 3")
    assert [line.split(": ")[1] for line in found] == ["colour", "pet.legs", "shelves", "colour", "nmae"]


def test_a_part_from_another_file_names_that_file() -> None:
    whole = parse("name: a\npet: b.yaml", "a.yaml").including("pet", parse("kind: dog\nlegs: 7", "b.yaml"))
    assert [str(p) for p in validate(whole, Zoo)[1]] == ["b.yaml:2: pet.legs: 7: allowed: a whole number from 0 to 4"]


def test_files_that_cannot_be_read_say_why(tmp_path: Path) -> None:
    (tmp_path / "latin").write_bytes(b"name: gr\xfcn")
    for name, why in (("none", "cannot be read: No such file"), ("latin", "not a text in UTF-8, at byte 8")):
        ((problem),) = read(tmp_path / name).problems
        assert str(problem).startswith(f"{tmp_path / name}: {why}")
    assert read(tmp_path).problems


@given(st.text(alphabet=st.sampled_from("abc:-[]{}&*!|>'\"#\n ,01.~\t%@"), max_size=60))
def test_no_text_crashes_it(text: str) -> None:
    model, found = validate(parse(text, "f"), Zoo)
    assert (model is None) or not found or all("given twice" in str(p) for p in found)
