"""Worked examples for the integrator: whole Modbus TCP messages, each byte explained. Pure.

Requests are put together from the register table; answers are what the station's own slave says to them on paper. A
test sends the same requests over TCP to a running server and compares every byte but those of :data:`MOVING`.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from firmware_bridge.wire.modbus import IllegalValue, Slave
from firmware_bridge.wire.modbus_frames import TcpSession
from inspector.handshake_table import Answer, Control
from inspector.line_statistics import Rule, Spread, Statistics, TooLittle, Trend
from inspector.model import Defect, PlcSide, Reason, Snapshot, State, Verdict
from inspector.publish.plc_registers import ServedRegisters
from inspector.publish.published_image import PublishedImage
from inspector.publish.registers import (
    CONTROL_ADDRESS,
    REGISTERS,
    RESULT_ADDRESS,
    RESULT_WORDS,
    Image,
    Register,
    decode,
    decode_control,
    encode_image,
)
from inspector.publish.statistics_registers import STATISTICS_ADDRESS
from inspector.publish.wire_fields import WordOrder

UNIT = 1
AT = {row.name: row for row in REGISTERS}
MOVING = ("heartbeat", "result_age_ms", "statistics_age_ms")
"""Registers that move with time: an answer of a running station differs in these."""
_MBAP = struct.Struct(">HHHB")
_NAMES = {1: "illegal function", 2: "illegal address", 3: "illegal value"}

STATISTICS = Statistics(
    at_s=0.0, recipe_id=7, inspected=True, too_little=TooLittle(0), panels=812, panels_not_inspected=3,
    not_inspected_share=0.0, count=9, per_m2=45.0, recent_panels=50, recent_per_panel=6.2, recent_per_m2=31.0,
    baseline_per_m2=15.0, baseline_is_doubtful=False, ratio=2.07, upper_per_m2=40.0, lower_per_m2=0.0,
    overdispersion=1.0, ewma=1.2, ewma_limit=0.9, cusum_above=9.5, cusum_below=0.0, cusum_limit=8.0, median_um=210.0,
    p95_um=640.0, largest_um=1828.0, large_share=0.12, mean_height=0.4, trend=Trend.RISING, trend_percent=35.0,
    spread=Spread.RANDOM, spread_index=1.02, repeated=None, alarm=True, rule=Rule.CUSUM_ABOVE, run_rule=0,
    alarm_text="", panels_since_change=18, action=1, confidence=0.8,
)  # fmt: skip

SHOWN = Snapshot(
    state=State.READY,
    sequence=42,
    acquisition_id=0x0001_0002,
    panel_id=70_000,
    recipe_id=7,
    verdict=Verdict.FAIL,
    reasons=Reason.HEIGHT_LIMIT,
    defects=(Defect(12.34, -5.6, 1827.6, 9.0, (0.0, 0.0), (0.0, 0.0)),),
    result_at_s=0.0,
    lamp_ok=True,
    camera_ok=True,
    lamp_set_v=3.7,
    lamp_read_v=3.698,
    exposure_us=1000,
    plc=PlcSide(int(Answer.ONLINE | Answer.TRIGGER_READY | Answer.RESULT_AVAILABLE)),
    statistics=STATISTICS,
    statistics_sequence=42,
)
"""What the station of the examples shows."""


@dataclass(frozen=True, slots=True)
class Exchange:
    """One request; ``order`` is the station's `plc.word_order`."""

    title: str
    text: str
    request: bytes
    order: WordOrder = "high_first"


def _adu(transaction: int, pdu: bytes) -> bytes:
    return _MBAP.pack(transaction, 0, len(pdu) + 1, UNIT) + pdu


def _read(transaction: int, function: int, address: int, count: int) -> bytes:
    return _adu(transaction, struct.pack(">BHH", function, address, count))


def _write_many(transaction: int, address: int, *words: int) -> bytes:
    head = struct.pack(">BHHB", 16, address, len(words), 2 * len(words))
    return _adu(transaction, head + struct.pack(f">{len(words)}H", *words))


