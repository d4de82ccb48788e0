"""The register map: what is packed is what is read back, nothing small stands for nothing, and lists agree."""

from __future__ import annotations

import csv
import io
import json
import math
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from inspector.cli.app import app
from inspector.handshake_table import Control
from inspector.model import Defect, Flag, Reason, Snapshot, State, Verdict
from inspector.publish import registers
from inspector.publish.registers import REGISTERS, Image, Status, decode, encode, encode_image
from inspector.publish.registers_page import as_csv, as_markdown, as_rows

GENERATED = Path(__file__).parents[2] / "deploy" / "plc"


def words(data: bytes) -> tuple[int, ...]:
    return struct.unpack(f">{len(data) // 2}H", data)


def block(snapshot: Snapshot, now_s: float = 0.0, heartbeat: int = 0) -> dict[str, Any]:
    return decode(words(encode(snapshot, now_s, heartbeat)))


def listed(image: Image) -> dict[str, Any]:
    address, data = image.areas[1]
    return decode(words(data), address)


def seed(height_um: float, sigma_um: float | None = None, x_mm: float = 0.0, flags: int = 0) -> Defect:
    return Defect(x_mm, -x_mm, height_um, sigma_um, (0.0, 0.0), (0.0, 0.0), Flag(flags))


def test_the_first_block_is_one_read_and_closes_as_it_opens() -> None:
    assert len(encode(Snapshot(), 0, 0)) == 250
    assert REGISTERS[0].name == "sequence"
    assert REGISTERS[0].address == 0
    end = next(row for row in REGISTERS if row.name == "sequence_end")
    assert end.address == 124


def test_no_two_registers_share_a_word_or_a_name() -> None:
    taken = [row.address + i for row in REGISTERS for i in range(row.words)]
    assert len(taken) == len(set(taken))
    assert len({row.name for row in REGISTERS}) == len(REGISTERS)


def test_the_map_stays_where_integrators_have_it() -> None:
    """Changing any of these means a new map version."""
    at = {row.name: row.address for row in REGISTERS}
    assert registers.MAP_VERSION == 1
    assert [at[name] for name in ("heartbeat", "state", "status", "fault_code", "verdict")] == [2, 3, 4, 5, 6]
    assert [at[name] for name in ("defect_count", "largest_height_um", "result_age_ms", "lamp_set_mv")] == [
        9,
        11,
        20,
        36,
    ]
    assert [at[name] for name in ("defect_1_x_mm", "defect_12_flags")] == [64, 123]
    assert [at[name] for name in ("handshake", "results_waiting", "command_echo", "command_result")] == [19, 46, 47, 48]
    assert [at[name] for name in ("control", "acknowledged_sequence", "control_panel_id")] == [500, 501, 502]
    assert [at[name] for name in ("command", "command_argument")] == [504, 506]
    assert [at[name] for name in ("operator_control", "operator_command", "operator_argument")] == [600, 604, 606]
    assert [at[f"operator_{name}"] for name in ("handshake", "command_echo", "command_result")] == [616, 617, 618]
    assert [at[name] for name in ("list_sequence", "list_defect_1_x_mm", "list_sequence_end")] == [1000, 1010, 1330]


def test_zeroed_registers_are_no_pass() -> None:
    zeros = decode([0] * 125)
    assert zeros["verdict"] == Verdict.NOT_INSPECTED
    assert not zeros["status"]


def test_golden_bytes() -> None:
    snapshot = Snapshot(
        state=State.CONTINUOUS_EXECUTION,
        sequence=0x12345,
        verdict=Verdict.FAIL,
        reasons=Reason.HEIGHT_LIMIT,
        defects=(seed(1827.6, 9.2, 12.34, Flag.MERGED),),
        result_at_s=1.0,
        lamp_set_v=3.7,
        simulated=True,
    )
    data = encode(snapshot, now_s=2.5, heartbeat=7)
    head = "2345 0001 0007 0004 000b 0000 0002 0001 0000 0001 0000 0724 44e47333"
    assert data[:28] == bytes.fromhex(head)
    assert data[40:44] == bytes.fromhex("000005dc")
    assert data[72:74] == bytes.fromhex("0e74")
    assert data[84:88] == bytes.fromhex("00012345")
    assert data[128:138] == bytes.fromhex("04d2 fb2e 0724 0009 0002")
    assert data[248:] == bytes.fromhex("2345")


