"""`inspector io` as a technician meets it: on a simulated module behind a real port, with the service in the way."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
import yaml
from typer.testing import CliRunner

from firmware_bridge.simulators.module_server import ModuleServer, WireFault
from firmware_bridge.simulators.module_state import SimulatedModule
from firmware_bridge.wire.profiles import PROFILES
from inspector.cli.app import app

DONE, DECLINED, USAGE, UNAVAILABLE, SETTINGS_REFUSED = 0, 1, 2, 69, 78
UNIT = 3


class Cabinet:
    """A module, the settings that name it, and the commands; neither camera nor calibration is there yet."""

    def __init__(self, profile: str, folder: Path) -> None:
        row = PROFILES[profile]
        self.module = SimulatedModule(row, lambda: 0.0)
        self.server = ModuleServer(self.module, UNIT, tcp=not row.has_serial).start()
        host, _, port = self.server.address.rpartition(":")
        link = {"kind": "tcp", "host": host, "port": int(port)} if host else {"kind": "serial", "port": port}
        self.settings: dict[str, Any] = {
            "module": {"profile": profile, "unit": UNIT, "link": link, "deadline_s": 2.0},
            "lamp": {"channel": 0},
        }
        self.file = folder / "station.yaml"
        self.write()

    def write(self) -> None:
        self.file.write_text(yaml.safe_dump(self.settings))

    def io(self, verb: str, *arguments: str, answer: str = "") -> tuple[int, str]:
        """Exit status, and what was printed; ``answer`` is typed."""
        done = CliRunner().invoke(app, ["io", verb, "--config", str(self.file), *arguments], input=answer)
        assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
        return done.exit_code, done.output


@pytest.fixture
def cabinet(tmp_path: Path) -> Iterator[Callable[..., Cabinet]]:
    """``cabinet(profile)``: a module in a cabinet."""
    with ExitStack() as stack:

        def make(profile: str = "tm-da1p1r1") -> Cabinet:
            made = Cabinet(profile, tmp_path)
            stack.callback(made.server.stop)
            return made

        yield make


def test_points_are_listed_without_touching_the_module(cabinet: Any) -> None:
    one = cabinet()
    one.server.stop()
    status, said = one.io("list")
    assert status == DONE
    for point in ("ao0", "di0", "do0", "trip", "30065", "00033", "the lamp's level", "ICP DAS tM-DA1P1R1"):
        assert point in said


@pytest.mark.parametrize("profile", PROFILES)
def test_reading_shows_every_point_of_every_module(profile: str, cabinet: Any) -> None:
    one = cabinet(profile)
    one.module.stuck = True  # whoever writes would be found out
    status, said = one.io("read")
    assert status == DONE
    assert len(re.findall(r"│ ao\d", said)) == PROFILES[profile].channels
    assert "0.00" in said


def test_reading_shows_what_is_not_as_the_station_needs(cabinet: Any) -> None:
    one = cabinet()
    one.settings["module"]["safe_v"] = 1.0
    one.write()
    one.module.trip()
    status, said = one.io("read")
    assert status == DONE
    assert "TRIPPED" in said
    assert re.search(r"safe value, output 0 +│ 40097 +│ 0 +│ 1000: set at its start", said)
    assert one.module.output_v(0) == 0.0


def test_single_points_are_read(cabinet: Any) -> None:
    one = cabinet("adam-4024")
    one.module.set_value(PROFILES["adam-4024"].digital_inputs.points[2], 1)
    status, said = one.io("read", "di2", "di3")
    assert status == DONE
    assert re.search(r"di2 +│ digital input │ 00003 +│ on ", said)
    assert re.search(r"di3 +│ digital input │ 00004 +│ off", said)
    assert "ao0" not in said


def test_an_output_moves_after_a_yes(cabinet: Any) -> None:
    one = cabinet()
    status, said = one.io("write", "ao0", "2.5", answer="y\n")
    assert status == DONE
    assert "set ao0 (the lamp's level) from 0.000 V to 2.5?" in said
    assert "ao0: 0.000 V -> 2.5, reads back 2.500 V" in said
    assert one.module.output_v(0) == pytest.approx(2.5)


@pytest.mark.parametrize("answer", ["n\n", "\n", ""])
def test_nothing_moves_without_a_yes(answer: str, cabinet: Any) -> None:
    one = cabinet()
    status, said = one.io("write", "ao0", "2.5", answer=answer)
    assert status == DECLINED
    assert "nothing was written" in said
    assert one.module.output_v(0) == 0.0


def test_scripts_do_not_ask(cabinet: Any) -> None:
    one = cabinet()
    assert one.io("write", "ao0", "2.5", "--yes")[0] == DONE
    assert one.io("write", "do0", "on", "--yes") == (DONE, "do0: off -> on, reads back on\n")
    assert one.io("write", "do0", "off", "--yes")[0] == DONE


@pytest.mark.parametrize(("point", "value", "said"), [
    ("ao0", "5.1", "allowed: 0 to 5 "),
    ("ao0", "-1", "allowed: 0 to 5 "),
    ("ao0", "nan", "allowed: 0 to 5 "),
    ("ao0", "full", "allowed: 0 to 5 "),
    ("do0", "2", "allowed: off or on"),
    ("di0", "on", "it is an input"),
    ("trip", "1", "allowed: clear"),
    ("ao1", "1", "no such point of tm-da1p1r1; there are: ao0, di0, do0, trip"),
])  # fmt: skip
def test_what_cannot_be_set_is_refused_before_anything_is_touched(
    point: str, value: str, said: str, cabinet: Any
) -> None:
    one = cabinet()
    one.server.stop()
    status, shown = one.io("write", "--yes", "--", point, value)
    assert status == USAGE
    assert said in shown


def test_only_the_lamps_output_has_the_lamps_clamp(cabinet: Any) -> None:
    one = cabinet("waveshare-ao-8ch-b")
    assert one.io("write", "ao1", "9", "--yes")[0] == DONE
    assert one.module.output_v(1) == pytest.approx(9.0)


def test_a_trip_is_said_and_cleared(cabinet: Any) -> None:
    one = cabinet()
    one.module.trip()
    status, said = one.io("write", "ao0", "2.5", "--yes")
    assert status == UNAVAILABLE
    assert "watchdog tripped" in said
    assert "io write" in said
    assert one.io("write", "trip", "clear", "--yes") == (DONE, "trip: TRIPPED -> clear, reads back clear\n")
    assert one.io("write", "ao0", "2.5", "--yes")[0] == DONE


def test_an_output_that_does_not_follow_is_no_success(cabinet: Any) -> None:
    one = cabinet()
    one.module.stuck = True
    status, said = one.io("write", "ao0", "2.5", "--yes")
    assert status == UNAVAILABLE
    assert "set to 2.5 V, reads back 0.000 V" in said


@pytest.mark.parametrize("profile", ["tm-da1p1r1", "iologik-e1241"])
def test_while_the_service_has_the_module_it_refuses(profile: str, cabinet: Any, settings_in_use: Any) -> None:
    one = cabinet(profile)
    with settings_in_use(one.file):
        for verb in (["read"], ["write", "ao0", "1", "--yes"]):
            status, said = one.io(*verb)
            assert status == UNAVAILABLE
            assert "another program has it open: end that first (the service: systemctl stop inspector)" in said
    assert one.io("read")[0] == DONE


@pytest.fixture
def settings_in_use() -> Any:
    """A context in which another process has the module of a settings file open, as the service has."""
    from contextlib import contextmanager

    program = (
        "import sys; from pathlib import Path; from inspector.settings import load_devices\n"
        "from firmware_bridge.factory import build_module\n"
        "build_module(load_devices(Path(sys.argv[1])).module).open(); print('open', flush=True); sys.stdin.read()\n"
    )

    @contextmanager
    def hold(file: Path) -> Iterator[None]:
        holder = subprocess.Popen(
            [sys.executable, "-c", program, str(file)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        try:
            assert holder.stdout is not None
            assert holder.stdout.readline() == "open\n"
            yield
        finally:
            holder.communicate(timeout=30)

    return hold


def test_watching_shows_changes_and_goes_on_over_an_outage(cabinet: Any, wait_until: Any) -> None:
    one = cabinet()
    command = [sys.executable, "-m", "inspector", "io", "watch", "--config", str(one.file), "--interval-s", "0.02"]
    lines: list[str] = []
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=os.environ | {"COLUMNS": "100"}) as watcher:
        assert watcher.stdout is not None

        def until(text: str) -> None:
            while not lines or text not in lines[-1]:
                line = watcher.stdout.readline()
                assert line, f"ended before: {text}; said: {lines}"
                lines.append(line)

        until("module  answers")
        one.module.set_value(PROFILES["tm-da1p1r1"].digital_inputs.first, 1)
        until("di0     off -> on")
        one.server.fault = WireFault.SILENT
        until("answers -> module: no answer in 2 s")
        one.server.fault = WireFault.NONE
        until("-> answers")
        watcher.send_signal(2)
        assert watcher.wait(30) == DONE


def test_watching_ends_after_so_many_looks(cabinet: Any) -> None:
    status, said = cabinet().io("watch", "ao0", "--count", "2")
    assert status == DONE
    assert len(said.splitlines()) == 2


@pytest.mark.parametrize(("change", "said"), [
    ({"module": {"profile": "none"}}, "module.profile"),
    ({"lamp": {"channel": -1}}, "lamp.channel"),
])  # fmt: skip
def test_wrong_settings_are_refused_at_their_place(change: Any, said: str, cabinet: Any) -> None:
    one = cabinet()
    one.settings |= change
    one.write()
    status, shown = one.io("read")
    assert status == SETTINGS_REFUSED
    assert said in shown
    one.file.unlink()
    assert one.io("list")[0] == SETTINGS_REFUSED


def test_a_module_that_is_not_there_is_no_success(cabinet: Any) -> None:
    one = cabinet()
    one.server.stop()
    status, said = one.io("read")
    assert status == UNAVAILABLE
    assert "cannot open" in said


def test_profiles_are_shown() -> None:
    shown = CliRunner().invoke(app, ["io", "profiles"]).output
    assert all(name in shown for name in PROFILES)
    assert CliRunner().invoke(app, ["io", "profiles", "--format", "markdown"]).output.startswith("# I/O modules")
