"""CCD heads in processes of their own: a C program made from the manuals' words, not our tables, and the simulator."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from pydantic import TypeAdapter

from firmware_bridge import errors
from firmware_bridge.camera_settings import CameraSettings
from firmware_bridge.factory import build_camera
from firmware_bridge.links import v4l2

PEERS = Path(__file__).parents[1] / "peers"
SHAPE = {"width_px": 64, "height_px": 48}
COMMANDS = {
    "ccd_head": [sys.executable, "-m", "firmware_bridge.simulators.ccd_head"],
    "command": [sys.executable, "-m", "inspector", "simulate-device", "ccd"],
}
HEARD = {
    "dalsa": ["sem 2", "set 5500", "get set", "set 18.475", "get set"],
    "jai": ["SM=1", "TR=0", "PE=5500", "PE?", "PE=18", "PE?"],
}


@pytest.fixture
def started() -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """``started(command)``: a process that ends with the test."""
    with contextlib.ExitStack() as stack:

        def start(command: list[str]) -> subprocess.Popen[str]:
            process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
            stack.callback(_end, process)
            return process

        yield start


def _end(process: subprocess.Popen[str]) -> None:
    process.kill()
    with process:
        process.wait(30)


@pytest.fixture
def compiled(peer: Any, tmp_path: Path) -> Callable[[str], str]:
    """``compiled(name)``: the path of ``peers/name.c``, compiled with nothing but the C library."""

    def build(name: str) -> str:
        program = str(tmp_path / name)
        flags = ["-O2", "-Wall", "-Werror", str(PEERS / f"{name}.c"), "-o", program]
        subprocess.run([peer("gcc", "gcc libc6-dev"), *flags], check=True, timeout=60)
        return program

    return build


@pytest.fixture
def foreign(peer: Any, compiled: Any, started: Any, wait_until: Any, tmp_path: Path) -> Callable[[str], Any]:
    """``foreign(dialect)``: the C head behind a pair of terminals, its process and the camera that leads to it."""

    def make(dialect: str) -> tuple[subprocess.Popen[str], Any]:
        near, far, frames = tmp_path / "near", tmp_path / "far", tmp_path / "frames"
        os.mkfifo(frames)
        started([peer("socat", "socat"), *(f"pty,raw,echo=0,link={end}" for end in (near, far))])
        wait_until(lambda: near.exists() and far.exists(), "socat made its pair of terminals")
        shape = [str(value) for value in SHAPE.values()]
        process = started([compiled("ccd_head"), dialect, str(far), str(frames), *shape])
        assert process.stdout.readline() == "ready\n"
        return process, camera_at(dialect, near, frames)

    return make


def camera_at(dialect: str, port: Path, frames: Path, command_deadline_s: float = 5.0, **more: Any) -> Any:
    source = {"kind": "raw", "path": str(frames), **SHAPE, **more}
    settings = {"kind": "serial_ccd", "dialect": dialect, "port": str(port), "frames": source}
    deadlines = {"command_deadline_s": command_deadline_s, "deadline_s": 20.0}
    return build_camera(TypeAdapter(CameraSettings).validate_python(settings | deadlines))


@pytest.mark.parametrize("dialect", HEARD)
def test_a_head_made_from_the_manual_understands_and_is_understood(dialect: str, foreign: Any) -> None:
    process, camera = foreign(dialect)
    with contextlib.closing(camera):
        camera.open()
        assert camera.set_exposure_us(5500.0) == 5500.0
        assert camera.grab().image.min() == camera.grab().image.max() == 55
        last = 18.475 if dialect == "dalsa" else 18.0
        if dialect == "dalsa":
            with pytest.raises(errors.ReadBackWrong, match=r"reads back 40 us, not 18.475 us \(Clipped to min\)"):
                camera.set_exposure_us(last)
        else:
            assert camera.set_exposure_us(18.475) == last
            with pytest.raises(errors.Refused, match="Bad Parameters!!"):
                camera.set_exposure_us(1.0)
        assert [process.stdout.readline().strip() for _ in HEARD[dialect]] == HEARD[dialect]


def test_the_other_dialects_head_says_no(foreign: Any, tmp_path: Path) -> None:
    foreign("jai")
    # It hears "sem 2" and waits for a line feed that never comes.
    camera = camera_at("dalsa", tmp_path / "near", tmp_path / "frames", command_deadline_s=0.2)
    with contextlib.closing(camera), pytest.raises(errors.NoReply, match="dialect"):
        camera.open()


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("dialect", HEARD)
def test_the_simulator_serves_until_its_parent_has_gone(
    dialect: str, command: str, started: Any, tmp_path: Path
) -> None:
    port, frames = tmp_path / "port", tmp_path / "frames"
    options = ["--dialect", dialect, "--symlink", str(port), "--frames", str(frames), "--rate-hz", "100", "--header"]
    size = ["--width-px", "64", "--height-px", "48", "--with-parent"]
    process = started(COMMANDS[command] + options + size)
    assert process.stdout.readline().strip() == os.readlink(port)
    with contextlib.closing(camera_at(dialect, port, frames, header=True)) as camera:
        camera.open()
        assert camera.set_exposure_us(2000.0) == 2000.0
        assert camera.grab().exposure_us == 2000.0
        process.stdin.close()
        assert process.wait(30) == 0
    assert not port.is_symlink()
    assert not frames.exists()


def test_the_simulator_ends_when_told_and_says_what_it_cannot_use(started: Any, tmp_path: Path) -> None:
    process = started([*COMMANDS["ccd_head"], "--dialect", "jai"])
    assert process.stdout.readline().startswith("/dev/")
    process.send_signal(signal.SIGTERM)
    assert process.wait(30) == 0
    taken = tmp_path / "file"
    taken.write_text("kept")
    refused = started([*COMMANDS["ccd_head"], "--dialect", "jai", "--symlink", str(taken)])
    assert refused.wait(30) == 2
    assert taken.read_text() == "kept"


def test_video_requests_are_laid_out_as_the_kernels_own_header_says(compiled: Any) -> None:
    shown = subprocess.run([compiled("v4l2_layout")], check=True, capture_output=True, text=True, timeout=30).stdout
    header = {name: int(value) for name, value in (line.split() for line in shown.splitlines())}
    for name in [name for name in header if name.isupper() and hasattr(v4l2, name)]:
        ours = getattr(v4l2, name)
        assert getattr(ours, "size", ours) == header[name], name
    assert {bits: int.from_bytes(code, "little") for bits, code in v4l2.PIXEL_FORMATS.items()} == {
        8: header["GREY"],
        16: header["Y16"],
    }
    form = v4l2.FORMAT.pack(1, 0xA1, 0xA2, b"GREY", 0xA4, 0xA5, *[0] * 7)
    buffer = v4l2.BUFFER.pack(0, 1, 0xB2, 0xB3, 0, 0, 0, b"", 0xB8, 0xB9, 0xBA, 0xBB, 0, 0)
    places = {"pix.width": 0xA1, "pix.field": 0xA4, "pix.bytesperline": 0xA5}
    assert {name: form[header[name]] for name in places} == places
    places = {"bytesused": 0xB2, "flags": 0xB3, "sequence": 0xB8, "memory": 0xB9, "offset": 0xBA, "length": 0xBB}
    assert {name: buffer[header[name]] for name in places} == places