def test_word_order_swaps_the_words_of_long_values_only() -> None:
    snapshot = Snapshot(**dict.fromkeys(("sequence", "acquisition_id", "panel_id", "overruns"), 0xABCD1234))
    high = words(encode(snapshot, 70.0, 1))
    low = words(encode(snapshot, 70.0, 1, "low_first"))
    swapped = list(high)
    for row in registers.RESULT_REGISTERS:
        swapped[row.address : row.address + row.words] = high[row.address : row.address + row.words][::-1]
    assert low == tuple(swapped)
    assert decode(low, word_order="low_first") == decode(high)


@settings(max_examples=40)
@given(
    st.lists(st.floats(0, 65534), max_size=70),
    st.integers(0, 2**40),
    st.floats(0, 4e9),
    st.sampled_from(("high_first", "low_first")),
)
def test_what_is_encoded_is_decoded(
    heights_um: list[float], number: int, elapsed_us: float, order: registers.WordOrder
) -> None:
    defects = tuple(seed(h, h / 100, x_mm=(h - 32767) / 100) for h in heights_um)
    snapshot = Snapshot(sequence=number, panel_id=number, defects=defects, elapsed_us=elapsed_us, result_at_s=1.0)
    image = encode_image(snapshot, 3.0, number, order)
    head = decode(words(image.areas[0][1]), 0, order)
    tail = decode(words(image.areas[1][1]), 1000, order)
    ranked = sorted(defects, key=lambda d: -d.height_um)
    assert head["sequence"] == head["sequence_end"] == tail["list_sequence"] == number % 65536
    assert head["panel_id"] == number % 2**32
    assert head["elapsed_us"] == round(elapsed_us)
    assert head["defect_count"] == len(defects)
    assert head["result_age_ms"] == 2000
    for prefix, read, places in (("defect", head, 12), ("list_defect", tail, 64)):
        for i, defect in enumerate(ranked[:places], start=1):
            assert read[f"{prefix}_{i}_height_um"] == round(defect.height_um)
            assert read[f"{prefix}_{i}_height_sigma_um"] == round(defect.height_sigma_um or 0)
            assert read[f"{prefix}_{i}_x_mm"] == pytest.approx(defect.x_mm, abs=0.0051)
        if len(ranked) < places:
            assert read[f"{prefix}_{len(ranked) + 1}_height_um"] == 0


def test_heights_are_the_frame_results_to_the_micrometre() -> None:
    read = block(Snapshot(defects=(seed(731.4), seed(1827.6), seed(12.0))))
    assert [read[f"defect_{i}_height_um"] for i in (1, 2, 3)] == [1828, 731, 12]
    assert read["largest_height_um"] == 1828
    assert read["largest_height_um_f32"] == pytest.approx(1827.6, rel=1e-7)


def test_an_unmeasured_height_counts_as_the_highest() -> None:
    read = block(Snapshot(defects=(seed(100.0), seed(math.nan))))
    assert read["largest_height_um"] is None
    assert read["largest_height_um_f32"] is None
    assert read["defect_1_height_um"] is None
    assert read["defect_2_height_um"] == 100


@pytest.mark.parametrize(
    ("snapshot", "name", "value"),
    [
        (Snapshot(defects=(seed(1e6),)), "largest_height_um", 65534),
        (Snapshot(defects=(seed(math.inf),)), "largest_height_um", 65534),
        (Snapshot(defects=(seed(1, x_mm=1e4),)), "defect_1_x_mm", 327.67),
        (Snapshot(defects=(seed(1, x_mm=-1e4),)), "defect_1_x_mm", -327.67),
        (Snapshot(lamp_read_v=-1), "lamp_read_mv", 0),
        (Snapshot(unpaired_count=70000), "unpaired_count", 65534),
        (Snapshot(elapsed_us=1e12), "elapsed_us", 2**32 - 2),
    ],
)
def test_out_of_range_values_saturate_and_say_so(snapshot: Snapshot, name: str, value: float) -> None:
    read = block(snapshot)
    assert read[name] == pytest.approx(value)
    assert read["status"] & Status.SATURATED_VALUE


