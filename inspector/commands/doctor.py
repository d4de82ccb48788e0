"""What `inspector doctor` does: everything that a station needs, tried in order, one line each.

Each line says what was tried, what came back and, unless that is well, what to do. Nothing is lit: the lamp is set
to 0 V and read back. The service must be stopped, since its devices have one owner.
"""

from __future__ import annotations

import contextlib
import enum
import json
import os
import shutil
import stat
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import typer

from firmware_bridge import factory
from firmware_bridge.errors import BridgeError, NoTrigger
from firmware_bridge.links.ports import open_serial
from inspector import calibration_file, yaml_document
from inspector.acquire.fresh import FreshFrames
from inspector.archive.archive_settings import ArchiveSettings
from inspector.archive.claim import is_mounted
from inspector.clock import synchronised
from inspector.publish.plc_server import PlcServer, PlcServerError
from inspector.service import permissions
from inspector.service.last_good import state_folder
from inspector.settings import Settings, SettingsError, load

EXIT_CAN_RUN, EXIT_CANNOT_RUN = 0, 1

CALIBRATION_DAYS = 365
"""An older calibration is worth a look: lenses get loose and brackets bent."""
DISK_LEAST_BYTES, DISK_LOW_BYTES = 50e6, 1e9
"""Under the first nothing can be kept; the second is a few days of logs."""
EARLIEST_S = 1735689600.0
"""2025 began so many Unix seconds in: a clock that shows less was never set."""


class State(enum.StrEnum):
    """How a check came out."""

    OK = "ok"
    WARNING = "warning"
    FAILED = "failed"
    SKIPPED = "skipped"


@dataclass(frozen=True, slots=True)
class Finding:
    """One line: the part, what was tried, what came back, and what to do (empty if nothing)."""

    part: str
    state: State
    tried: str
    found: str
    remedy: str = ""

    def line(self) -> str:
        """The finding for people."""
        todo = f" -> {self.remedy}" if self.remedy else ""
        return f"{self.state:<8} {self.part:<12} {self.tried}: {self.found}{todo}".replace("\n", "; ")


Build = Callable[..., factory.Devices]


def run(config: Path, as_json: bool, build: Build = factory.build) -> int:
    """Print every finding as it comes; the exit status says whether the station can run."""
    findings = []
    for finding in examine(config, build):
        findings.append(finding)
        if not as_json:
            typer.echo(finding.line())
    can_run = not any(finding.state is State.FAILED for finding in findings)
    if as_json:
        typer.echo(json.dumps({"can_run": can_run, "findings": [asdict(f) for f in findings]}, indent=2))
    else:
        typer.echo("the station can run" if can_run else "the station cannot run: see what failed")
    return EXIT_CAN_RUN if can_run else EXIT_CANNOT_RUN


def examine(config: Path, build: Build = factory.build) -> Iterator[Finding]:
    """Every check, in order; what rests on settings that are refused is left out."""
    try:
        settings = load(config)
    except SettingsError as error:
        for problem in error.problems:
            yield Finding("settings", State.FAILED, f"read {config}", str(problem), "correct it; see inspector config")
    else:
        yield Finding("settings", State.OK, f"read {config}", f"right, station {settings.station!r}")
        yield _calibration(settings)
        yield from _permissions(config, settings)
        yield from _files(settings)
        yield from _devices(settings, build(settings.camera, settings.module, settings.lamp))
        yield _plc_port(settings)
        yield from _plc_serial(settings)
        if settings.archive is not None:
            try:
                yield _archive(settings.archive)
            except OSError as error:
                tried = f"look at {settings.archive.folder} (archive.folder)"
                yield Finding(
                    "archive", State.FAILED, tried, str(error.strerror), "look at the disk's health and mount"
                )
    yield _disk(config.absolute().parent)
    yield _clock(time.time())


def _calibration(settings: Settings) -> Finding:
    """Its age is that of the file: whoever copies it keeps its time, or has looked at it."""
    path = settings.calibration
    camera = calibration_file.read(path).camera
    tried, days = f"read {path}", (time.time() - path.stat().st_mtime) / 86400
    found = f"{camera.width_px} x {camera.height_px} px, {max(days, 0):.0f} days old"
    if days < -1:
        return Finding("calibration", State.WARNING, tried, f"{found}, from the future", "set the clock")
    if days > CALIBRATION_DAYS:
        return Finding("calibration", State.WARNING, tried, found, "check it against a board: inspector calibrate")
    return Finding("calibration", State.OK, tried, found)


