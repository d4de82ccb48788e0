"""What is written to CCD heads and understood from them: the manuals' own bytes, in any pieces, through any noise."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_bridge.wire.ccd_dialects import (
    DALSA,
    DIALECTS,
    JAI,
    MAX_TEXT_BYTES,
    Answer,
    AnswerReader,
    Command,
    CommandReader,
    Dialect,
    Verdict,
)

COMMANDS = [
    (DALSA, Command("set", 5500), b"set 5500\r"),
    (DALSA, Command("set", 18.475), b"set 18.475\r"),
    (DALSA, Command("set", 1e6), b"set 1000000\r"),
    (DALSA, Command("set"), b"get set\r"),
    (DALSA, Command("sem", 2), b"sem 2\r"),
    (JAI, Command("PE", 5500), b"PE=5500\r\n"),
    (JAI, Command("PE"), b"PE?\r\n"),
    (JAI, Command("TR", 1), b"TR=1\r\n"),
]

ANSWERS = [
    (DALSA, b"\r\nOK >", Answer(Verdict.DONE)),
    (DALSA, b"OK>", Answer(Verdict.DONE)),
    (DALSA, b"\r\n5500\r\nOK >", Answer(Verdict.DONE, value=5500.0)),
    (DALSA, b"5500.25\r\n>", Answer(Verdict.VALUE, value=5500.25)),
    (DALSA, b"\r\nError 02: Unrecognized command>", Answer(Verdict.ERROR, 2, "Unrecognized command")),
    (DALSA, b"\r\nError 2: Not OK >", Answer(Verdict.ERROR, 2, "Not OK")),
    (DALSA, b"Warning 03: Clipped to max>", Answer(Verdict.WARNING, 3, "Clipped to max")),
    (JAI, b"COMPLETE\r\n", Answer(Verdict.DONE)),
    (JAI, b"01 Unknown Command!!\r\n", Answer(Verdict.ERROR, 1, "Unknown Command!!")),
    (JAI, b"02 Bad Parameters!!\r\n", Answer(Verdict.ERROR, 2, "Bad Parameters!!")),
    (JAI, b"PE=5500\r\n", Answer(Verdict.VALUE, name="PE", value=5500.0)),
    (JAI, b"TR=1(0x1)\r\n", Answer(Verdict.VALUE, name="TR", value=1.0)),
]

NOISE = [
    b"",
    b"\x00\xff",
    b"#!\r\n",
    b"garbage\r\n",
    b"\xc3\x28 >\r\n",
    b"=?=\r\r\n\n",
    b"1 2 3\r\n",
    b"\x07" * 500 + b"\r\n",
]


def _per_byte(data: bytes) -> list[bytes]:
    return [bytes((byte,)) for byte in data]


@pytest.mark.parametrize(("dialect", "command", "sent"), COMMANDS, ids=lambda value: repr(value)[:40])
def test_commands_are_the_manuals(dialect: Dialect, command: Command, sent: bytes) -> None:
    assert dialect.encode(command) == sent
    assert dialect.decode(sent.strip()) == command
    assert dialect.decode(sent.strip().lower()) == dialect.decode(sent.strip().upper()) == command


@pytest.mark.parametrize(("dialect", "sent", "answer"), ANSWERS, ids=lambda value: repr(value)[:40])
def test_answers_are_understood_byte_by_byte_through_noise(dialect: Dialect, sent: bytes, answer: Answer) -> None:
    for before, after in itertools.product(NOISE, NOISE):
        for pieces in ([before, sent, after, sent], _per_byte(before + sent + after + sent)):
            reader = AnswerReader(dialect)
            last = [each for piece in pieces for each in reader.receive(piece)][-1]
            assert (last.verdict, last.code, last.text, last.name) == (
                answer.verdict,
                answer.code,
                answer.text,
                answer.name,
            ), (before, after)
            assert last.value == answer.value


@pytest.mark.parametrize("dialect", DIALECTS.values(), ids=DIALECTS)
def test_every_answer_that_is_written_is_read(dialect: Dialect) -> None:
    written = [Answer(Verdict.DONE), Answer(Verdict.VALUE, name=dialect.exposure, value=1234.0)]
    written += [dialect.message(verdict, code) for verdict, code in dialect.messages]
    reader = AnswerReader(dialect)
    read = reader.receive(b"".join(map(dialect.encode_answer, written)))
    assert [(a.code, a.text, a.value) for a in read] == [(a.code, a.text, a.value) for a in written]
    assert not reader.pending


@pytest.mark.parametrize("dialect", DIALECTS.values(), ids=DIALECTS)
def test_the_table_holds_together(dialect: Dialect) -> None:
    assert {"Off", "Line0"} <= set(dialect.modes)
    assert dialect.exposure_min_us < dialect.exposure_max_us
    assert dialect.sources
    assert all(dialect.unconfirmed.values())
    assert {(Verdict.ERROR, dialect.unknown_command), (Verdict.ERROR, dialect.bad_value)} <= set(dialect.messages)
    assert {(Verdict.WARNING, code) for code in dialect.clipped.values()} <= set(dialect.messages)
    for name in dialect.names:
        value = Answer(Verdict.VALUE, name=name, value=1.0)
        assert [a.value for a in AnswerReader(dialect).receive(dialect.encode_answer(value))] == [1.0]


def test_half_an_answer_is_pending() -> None:
    reader = AnswerReader(DALSA)
    assert reader.receive(b"\r\nO") == []
    assert reader.pending
    assert reader.receive(b"K >") == [Answer(Verdict.DONE)]
    assert not reader.pending


def test_lines_of_command_in_any_pieces() -> None:
    sent = b"\nset 5\r\x00\rget set\r"
    reader = CommandReader(DALSA)
    assert [line for byte in _per_byte(sent) for line in reader.receive(byte)] == [b"set 5", b"\x00", b"get set"]
    assert DALSA.decode(b"set") is None
    assert DALSA.decode(b"set x") is None
    assert DALSA.decode(b"get gcp") is None
    assert JAI.decode(b"PE=") is None


def test_text_without_end_is_forgotten() -> None:
    reader = AnswerReader(JAI)
    for _ in range(20):
        assert reader.receive(b"x" * MAX_TEXT_BYTES) == []
    assert reader.receive(b"\r\nCOMPLETE\r\n") == [Answer(Verdict.DONE)]


PIECES = st.lists(
    st.one_of(
        st.binary(max_size=40),
        st.sampled_from([b"\r", b"\n", b">", b"OK", b"Error 1", b"COMPLETE", b"PE=", b"0" * 40, b" " * 40, b"02 Bad"]),
    ),
    max_size=12,
)


@pytest.mark.parametrize("dialect", DIALECTS.values(), ids=DIALECTS)
@settings(max_examples=40, deadline=None)
@given(pieces=PIECES)
def test_random_streams_do_no_harm(dialect: Dialect, pieces: list[bytes]) -> None:
    answers, commands = AnswerReader(dialect), CommandReader(dialect)
    for piece in pieces:
        answers.receive(piece)
        for line in commands.receive(piece):
            dialect.decode(line)
    good = dialect.encode_answer(Answer(Verdict.DONE))
    assert answers.receive(dialect.answer_end + good)[-1].verdict is Verdict.DONE
