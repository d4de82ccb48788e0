"""What serial CCD heads speak, as tables: a new dialect is a new row here and a test run.

Both ends speak through this: commands are written and read, answers are written and read. Nothing here waits; bytes
may come in any pieces, with noise before, between and after, and the next whole answer is understood again. What no
manual confirmed is listed in ``unconfirmed`` with where it came from, so that a bench check changes one row.
"""

from __future__ import annotations

import enum
import re
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

MAX_TEXT_BYTES = 4096
"""More than the longest screen of settings: text that goes on for longer has no end, and is noise."""


class Verdict(enum.StrEnum):
    """What an answer says about the command."""

    DONE = "done"
    WARNING = "warning"
    ERROR = "error"
    VALUE = "value"


@dataclass(frozen=True, slots=True)
class Answer:
    """A head's answer. ``value`` is in the head's own counts; ``name`` is the setting it is of, empty if not said."""

    verdict: Verdict
    code: int | None = None
    text: str = ""
    name: str = ""
    value: float | None = None


@dataclass(frozen=True, slots=True)
class Command:
    """A setting to be written (``value`` in the head's counts) or asked for (None)."""

    name: str
    value: float | None = None


@dataclass(frozen=True, slots=True)
class Dialect:
    """How a family of heads is spoken to.

    ``write_form`` and ``read_form`` are its two commands. ``answers`` are tried in turn on an answer's last line, with
    the groups code, text, name and value where they have them; a number alone on the line before is the value.
    ``messages`` are the head's texts by (verdict, code). ``clipped`` are the warnings by which a head says that it took
    another value. ``exposure`` is the name of the exposure time's setting, ``rounding_us`` how far a head may round it;
    ``modes`` are the settings that make each trigger mode, by SFNC name (Off: the head runs freely).
    """

    name: str
    sources: tuple[str, ...]
    command_end: bytes
    write_form: str
    read_form: str
    answer_start: str
    answer_end: bytes
    answers: Mapping[Verdict, re.Pattern[str]]
    answer_forms: Mapping[Verdict, str]
    messages: Mapping[tuple[Verdict, int], str]
    unknown_command: int
    bad_value: int
    exposure: str
    exposure_min_us: float
    exposure_max_us: float
    exposure_decimals: int
    rounding_us: float
    modes: Mapping[str, Mapping[str, int]]
    clipped: Mapping[str, int]
    unconfirmed: Mapping[str, str]
    baud: int = 9600

    @property
    def names(self) -> frozenset[str]:
        """The settings that are used."""
        return frozenset({self.exposure}).union(*self.modes.values())

    def encode(self, command: Command) -> bytes:
        """A command's bytes. A value is written with no more decimals than the head takes."""
        form = self.read_form if command.value is None else self.write_form
        return form.format(name=command.name, value=self.number(command.value or 0.0)).encode() + self.command_end

    def number(self, value: float) -> str:
        """A value as the head writes and reads it, without needless zeros."""
        text = f"{value:.{self.exposure_decimals}f}"
        return text.rstrip("0").rstrip(".") if "." in text else text

    def decode(self, line: bytes) -> Command | None:
        """The command in a line without its end; None if it is none of the used settings'."""
        text = line.decode("ascii", "replace").strip()
        for form, has_value in ((self.read_form, False), (self.write_form, True)):
            found = re.fullmatch(_pattern(form), text, re.IGNORECASE)
            name = found and _known(found["name"], self.names)
            if found and name:
                return Command(name, float(found["value"]) if has_value else None)
        return None

    def encode_answer(self, answer: Answer) -> bytes:
        """An answer's bytes, for the head's side of the wire."""
        value = "" if answer.value is None else self.number(answer.value)
        form = self.answer_forms[answer.verdict]
        text = form.format(code=answer.code, text=answer.text, name=answer.name, value=value)
        return (self.answer_start + text).encode() + self.answer_end

    def decode_answer(self, text: bytes) -> Answer | None:
        """The answer in a text without its end; None if it is noise."""
        lines = [line.strip() for line in text.decode("ascii", "replace").splitlines() if line.strip()]
        for verdict, pattern in self.answers.items():
            if lines and (found := pattern.fullmatch(lines[-1])):
                groups = found.groupdict()
                value = groups.get("value") or (lines[-2] if len(lines) > 1 and _NUMBER.fullmatch(lines[-2]) else None)
                return Answer(
                    verdict,
                    int(groups["code"]) if "code" in groups else None,
                    groups.get("text", ""),
                    groups.get("name", ""),
                    None if value is None else float(value),
                )
        return None

    def message(self, verdict: Verdict, code: int) -> Answer:
        """A warning or an error of the table."""
        return Answer(verdict, code, self.messages[verdict, code])


