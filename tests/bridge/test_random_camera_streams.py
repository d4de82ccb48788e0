"""What cameras send, fed byte by byte: garbage, cut, damaged and foreign answers and frames before, between and after.

None crashes, nothing grows without end, and what is good is understood again. RANDOM_STREAMS as in
test_random_streams.py.
"""

from __future__ import annotations

import os
import random
from collections.abc import Callable

import numpy as np
import pytest

from firmware_bridge.wire.ccd_dialects import DIALECTS, Answer, AnswerReader, Command, CommandReader, Dialect, Verdict
from firmware_bridge.wire.raw_frames import FrameReader, RawFormat, RawFrame

STREAMS = int(os.environ.get("RANDOM_STREAMS", "500"))
FORM = RawFormat(4, 3, 8, True)

pytestmark = pytest.mark.timeout(4 * 3600 if STREAMS > 10_000 else 120)


def streams(seed: str, good: Callable[[random.Random], bytes]) -> list[tuple[random.Random, bytes]]:
    """Generators and streams of up to six pieces: noise, and good messages whole, cut and with a bit turned."""
    made = []
    for number in range(STREAMS):
        chance = random.Random(f"{seed}/{number}")
        made.append((chance, b"".join(_piece(chance, good(chance)) for _ in range(chance.randrange(6)))))
    return made


def _piece(chance: random.Random, whole: bytes) -> bytes:
    match chance.randrange(4):
        case 0:
            return chance.randbytes(chance.randrange(24))
        case 1:
            return whole[: chance.randrange(len(whole))]
        case 2:
            at = chance.randrange(len(whole))
            return whole[:at] + bytes((whole[at] ^ 1 << chance.randrange(8),)) + whole[at + 1 :]
        case _:
            return whole


def _any_answer(dialect: Dialect) -> Callable[[random.Random], bytes]:
    def make(chance: random.Random) -> bytes:
        verdict, code = chance.choice(sorted(dialect.messages))
        value = Answer(Verdict.VALUE, name=dialect.exposure, value=float(chance.randrange(1, 10**6)))
        answer = chance.choice((value, Answer(Verdict.DONE), dialect.message(verdict, code)))
        speaker = chance.choice((dialect, dialect, *DIALECTS.values()))
        return speaker.encode_answer(answer) if answer.verdict in speaker.answer_forms else chance.randbytes(8)

    return make


@pytest.mark.parametrize("dialect", DIALECTS.values(), ids=DIALECTS)
def test_a_heads_answers(dialect: Dialect) -> None:
    """What is left of the noise may spoil the answer that ends it; the next one is understood."""
    good = dialect.encode_answer(Answer(Verdict.VALUE, name=dialect.exposure, value=1234.0))
    for _, stream in streams("answers", _any_answer(dialect)):
        reader = AnswerReader(dialect)
        for byte in stream + good:
            reader.receive(bytes((byte,)))
        (answer,) = [answer for byte in good for answer in reader.receive(bytes((byte,)))]
        assert answer.value == 1234.0
        assert not reader.pending


@pytest.mark.parametrize("dialect", DIALECTS.values(), ids=DIALECTS)
def test_commands_to_a_head(dialect: Dialect) -> None:
    command = Command(dialect.exposure, 1234.0)
    line = dialect.encode(command)
    for _, stream in streams("commands", lambda _, line=line: line):
        reader = CommandReader(dialect)
        for byte in stream + line:
            for got in reader.receive(bytes((byte,))):
                dialect.decode(got)
        (last,) = [got for byte in line for got in reader.receive(bytes((byte,)))]
        assert dialect.decode(last) == command


def test_frames_with_headers() -> None:
    """A header whose frame was cut takes what follows for its pixels: at most one good frame is lost to it."""

    def frame(number: int) -> bytes:
        return FORM.encode(RawFrame(np.full((3, 4), number % 251, np.uint8), number, 1000.0, 1.0))

    for _, stream in streams("frames", lambda chance: frame(chance.randrange(1, 10**6))):
        reader = FrameReader(FORM)
        found: list[RawFrame] = []
        for byte in stream + frame(7) + frame(8) + frame(9):
            found += reader.receive(bytes((byte,)))
            assert reader.pending_bytes <= FORM.frame_bytes
        assert found
        assert found[-1].number == 9
        assert (found[-1].image == 9).all()