def _permissions(config: Path, settings: Settings) -> Iterator[Finding]:
    """Who else may change the settings or read the key."""
    tried, found = "look who may read and write", permissions.misfits(config, settings, state_folder())
    well = Finding("permissions", State.OK, tried, "settings, calibration and keys are kept from others")
    wrong = [Finding("permissions", State.WARNING, tried, f"{m.path}: {m.found}", m.remedy) for m in found]
    yield from wrong or [well]


def _files(settings: Settings) -> Iterator[Finding]:
    """Every device file that the settings name: there, a device, and open to this user."""
    data = settings.model_dump(mode="json", include={"camera", "module"})
    for place, mapping in yaml_document.mappings(data):
        for key in ("port", "path"):
            if isinstance(name := mapping.get(key), str):
                yield _file(yaml_document.path_text((*place, key)), Path(name))


def _file(key: str, path: Path) -> Finding:
    tried = f"look at {path} ({key})"
    try:
        mode = path.stat().st_mode
    except OSError as error:
        known = ", ".join(sorted(str(p) for p in path.parent.glob("*"))[:5]) if path.parent.is_dir() else ""
        there = f" (there: {known})" if known else ""
        return Finding("device file", State.FAILED, tried, f"{error.strerror}{there}", "check cable and name")
    real = f" is {path.resolve()}" if path.is_symlink() else ""
    if not os.access(path, os.R_OK | os.W_OK):
        remedy = f"let this user (uid {os.getuid()}) in, as with group dialout or video"
        return Finding("device file", State.FAILED, tried, f"there{real}, but not to be opened", remedy)
    kind = "a device" if stat.S_ISCHR(mode) else "no device, but a file"
    if path.name.startswith("tty") and path.parent == Path("/dev"):
        remedy = "name it by /dev/serial/by-id, which stays when it is replugged"
        return Finding("device file", State.WARNING, tried, f"{kind}, may be read and written", remedy)
    return Finding("device file", State.OK, tried, f"{kind}{real}, may be read and written")


def _devices(settings: Settings, devices: factory.Devices) -> Iterator[Finding]:
    with contextlib.closing(devices.lamp):
        yield from _lamp(settings, devices)
    with contextlib.closing(devices.camera):
        yield from _camera(settings, devices)


def _lamp(settings: Settings, devices: factory.Devices) -> Iterator[Finding]:
    module, lamp = settings.module, devices.lamp
    simulated = ", simulated" if lamp.simulated else ""
    opened = _tried("module", f"open {module.profile}, unit {module.unit}", lamp.open, lambda _: f"answers{simulated}")
    yield opened
    if opened.state is State.FAILED:
        yield Finding("lamp", State.SKIPPED, "set 0 V and read back", "no module")
        return
    yield _tried("lamp", "set 0 V and read back", lambda: lamp.set_volts(0.0), lambda read_v: f"{read_v:.3f} V")
    yield Finding("lamp hours", State.OK, "read the hours burnt", f"{lamp.burnt_hours():.1f} h")


def _camera(settings: Settings, devices: factory.Devices) -> Iterator[Finding]:
    camera, wanted_us = FreshFrames(devices.camera), settings.recipe.exposure_us
    kind, simulated = settings.camera.kind, ", simulated" if camera.simulated else ""
    opened = _tried("camera", f"open {kind}", camera.open, lambda _: f"answers{simulated}")
    yield opened
    if opened.state is State.FAILED:
        yield Finding("exposure", State.SKIPPED, f"set {wanted_us:g} us", "no camera")
        yield Finding("frame", State.SKIPPED, "take a frame", "no camera")
        return
    yield _tried("exposure", f"set {wanted_us:g} us", lambda: camera.set_exposure_us(wanted_us), _read_us)
    yield _frame(settings, camera)


def _read_us(read_us: float) -> str:
    return f"reads back {read_us:g} us"


