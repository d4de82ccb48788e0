"""Settings to devices: the only place that chooses real, replayed or simulated. Nothing is opened here."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from firmware_bridge.camera_settings import (
    NOMINAL_EXPOSURE_US,
    CameraSettings,
    GenicamCameraSettings,
    ReplaySettings,
    SerialCcdCameraSettings,
    SimulatedCameraSettings,
)
from firmware_bridge.contracts import Camera, DigitalIO, Lamp
from firmware_bridge.drivers.faulty_camera import FaultyCamera
from firmware_bridge.drivers.lamp import FostecLamp
from firmware_bridge.drivers.modbus_module import ModbusModule
from firmware_bridge.drivers.replay_camera import ReplayCamera
from firmware_bridge.drivers.serial_ccd_camera import Head, SerialCcdCamera
from firmware_bridge.drivers.simulated_camera import SimulatedCamera
from firmware_bridge.links.frame_sources import RawSource
from firmware_bridge.links.modbus_master import ModbusMaster, Timed, untimed
from firmware_bridge.links.ports import Port, open_serial, open_tcp_unit
from firmware_bridge.links.serial_line import CommandLine
from firmware_bridge.links.simulated import open_simulated
from firmware_bridge.links.v4l2 import V4l2Source
from firmware_bridge.settings import LampSettings, ModuleSettings, SerialLink, TcpLink
from firmware_bridge.simulators.ccd_state import Sensor, draw_spots

if TYPE_CHECKING:  # loaded for stations with such a camera alone
    from firmware_bridge.drivers.genicam_camera import GenicamCamera


@dataclass(frozen=True, slots=True)
class Devices:
    """A station's devices, closed: open each before use."""

    camera: Camera
    lamp: Lamp
    digital: DigitalIO | None = None
    """The digital points of the lamp's module, usable while the lamp is open; None if there is no module."""


def build(camera: CameraSettings, module: ModuleSettings, lamp: LampSettings, module_timed: Timed = untimed) -> Devices:
    """The devices that the settings name; ``module_timed`` is told how long requests to the module take. Touches
    nothing."""
    io = build_module(module, [lamp.channel], module_timed)
    bulb = FostecLamp(io, lamp)
    return Devices(build_camera(camera, lambda: bulb.lit_share), bulb, io)


def build_camera(settings: CameraSettings, lit_share: Callable[[], float] = lambda: 1.0) -> Camera:
    """The camera that the settings name; a simulated one sees the share of the lamp's light that ``lit_share`` says."""
    if isinstance(settings, SerialCcdCameraSettings):
        return build_serial_ccd(settings)
    if isinstance(settings, GenicamCameraSettings):
        return build_genicam(settings)
    camera = build_simulated(settings, lit_share) if settings.kind == "simulated" else build_replay(settings)
    return FaultyCamera(camera, settings.faults) if settings.faults else camera


def build_replay(settings: ReplaySettings) -> ReplayCamera:
    """The recording that the settings name."""
    return ReplayCamera(settings.paths, rate_hz=settings.rate_hz, loop=settings.loop, deadline_s=settings.deadline_s)


def build_simulated(settings: SimulatedCameraSettings, lit_share: Callable[[], float]) -> SimulatedCamera:
    """The drawn scene that the settings describe."""
    spots, width_px, height_px = settings.spots, settings.width_px, settings.height_px
    scene = draw_spots(width_px, height_px, spots, settings.panel_share, NOMINAL_EXPOSURE_US)
    sensor = Sensor(scene, settings.bits, noise_share=settings.noise_share)
    return SimulatedCamera(sensor, lit_share, rate_hz=settings.rate_hz, deadline_s=settings.deadline_s)


def build_serial_ccd(settings: SerialCcdCameraSettings, device: str = "camera") -> SerialCcdCamera:
    """The CCD head that the settings name; ``device`` is what errors call it."""
    frames, dialect = settings.frames, settings.dialect_row
    head = Head(dialect, *settings.exposure_range_us, settings.us_per_count, settings.trigger)
    line = CommandLine(
        device, dialect, lambda: open_serial(device, settings.port, baud=settings.baud), settings.command_deadline_s
    )
    source = (V4l2Source if frames.kind == "v4l2" else RawSource)(device, frames.path, frames.form)
    return SerialCcdCamera(head, line, source, deadline_s=settings.deadline_s, device=device)


def build_genicam(settings: GenicamCameraSettings, device: str = "camera") -> GenicamCamera:
    """The GenICam camera that the settings name; ``device`` is what errors call it."""
    from firmware_bridge.drivers.genicam_camera import GenicamCamera
    from firmware_bridge.drivers.genicam_features import Region, Wanted

    roi = settings.roi
    region = Region(roi.x_px, roi.y_px, roi.width_px, roi.height_px) if roi else None
    wanted = Wanted(settings.pixel_format, region, settings.trigger, settings.gain_db, settings.packet_size_bytes)
    deadlines_s = {"deadline_s": settings.deadline_s, "command_deadline_s": settings.command_deadline_s}
    return GenicamCamera(settings.camera, wanted, **deadlines_s, device=device)


def build_module(
    settings: ModuleSettings, channels: Sequence[int] | None = None, timed: Timed = untimed
) -> ModbusModule:
    """The I/O module that the settings name, for some of its channels (None: all)."""
    simulated = settings.link.kind == "simulated"
    return ModbusModule(
        settings.profile_row,
        build_master(settings, timed=timed),
        channels,
        safety=settings.safety,
        simulated=simulated,
    )


def build_master(settings: ModuleSettings, device: str = "module", timed: Timed = untimed) -> ModbusMaster:
    """The Modbus master for the module that the settings name; ``device`` is what errors call it."""

    def open_port() -> Port:
        match settings.link:
            case SerialLink(port=port, baud=baud, parity=parity, stop_bits=stop_bits):
                return open_serial(device, port, baud=baud, parity=parity, stop_bits=stop_bits)
            case TcpLink(host=host, port=tcp_port):
                return open_tcp_unit(device, host, tcp_port, settings.unit, settings.deadline_s)
            case _:
                return open_simulated(device, settings.profile_row, settings.unit)

    rtu = settings.link.kind == "serial" or (settings.link.kind == "simulated" and settings.profile_row.has_serial)
    return ModbusMaster(device, settings.unit, open_port, rtu=rtu, deadline_s=settings.deadline_s, timed=timed)


def build_plc_master(host: str, port: int, unit: int, deadline_s: float, device: str = "plc") -> ModbusMaster:
    """The Modbus TCP master that writes into a PLC; ``device`` is what errors call it."""
    return ModbusMaster(
        device,
        unit,
        lambda: open_tcp_unit(device, host, port, unit, deadline_s),
        rtu=False,
        deadline_s=deadline_s,
    )