def _read_one(transaction: int, name: str) -> bytes:
    return _read(transaction, 3, AT[name].address, AT[name].words)


PANEL_ID = 70_001
_CONTROL = AT["control"].address
_NEXT_PANEL = (int(Control.TRIGGER | Control.BUFFER_RESULTS), 0, PANEL_ID >> 16, PANEL_ID & 0xFFFF)
_TAKEN = (int(Control.RESULTS_ACK | Control.BUFFER_RESULTS), SHOWN.sequence)

EXCHANGES = (
    Exchange(
        "Read the result block, function 4",
        "One read is one whole result. Registers that read 0 because there is nothing to say are left out below.",
        _read(1, 4, RESULT_ADDRESS, RESULT_WORDS),
    ),
    Exchange(
        "Read its head, function 3",
        "Holding registers mirror input registers. A part of the block is whole in itself too, but two such reads may"
        " be of two results.",
        _read(2, 3, RESULT_ADDRESS, AT["largest_height_um_f32"].address + 2),
    ),
    Exchange(
        "Write one control register, function 6",
        "BUFFER_RESULTS: from now on each result is kept until it is acknowledged. The answer repeats the request.",
        _adu(3, struct.pack(">BHH", 6, _CONTROL, Control.BUFFER_RESULTS)),
    ),
    Exchange(
        "Trigger with a panel's id, function 16",
        f"TRIGGER and BUFFER_RESULTS, acknowledged_sequence 0, control_panel_id {PANEL_ID} in two registers, the high"
        " word first: bit and number in one write.",
        _write_many(4, _CONTROL, *_NEXT_PANEL),
    ),
    Exchange(
        "Acknowledge a result, function 16",
        f"RESULTS_ACK with the sequence {SHOWN.sequence} of the result that was read.",
        _write_many(5, _CONTROL, *_TAKEN),
    ),
    Exchange(
        "Read the statistics, function 3",
        "The first 20 registers; all there are, in one read too, are 125.",
        _read(6, 3, STATISTICS_ADDRESS, 20),
    ),
    Exchange("A float32, high word first", "`plc.word_order: high_first`.", _read_one(7, "largest_height_um_f32")),
    Exchange(
        "A float32, low word first",
        "`plc.word_order: low_first`: the two registers change places, the bytes in each do not.",
        _read_one(7, "largest_height_um_f32"),
        "low_first",
    ),
    Exchange("A u32, high word first", "`plc.word_order: high_first`.", _read_one(8, "panel_id")),
    Exchange("A u32, low word first", "`plc.word_order: low_first`.", _read_one(8, "panel_id"), "low_first"),
    Exchange(
        "A read that goes past the block",
        "Never a short answer: exception 2, and nothing was read.",
        _read(9, 3, RESULT_ADDRESS + RESULT_WORDS - 1, 2),
    ),
    Exchange(
        "A reserved control bit",
        "Exception 3, and nothing was written.",
        _adu(10, struct.pack(">BHH", 6, _CONTROL, 0x8000)),
    ),
    Exchange(
        "A write to what can only be read", "Exception 2.", _adu(11, struct.pack(">BHH", 6, AT["verdict"].address, 1))
    ),
)


def answer(exchange: Exchange) -> bytes:
    """What the station says, on paper."""

    def on_control(address: int, words: Sequence[int]) -> None:
        at = address - CONTROL_ADDRESS
        try:
            decode_control([*[0] * at, *words, *[0] * 16][:16], exchange.order)
        except ValueError as error:
            raise IllegalValue from error

    published = PublishedImage()
    published.show(image(exchange.order))
    return TcpSession(Slave({UNIT: ServedRegisters(published, on_control)})).receive(exchange.request)


def image(order: WordOrder) -> Image:
    """The station's registers: two seconds after it started, 1.5 s after the result."""
    return encode_image(SHOWN, now_s=1.5, heartbeat=2, word_order=order)