def _frame(settings: Settings, camera: FreshFrames) -> Finding:
    """One frame of the shape that the calibration is for."""
    expected = calibration_file.read(settings.calibration).camera
    try:
        shape = camera.grab().image.shape
    except NoTrigger:
        return Finding("frame", State.OK, "take a frame", "the camera waits for its trigger line")
    except BridgeError as error:
        return Finding("frame", State.FAILED, "take a frame", error.message, error.remedy)
    found = f"{shape[1]} x {shape[0]} px"
    if shape != (expected.height_px, expected.width_px):
        found += f", the calibration is for {expected.width_px} x {expected.height_px}"
        return Finding("frame", State.FAILED, "take a frame", found, "calibrate this camera, or undo its region")
    return Finding("frame", State.OK, "take a frame", found)


def _tried(part: str, tried: str, attempt: Callable[[], object], said: Callable[..., str]) -> Finding:
    """What came of an attempt; its failure names its own remedy."""
    try:
        return Finding(part, State.OK, tried, said(attempt()))
    except BridgeError as error:
        return Finding(part, State.FAILED, tried, error.message, error.remedy)


def _plc_port(settings: Settings) -> Finding:
    plc = settings.plc
    server = PlcServer(stall_after_s=1.0, **plc.served | {"serial": None})
    tried = f"listen on {plc.host}:{plc.port}" + (f" and {plc.tls.host}:{plc.tls.port}" if plc.tls else "")
    try:
        server.start()
    except PlcServerError as error:
        return Finding("PLC port", State.FAILED, tried, str(error), "stop the service first, if it is that")
    server.stop()
    local = plc.host.startswith("127.") or plc.host in ("localhost", "::1")
    if local:
        return Finding("PLC port", State.WARNING, tried, "free, for this machine only", "set plc.host for a real PLC")
    return Finding("PLC port", State.OK, tried, "free")


def _plc_serial(settings: Settings) -> Iterator[Finding]:
    line = settings.plc.serial
    if line is not None:
        opened = partial(open_serial, "PLC", line.port, baud=line.baud, parity=line.parity, stop_bits=line.stop_bits)
        yield _tried("PLC line", f"open {line.port}", lambda: opened().close(), lambda _: f"it opens, {line.baud} baud")


def _archive(archive: ArchiveSettings) -> Finding:
    """Whether results and frames can be kept. Nothing is made there: it would be this user's, not the service's."""
    tried, least_mb = f"look at {archive.folder} (archive.folder)", archive.frames.min_free_mb
    if archive.disk is not None and not is_mounted(archive.disk):
        found = f"no disk is mounted at {archive.disk} (archive.disk): results would wait in memory"
        return Finding("archive", State.WARNING, tried, found, "mount it, and look at its health")
    there = next(path for path in (archive.folder.absolute(), *archive.folder.absolute().parents) if path.exists())
    if not (there.is_dir() and os.access(there, os.W_OK | os.X_OK)):
        remedy = f"name another folder, or let this user (uid {os.getuid()}) write there"
        return Finding("archive", State.FAILED, tried, f"{there} is no folder that can be written", remedy)
    free_mb = shutil.disk_usage(there).free / 1e6
    if free_mb < least_mb:
        found = f"{free_mb:.0f} MB free, no frames are kept with less than {least_mb:g} MB (archive.frames.min_free_mb)"
        return Finding("archive", State.WARNING, tried, found, "make room")
    return Finding("archive", State.OK, tried, f"can be written, {free_mb / 1e3:.1f} GB free")


def _disk(folder: Path) -> Finding:
    free = shutil.disk_usage(folder).free
    tried, found = f"free space at {folder}", f"{free / 1e9:.1f} GB"
    if free < DISK_LEAST_BYTES:
        return Finding("disk", State.FAILED, tried, found, "make room: nothing can be logged")
    if free < DISK_LOW_BYTES:
        return Finding("disk", State.WARNING, tried, found, "make room")
    return Finding("disk", State.OK, tried, found)


def _clock(now_s: float) -> Finding:
    """Frames and logs carry its time; the cycle itself does not need it."""
    tried = "ask the kernel whether the clock is kept right"
    found = time.strftime("%Y-%m-%d %H:%M:%S %Z", time.localtime(now_s))
    if now_s < EARLIEST_S:
        return Finding("clock", State.WARNING, tried, f"{found}, it was never set", "set it: timedatectl set-ntp true")
    if not synchronised():
        return Finding("clock", State.WARNING, tried, f"{found}, nothing keeps it right", "timedatectl set-ntp true")
    return Finding("clock", State.OK, tried, f"{found}, kept right")
