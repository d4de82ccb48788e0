"""Settings to devices: the only place that chooses real, replayed or simulated. Nothing is opened here."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from firmware_bridge.contracts import Camera, Lamp
from firmware_bridge.drivers.lamp import FostecLamp
from firmware_bridge.drivers.modbus_module import ModbusModule
from firmware_bridge.drivers.replay_camera import ReplayCamera
from firmware_bridge.links.modbus_master import ModbusMaster
from firmware_bridge.links.ports import Port, open_serial, open_tcp
from firmware_bridge.links.simulated import open_simulated
from firmware_bridge.settings import CameraSettings, LampSettings, ModuleSettings, SerialLink, TcpLink


@dataclass(frozen=True, slots=True)
class Devices:
    """A station's devices, closed: open each before use."""

    camera: Camera
    lamp: Lamp


def build(camera: CameraSettings, module: ModuleSettings, lamp: LampSettings) -> Devices:
    """The devices that the settings name. Touches nothing."""
    return Devices(build_camera(camera), FostecLamp(build_module(module, [lamp.channel]), lamp))


def build_camera(settings: CameraSettings) -> Camera:
    """The camera that the settings name."""
    return ReplayCamera(settings.paths, rate_hz=settings.rate_hz, loop=settings.loop, deadline_s=settings.deadline_s)


def build_module(settings: ModuleSettings, channels: Sequence[int] | None = None) -> ModbusModule:
    """The I/O module that the settings name, for some of its channels (None: all)."""
    simulated = settings.link.kind == "simulated"
    return ModbusModule(
        settings.profile_row,
        build_master(settings),
        channels,
        safe_v=settings.safe_v,
        watchdog_s=settings.watchdog_s,
        simulated=simulated,
    )


def build_master(settings: ModuleSettings, device: str = "module") -> ModbusMaster:
    """The Modbus master for the module that the settings name; ``device`` is what errors call it."""

    def open_port() -> Port:
        match settings.link:
            case SerialLink(port=port, baud=baud, parity=parity, stop_bits=stop_bits):
                return open_serial(device, port, baud=baud, parity=parity, stop_bits=stop_bits)
            case TcpLink(host=host, port=tcp_port):
                return open_tcp(device, host, tcp_port, settings.deadline_s)
            case _:
                return open_simulated(device, settings.profile_row, settings.unit)

    rtu = settings.link.kind == "serial" or (settings.link.kind == "simulated" and settings.profile_row.has_serial)
    return ModbusMaster(device, settings.unit, open_port, rtu=rtu, deadline_s=settings.deadline_s)