def test_what_is_not_known_is_neither_zero_nor_saturated() -> None:
    read = block(replace(Snapshot(), lamp_read_v=math.nan, exposure_us=math.nan, defects=(seed(5.0, None),)))
    assert read["lamp_read_mv"] is None
    assert read["exposure_us"] is None
    assert read["result_age_ms"] is None
    assert read["defect_1_height_sigma_um"] is None
    assert not read["status"] & Status.SATURATED_VALUE


@pytest.mark.parametrize(
    ("snapshot", "bits"),
    [
        (Snapshot(), Status(0)),
        (Snapshot(state=State.READY), Status.READY),
        (Snapshot(state=State.CONTINUOUS_EXECUTION, fault_code=301), Status.FAULT),
        (Snapshot(verdict=Verdict.PASS), Status(0)),
        (Snapshot(verdict=Verdict.PASS, result_at_s=0.0), Status.RESULTS_VALID),
        (Snapshot(verdict=Verdict.NOT_INSPECTED, result_at_s=0.0), Status(0)),
        (Snapshot(lamp_ok=True, camera_ok=True, simulated=True), Status.LAMP_OK | Status.CAMERA_OK | Status.SIMULATED),
        (Snapshot(defects=(seed(1.0),) * 12), Status(0)),
        (Snapshot(defects=(seed(1.0),) * 13), Status.DEFECTS_TRUNCATED),
        (Snapshot(defects=(seed(1.0),) * 65), Status.DEFECTS_TRUNCATED | Status.LIST_TRUNCATED),
    ],
)
def test_status_bits(snapshot: Snapshot, bits: Status) -> None:
    assert block(snapshot)["status"] == bits


def test_the_list_holds_all_and_says_how_many() -> None:
    many = listed(encode_image(Snapshot(sequence=9, defects=tuple(seed(h) for h in range(1, 71))), 0, 0))
    assert many["list_sequence"] == many["list_sequence_end"] == 9
    assert many["list_defect_count"] == 64
    assert [many[f"list_defect_{i}_height_um"] for i in (1, 64)] == [70, 7]


def test_every_field_can_be_read_in_the_decoder() -> None:
    image = encode_image(Snapshot(), 0, 0)
    names = [name for address, data in image.areas for name in decode(words(data), address)]
    assert sorted(names) == sorted(row.name for row in REGISTERS)


def test_the_command_prints_all_forms_of_one_list() -> None:
    run = CliRunner().invoke
    rows = json.loads(run(app, ["registers", "--format", "json"]).stdout)
    assert rows == as_rows()
    assert list(rows[0]) == ["name", "address", "type", "words", "scale", "unit", "access", "meaning"]
    table = csv.DictReader(io.StringIO(run(app, ["registers", "--format", "csv"]).stdout))
    assert list(table) == [{key: str(value) for key, value in row.items()} for row in rows]
    assert run(app, ["registers", "--format", "markdown"]).stdout == as_markdown()
    lines = run(app, ["registers"]).stdout.splitlines()
    assert len(lines) == 1 + len(rows)
    assert lines[1].split()[:2] == ["sequence", "0"]


def test_the_page_shows_the_whole_result_block() -> None:
    page = as_markdown()
    missing = [r.name for r in registers.RESULT_REGISTERS if f"| {r.name} | {r.address} | {r.type} |" not in page]
    assert missing == []


def test_committed_copies_are_current() -> None:
    """Refresh them with `make docs`."""
    assert (GENERATED / "registers.md").read_text() == as_markdown()
    assert (GENERATED / "registers.csv").read_text() == as_csv()


def test_the_control_block_is_decoded_in_either_word_order_and_reserved_words_are_refused() -> None:
    written = [0b101, 42, 0x1234, 0xABCD, 1, 0, 0, 7, *[0] * 8]
    block = registers.decode_control(written)
    assert block == registers.ControlBlock(Control.TRIGGER | Control.BUFFER_RESULTS, 42, 0x1234ABCD, 1, 7)
    assert registers.decode_control(written, "low_first").panel_id == 0xABCD1234
    for place, value in ((0, 1 << 8), (5, 1), (15, 1)):
        with pytest.raises(ValueError, match="reserved"):
            registers.decode_control([*written[:place], value, *written[place + 1 :]])