class AnswerReader:
    """Bytes from a head in any pieces -> answers. ``pending`` tells whether something has come that is no answer."""

    def __init__(self, dialect: Dialect) -> None:
        self._dialect = dialect
        self._text = bytearray()
        self.pending = False

    def receive(self, data: bytes) -> list[Answer]:
        """The answers that these bytes complete; what is no answer is dropped."""
        texts = _split(self._text, data, self._dialect.answer_end)
        answers = [answer for text in texts if (answer := self._dialect.decode_answer(text))]
        self.pending = bool(self._text) or len(answers) < len(texts)
        return answers


class CommandReader:
    """Bytes to a head in any pieces -> lines of command."""

    def __init__(self, dialect: Dialect) -> None:
        self._dialect = dialect
        self._text = bytearray()

    def receive(self, data: bytes) -> list[bytes]:
        """The lines that these bytes complete, without their ends; empty ones are left out."""
        lines = _split(self._text, data, self._dialect.command_end)
        return [line.strip() for line in lines if line.strip()]


def _split(text: bytearray, data: bytes, end: bytes) -> list[bytes]:
    """Add bytes to a text and take away what ``end`` completes; the text never grows beyond what makes sense."""
    text += data
    *whole, rest = bytes(text).split(end)
    text[:] = rest[-MAX_TEXT_BYTES:]
    return [piece[-MAX_TEXT_BYTES:] for piece in whole]


def _pattern(form: str) -> str:
    """The pattern of what a command's form writes."""
    escaped = re.escape(form).replace(r"\{", "{").replace(r"\}", "}").replace(r"\ ", r" +")
    return escaped.format(name=r"(?P<name>[A-Za-z][A-Za-z0-9]*)", value=r"(?P<value>[-+]?\d{1,12}(?:\.\d{1,6})?)")


def _known(name: str, names: frozenset[str]) -> str | None:
    """The setting that a name means: heads take capital and small letters alike."""
    return next((known for known in names if known.lower() == name.lower()), None)


_NUMBER = re.compile(r"[-+]?\d{1,12}(?:\.\d{1,6})?")
"""A number as heads write it; twelve digits hold every exposure in microseconds."""