def moving_bytes(exchange: Exchange) -> set[int]:
    """Places in the answer that differ from one moment to the next."""
    function, address, count = struct.unpack_from(">BHH", exchange.request, _MBAP.size)
    if function not in (3, 4):
        return set()
    words = {AT[name].address + i for name in MOVING for i in range(AT[name].words)}
    here = {word - address for word in words if address <= word < address + count}
    return {_MBAP.size + 2 + 2 * word + byte for word in here for byte in (0, 1)}


def as_markdown() -> str:
    """The page."""
    return _PAGE.format(moving=", ".join(MOVING), examples="\n\n".join(_told(exchange) for exchange in EXCHANGES))


def _told(exchange: Exchange) -> str:
    said = answer(exchange)
    rows = "\n".join(
        f"| {side} | `{data.hex(' ')}` | {meaning} |"
        for side, parts in (("request", _request_parts(exchange.request)), ("answer", _answer_parts(exchange, said)))
        for data, meaning in parts
    )
    wire = f"request  {_lines(exchange.request)}\nanswer   {_lines(said)}"
    table = f"| in | bytes | what |\n| --- | --- | --- |\n{rows}"
    return f"## {exchange.title}\n{exchange.text}\n\n```\n{wire}\n```\n\n{table}"


def _lines(data: bytes, width: int = 32) -> str:
    return "\n         ".join(data[i : i + width].hex(" ") for i in range(0, len(data), width))


Parts = Iterator[tuple[bytes, str]]


def _head(adu: bytes) -> Parts:
    transaction, _, length, unit = _MBAP.unpack_from(adu)
    yield adu[0:2], f"transaction {transaction}, the client's own; the answer repeats it"
    yield adu[2:4], "protocol 0: Modbus"
    yield adu[4:6], f"length: {length} bytes follow"
    yield adu[6:7], f"unit {unit}"


def _request_parts(adu: bytes) -> Parts:
    yield from _head(adu)
    function, address, number = struct.unpack_from(">BHH", adu, 7)
    yield adu[7:8], f"function {function}"
    yield adu[8:10], f"address {address}"
    if function == 6:
        yield from _values(adu[10:12], address, "high_first", whole=True)
        return
    yield adu[10:12], f"{number} registers"
    if function == 16:
        yield adu[12:13], f"{adu[12]} bytes follow"
        yield from _values(adu[13:], address, "high_first", whole=True)


def _answer_parts(exchange: Exchange, adu: bytes) -> Parts:
    yield from _head(adu)
    function, address = adu[7], struct.unpack_from(">H", exchange.request, 8)[0]
    if function & 0x80:
        yield adu[7:8], f"function {function & 0x7F} + 128: an exception"
        yield adu[8:9], f"exception {adu[8]}: {_NAMES[adu[8]]}"
        return
    yield adu[7:8], f"function {function}"
    if function in (6, 16):
        yield adu[8:10], f"address {address}"
        yield adu[10:12], "the value as written" if function == 6 else f"{adu[11]} registers were written"
        return
    yield adu[8:9], f"{adu[8]} bytes follow"
    yield from _values(adu[9:], address, exchange.order, whole=False)


def _values(data: bytes, address: int, order: WordOrder, *, whole: bool) -> Parts:
    """Each register of a stretch with its value; zeros only where ``whole``, or at the stretch's first."""
    words = struct.unpack(f">{len(data) // 2}H", data)
    values = decode(words, address, order)
    for row in (AT[name] for name in values):
        at = 2 * (row.address - address)
        raw = data[at : at + 2 * row.words]
        if whole or any(raw):
            yield raw, f"{row.address} `{row.name}` = {_number(row, values[row.name])}"


def _number(row: Register, value: float | None) -> str:
    if value is None:
        return "no value"
    unit = "" if row.unit in ("id", "code", "tick", "bits", "count", "1") else f" {row.unit}"
    return f"0x{int(value):04X}" if row.unit == "bits" else f"{value:.10g}{unit}"


_PAGE = """\
# Messages byte by byte

Whole Modbus TCP messages, for whoever looks at the wire or writes a client. Made from the register table by
`inspector plc-package`; a test sends these requests to a running station and compares the answers byte by byte. What
moves with time ({moving}) reads otherwise. Addresses are zero-based, numbers in bytes big-endian.

{examples}
"""
