"""The manual's page, the CSV, the JSON and the server agree: mbpoll reads what each list says that there is."""

from __future__ import annotations

import csv
import io
import itertools
import json
import math
import re
import struct
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from inspector.cli.app import app
from inspector.integrator.byte_examples import MOVING, STATISTICS
from inspector.model import Defect, Extent, Flag, PlcSide, Reason, Snapshot, State, Verdict
from inspector.publish import registers
from inspector.publish.plc_server import PlcServer

PACKAGE = Path(__file__).parents[2] / "deploy" / "plc"
FORMATS = {"u16": ">H", "i16": ">h", "u32": ">I", "f32": ">f"}
NOTHING = {"u16": 0xFFFF, "i16": -0x8000, "u32": 0xFFFF_FFFF}
"""What the page says of types."""
Row = dict[str, str]


def seed(number: int) -> Defect:
    return Defect(number + 0.25, -number - 0.5, 5000.0 - number, 900.0 + number, (0.0, 0.0), (0.0, 0.0), Flag(number))


SHOWN = Snapshot(
    state=State.READY, fault_code=0, sequence=0x1_0102, acquisition_id=0x2_0103, panel_id=0x3_0104, panel_frames=105,
    frames_so_far=106, extent=Extent(10.7), recipe_id=108, verdict=Verdict.FAIL, reasons=Reason(0x0003_0005),
    defects=tuple(seed(number) for number in range(1, 65)), unpaired_count=109, result_at_s=0.0, elapsed_us=200_110,
    cycle_us=200_111, response_us=200_125, panels_passed=200_112, panels_failed=200_113, panels_not_inspected=200_114,
    missed_triggers=200_115, late_triggers=200_116, overruns=200_117, lamp_set_v=3.118, lamp_read_v=3.119, lamp_ok=True,
    camera_ok=True, exposure_us=200_120, configuration_hash=0x4_0121, recipe_hash=0x5_0122, statistics=STATISTICS,
    plc=PlcSide(0x0013, 123, 2, 3, control=(4, 6, 7, 8, 9, 0, 10, 11)), statistics_sequence=124,
)  # fmt: skip
"""Nearly every register shows another number, so that a wrong place shows."""


def in_manual() -> list[Row]:
    """Every table of the page whose columns are those of a list of registers."""
    names: list[str] = []
    rows = []
    for line in (PACKAGE / "registers.md").read_text().splitlines():
        cells = [cell.strip() for cell in line.split("|")[1:-1]]
        if cells[:2] == ["name", "address"]:
            names = cells
        elif names and cells and cells[0] != "---":
            rows.append(dict(zip(names, cells, strict=True)))
        elif not cells:
            names = []
    return rows


def in_csv() -> list[Row]:
    return list(csv.DictReader(io.StringIO((PACKAGE / "registers.csv").read_text())))


def in_json() -> list[Row]:
    told = json.loads(CliRunner().invoke(app, ["registers", "--format", "json"]).stdout)
    return [{name: str(value) for name, value in row.items()} for row in told]


@pytest.fixture
def served(peer: Any) -> Iterator[dict[int, int]]:
    """Every register of the server, by address, as mbpoll reads it: areas and their ends are found by asking."""
    program = peer("mbpoll", "mbpoll")
    server = PlcServer(port=0, stall_after_s=120.0)
    server.start()
    server.publish(SHOWN)

    def read(address: int, count: int) -> list[int]:
        command = [program, "-m", "tcp", "-p", str(server.port), "-0", "-t", "3:hex", "-1", "-r", str(address)]
        done = subprocess.run([*command, "-c", str(count), "127.0.0.1"], capture_output=True, text=True, timeout=30)
        return [int(word, 16) for word in re.findall(r"^\[\d+\]:\s+(0x\S+)", done.stdout, re.MULTILINE)]

    words: dict[int, int] = {}
    for area, data in registers.encode_image(SHOWN, 0.0, 0).areas:
        assert read(area + len(data) // 2, 1) == [], "the area ends here"
        for at in range(area, area + len(data) // 2, 25):
            words |= dict(zip(range(at, at + 25), read(at, min(25, area + len(data) // 2 - at)), strict=False))
    yield words
    server.stop()


def value(row: Row, words: dict[int, int]) -> float | int | None:
    """What the list says of itself, in plain struct: no code of the station's."""
    taken = [words[int(row["address"]) + place] for place in range(int(row["words"]))]
    number: float | int = struct.unpack(FORMATS[row["type"]], struct.pack(f">{len(taken)}H", *taken))[0]
    nothing = math.isnan(number) or number == NOTHING.get(row["type"])
    return None if nothing and row["unit"] not in ("id", "tick", "code", "bits") else number * float(row["scale"])


def test_each_list_names_what_the_server_shows(served: dict[int, int]) -> None:
    expected: dict[str, Any] = {}
    for address, data in registers.encode_image(SHOWN, 0.0, 0).areas:
        expected |= registers.decode(struct.unpack(f">{len(data) // 2}H", data), address)
    numbers = [number for number in expected.values() if number]
    assert len(set(numbers)) > 0.7 * len(numbers), "a wrong place would not show"
    for rows in (in_manual(), in_csv(), in_json()):
        assert {"sequence", "control", "list_defect_1_x_mm", "statistics_status"} <= {row["name"] for row in rows}
        read = {row["name"]: value(row, served) for row in rows if row["name"] not in MOVING}
        assert read == pytest.approx({name: expected[name] for name in read})
    assert {row["name"] for row in in_csv()} == expected.keys()


def test_the_lists_say_the_same_of_every_register_they_share() -> None:
    whole = {row["name"]: row for row in in_csv()}
    assert [row for row in in_json() if row != whole[row["name"]]] == []
    assert [row for row in in_manual() if row != whole[row["name"]]] == []
    assert len(in_json()) == len(whole)


def test_what_no_list_names_reads_zero(served: dict[int, int]) -> None:
    named = itertools.chain.from_iterable(
        range(int(row["address"]), int(row["address"]) + int(row["words"])) for row in in_csv()
    )
    unnamed = set(served) - set(named)
    assert unnamed
    assert {served[address] for address in unnamed} == {0}