DALSA = Dialect(
    name="dalsa",
    sources=(
        "DALSA Falcon XDR and HG Series Camera User's Manual, 3 (protocol), 3.7 (sem, set, get set)",
        "DALSA Falcon 4M Camera Manual 03-032-20044-01, 3 and 3.4 (set: 10 to 999989 us; increments to 45.6 us)",
        "DALSA Piranha HN User Manual 03-032-20135-00, Appendix A (warnings and errors)",
    ),
    command_end=b"\r",
    write_form="{name} {value}",
    read_form="get {name}",
    answer_start="\r\n",
    answer_end=b">",
    # Stray bytes before the first letter do no harm; a word that is half another's is none.
    answers=MappingProxyType(
        {
            Verdict.ERROR: re.compile(r"\W*Error (?P<code>\d{1,3}): ?(?P<text>.*)"),
            Verdict.WARNING: re.compile(r"\W*Warning (?P<code>\d{1,3}): ?(?P<text>.*)"),
            Verdict.DONE: re.compile(r"\W*OK"),
            Verdict.VALUE: re.compile(rf"\W*?(?P<value>{_NUMBER.pattern})"),
        }
    ),
    answer_forms=MappingProxyType(
        {
            Verdict.ERROR: "Error {code:02d}: {text}",
            Verdict.WARNING: "Warning {code:02d}: {text}",
            Verdict.DONE: "OK ",
            Verdict.VALUE: "{value}\r\nOK ",
        }
    ),
    messages=MappingProxyType(
        {
            (Verdict.WARNING, 1): "Outside of specification",
            (Verdict.WARNING, 2): "Clipped to min",
            (Verdict.WARNING, 3): "Clipped to max",
            (Verdict.WARNING, 4): "Related parameters adjusted",
            (Verdict.ERROR, 2): "Unrecognized command",
            (Verdict.ERROR, 3): "Incorrect number of parameters",
            (Verdict.ERROR, 4): "Incorrect parameter value",
        }
    ),
    unknown_command=2,
    bad_value=4,
    exposure="set",
    exposure_min_us=1.0,
    exposure_max_us=1e6,
    exposure_decimals=3,
    rounding_us=45.6,
    modes=MappingProxyType({"Off": MappingProxyType({"sem": 2}), "Line0": MappingProxyType({"sem": 6})}),
    clipped=MappingProxyType({"low": 2, "high": 3}),
    unconfirmed=MappingProxyType(
        {
            "the answer to get": "a number, then OK: the manuals name the command and show no answer; both with OK and "
            "without are understood",
            "Error 04": "the text beside the number: the list seen ends at 03",
            "exposure range": "1 us to 1 s is the line camera's sensor; Falcon XDR 40 to 4000000 us, Falcon 4M 10 to "
            "999989 us: set the head's own in the station's settings",
        }
    ),
)

JAI = Dialect(
    name="jai",
    sources=(
        "JAI GO-5000M-PMCL-UV User Manual 1.1, Short ASCII Command Communication Protocol (NN=v, NN?, answers)",
        "JAI CM-030PMCL-RH manual, 7.4 command list (SM=1 programmable, PE, TR=0 normal, TR=1 EPS)",
    ),
    command_end=b"\r\n",
    write_form="{name}={value}",
    read_form="{name}?",
    answer_start="",
    answer_end=b"\r\n",
    # A head's line has no mark where it begins: noise may stand before the words, on the same line.
    answers=MappingProxyType(
        {
            Verdict.ERROR: re.compile(r".*?(?P<code>0\d) (?P<text>[A-Za-z ]{1,40}!!)"),
            Verdict.DONE: re.compile(r".*COMPLETE"),
            Verdict.VALUE: re.compile(rf".*?(?P<name>PE|SM|TR)=(?P<value>{_NUMBER.pattern})(?:\(0x[0-9A-Fa-f]+\))?"),
        }
    ),
    answer_forms=MappingProxyType(
        {Verdict.ERROR: "{code:02d} {text}", Verdict.DONE: "COMPLETE", Verdict.VALUE: "{name}={value}"}
    ),
    messages=MappingProxyType({(Verdict.ERROR, 1): "Unknown Command!!", (Verdict.ERROR, 2): "Bad Parameters!!"}),
    unknown_command=1,
    bad_value=2,
    exposure="PE",
    exposure_min_us=1.0,
    exposure_max_us=1e6,
    exposure_decimals=0,
    rounding_us=1.0,
    modes=MappingProxyType(
        {"Off": MappingProxyType({"SM": 1, "TR": 0}), "Line0": MappingProxyType({"SM": 1, "TR": 1})}
    ),
    clipped=MappingProxyType({}),
    unconfirmed=MappingProxyType(
        {
            "PE in microseconds": "CM-030, CM-140 and CM-200 count lines (2 to 511, 1052 or 1252): set us_per_count to "
            "a line's time; AM-800 gives its exposure limits in us (10 to 1048575)",
            "exposure range": "1 us to 1 s is the line camera's sensor: set the head's own in the station's settings",
            "SM and TR": "CM series; later heads have EM and TM instead, and refuse these with 01",
        }
    ),
)

DIALECTS: Mapping[str, Dialect] = MappingProxyType({dialect.name: dialect for dialect in (DALSA, JAI)})
"""All that are spoken, by name."""
