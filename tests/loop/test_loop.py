"""The loop closed: fewer defects over registers alone, in the model and over the wire with foreign clients."""

from __future__ import annotations

import sys
import time
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable

import numpy as np
import pytest
from typer.testing import CliRunner

from inspector.cli.app import app
from inspector.judge.spc.settings import StatisticsSettings
from inspector.lab.booth import Booth, BoothSettings, Deed, PaintedPanel
from inspector.lab.plc_program import PlcProgram
from inspector.loop.demo import LiveStation, plc_process
from inspector.loop.plot import svg
from inspector.loop.proof import LOOP, UNTENDED, History, compare_keeping, tended, untended

SEEDS, PANELS = 2, 700
DEADLINE_S = 60.0


def test_the_tended_booth_settles_below_the_untended_one() -> None:
    comparison = compare_keeping(Booth, PlcProgram, tuple(Deed), SEEDS, PANELS)
    assert all(saved > 0.1 for saved in comparison.saved(LOOP, UNTENDED)), comparison.table()
    assert all(run.deeds > 0 for run in comparison.runs[LOOP])
    assert all(run.deeds == 0 for run in comparison.runs[UNTENDED])
    assert f"of {SEEDS} seeds" in comparison.sentence()
    assert comparison.table().count("\n") == 2 + len(comparison.runs)
    plot = svg(comparison)
    ElementTree.fromstring(plot)
    assert len(plot) < 200_000


def test_a_program_that_orders_nothing_changes_nothing() -> None:
    class Idle:
        def scan(self, registers: object) -> tuple[tuple[Deed, ...], bool]:
            return (), False

    assert tended(Booth(1), Idle(), StatisticsSettings(), 100) == untended(Booth(1), 100)


def test_settled_rates_are_means_of_the_end() -> None:
    assert History([9, 9, 1, 2], 0).settled(2) == 1.5


class DirtyAtLast:
    """A booth that is clean for a while and then dirty until somebody changes its filter."""

    def __init__(self, clean_panels: int) -> None:
        self.settings = BoothSettings()
        self.deeds: list[tuple[int, Deed]] = []
        self._draw = np.random.default_rng(1)
        self._clean, self._painted = clean_panels, 0

    def paint(self) -> PaintedPanel:
        self._painted += 1
        dirty = self._painted > self._clean and not self.deeds
        count = int(self._draw.poisson(9.0 if dirty else 3.0))
        return PaintedPanel(np.full(count, 250.0), self._draw.random((count, 2)) * (600.0, 400.0))

    def order(self, deed: Deed) -> None:
        self.deeds.append((self._painted, deed))


@pytest.mark.parametrize("foreign", ["pymodbus", "libmodbus"])
def test_a_plc_over_the_wire_orders_and_then_resets(foreign: str, compiled_peer: Callable[[str], str]) -> None:
    program = (
        [compiled_peer("plc_loop")] if foreign == "libmodbus" else [sys.executable, "-m", "inspector.lab.plc_client"]
    )
    booth, station = DirtyAtLast(clean_panels=100), LiveStation(0)
    station.start()
    ends_s = time.monotonic() + DEADLINE_S
    try:
        with plc_process([*program, str(station.server.port)]) as orders:
            ordered_at = reset_at = None
            while reset_at is None and time.monotonic() < ends_s:
                shown = station.publish(booth)
                while not orders.empty():
                    order = orders.get()
                    ordered_at = ordered_at or order["after"]
                    booth.order(Deed[order["order"]])
                statistics = shown.statistics
                assert statistics is not None
                if ordered_at and statistics.panels < shown.sequence:
                    reset_at = shown.sequence
                station.wait(0.002)
    finally:
        station.server.stop()
    assert ordered_at is not None, "no order came"
    assert ordered_at > 100
    assert reset_at is not None, "no reset came"
    assert reset_at >= ordered_at + 30


def test_the_demo_shows_the_loop() -> None:
    done = CliRunner().invoke(app, ["demo", "--loop", "--panels", "100", "--rate", "1000"])
    assert done.exit_code == 0, done.output
    assert "panel    50  tended" in done.output
    assert "seeds a panel over 100 panels" in done.output


def test_the_demo_without_a_subject_says_what_there_is() -> None:
    done = CliRunner().invoke(app, ["demo"])
    assert done.exit_code == 2
    assert "--loop" in done.output


def test_the_demo_compares_many_booths(tmp_path: object) -> None:
    plot = f"{tmp_path}/loop.svg"
    done = CliRunner().invoke(app, ["demo", "--loop", "--seeds", "1", "--panels", "120", "--plot", plot])
    assert done.exit_code == 0, done.output
    assert "| tended by the loop |" in done.output
    ElementTree.parse(plot)
