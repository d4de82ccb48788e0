"""The station's Modbus TCP server: serves the last published image, whole, from a thread of its own.

Rules. A read is answered from one immutable image, so it is never torn. The server never waits for the inspection:
if the cycle stops beating, the server itself tells the PLC that the cycle has stalled. One client costs the others
nothing: each connection reads at most :data:`RECEIVE_BYTES` a turn, is closed when it is silent, does not take its
answers, or speaks something else; who is not on the allow-list, or one too many, is closed at once.
"""

from __future__ import annotations

import asyncio
import errno
import logging
import os
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from importlib.metadata import version
from ipaddress import IPv6Address, ip_address, ip_network

from firmware_bridge.wire.modbus import IllegalAddress, Slave, Table
from firmware_bridge.wire.modbus_frames import TcpSession
from inspector.faults import Fault
from inspector.handshake_table import Answer
from inspector.model import Reason, Snapshot, State, Verdict
from inspector.publish.registers import CONTROL_ADDRESS, CONTROL_WORDS, Image, WordOrder, encode_image

log = logging.getLogger(__name__)

LOOPBACK = ("127.0.0.0/8", "::1/128")
ANY_USUAL_UNIT = (0, 1, 255)
"""What clients put in the unit id of a device that is reached directly over TCP."""
PRODUCT = "seed-inspector"

REFRESH_S = 0.25
"""How often age and heartbeat are brought up to date, and connections looked over."""
SLOW_READER_S = 5.0
"""How long a client may leave its answers unread."""
START_DEADLINE_S = 5.0
RECEIVE_BYTES = 4096
UNREAD_BYTES = 16384
"""Answers waiting for a client beyond this stop us from reading its requests."""
MAX_NAMED_STRANGERS = 256


OnControl = Callable[[int, Sequence[int]], None]
"""What a write into the control block is told: its first address and its words. May raise any ModbusError."""


class PlcServerError(Exception):
    """The server cannot listen; the message names the address, the cause and the remedy."""


class PlcServer:
    """Serves register images over Modbus TCP. Every method may be called from any thread.

    ``allow``: networks whose hosts may connect. ``port`` 0 takes any free one. ``stall_after_s``: without
    :meth:`beat` or :meth:`publish` for so long, what is served is state ERROR, fault CYCLE_STALLED, NOT_INSPECTED.
    ``on_control`` is called in the server's thread; without it nothing can be written.
    """

    def __init__(
        self,
        host: str = "127.0.0.1",
        port: int = 502,
        *,
        unit_ids: Sequence[int] = ANY_USUAL_UNIT,
        allow: Iterable[str] = LOOPBACK,
        max_connections: int = 16,
        idle_timeout_s: float = 60.0,
        stall_after_s: float = 2.0,
        word_order: WordOrder = "high_first",
        on_control: OnControl | None = None,
    ) -> None:
        self._host, self._port = host, port
        self._networks = tuple(ip_network(network) for network in allow)
        self._max_connections = max_connections
        self._idle_timeout_s, self._stall_after_s = idle_timeout_s, stall_after_s
        self._word_order: WordOrder = word_order
        self._snapshot = Snapshot()
        self._stalled = False
        self._lock = threading.Lock()
        self._registers = _ServedRegisters(on_control)
        self.slave = Slave(dict.fromkeys(unit_ids, self._registers), _identity())
        self.connections: set[_Connection] = set()
        self._strangers: set[str] = set()
        self._thread: threading.Thread | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._listening = threading.Event()
        self._stopping = asyncio.Event()

    @property
    def port(self) -> int:
        """The port listened on; the one asked for before :meth:`start`."""
        return self._port

    def start(self) -> None:
        """Return once clients are served. Raises :class:`PlcServerError`."""
        listener = _listen(self._host, self._port)
        self._port = listener.getsockname()[1]
        self._started_s = self._beat_s = time.monotonic()
        self._refresh()
        self._thread = threading.Thread(target=asyncio.run, args=(self._serve(listener),), name="plc", daemon=True)
        self._thread.start()
        if not self._listening.wait(START_DEADLINE_S):
            raise PlcServerError(f"PLC server on {self._host}:{self._port} did not start; see the log")
        log.info("PLC server listens on %s:%d", self._host, self._port)

    def publish(self, snapshot: Snapshot) -> None:
        """Serve this from now on, whole. Counts as a beat."""
        with self._lock:
            self._beat_s = time.monotonic()
            self._swap(snapshot)

    def show(self, snapshot: Snapshot) -> None:
        """As :meth:`publish`, but no beat: what the PLC asks for says nothing of the cycle."""
        with self._lock:
            self._swap(snapshot)

    @property
    def stalled(self) -> bool:
        """Whether the cycle has stopped beating."""
        return self._stalled

    def beat(self) -> None:
        """The cycle is alive; to be called each turn."""
        self._beat_s = time.monotonic()

    def stop(self) -> None:
        """Close every connection and the port. May be called twice, or without :meth:`start`."""
        if self._thread is None or self._loop is None:
            return
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._stopping.set)
        self._thread.join(START_DEADLINE_S)

    def admits(self, peer: str) -> bool:
        """Whether this address may connect, and there is room; says in the log, once an address, why not."""
        address = ip_address(peer)
        if isinstance(address, IPv6Address) and address.ipv4_mapped:
            address = address.ipv4_mapped
        if not any(address in network for network in self._networks):
            self._name_stranger(peer, "is not on the allow-list")
            return False
        if len(self.connections) >= self._max_connections:
            self._name_stranger(peer, f"found all {self._max_connections} connections taken")
            return False
        return True

    def _name_stranger(self, peer: str, why: str) -> None:
        if peer not in self._strangers and len(self._strangers) < MAX_NAMED_STRANGERS:
            self._strangers.add(peer)
            log.warning("PLC client %s refused: it %s", peer, why)

    def _refresh(self) -> None:
        """Bring age, heartbeat and the stall up to date."""
        with self._lock:
            self._swap(self._snapshot)

    def _swap(self, snapshot: Snapshot) -> None:
        """Build the image aside and put it in place; only under the lock, so that an older one never follows."""
        now_s = time.monotonic()
        stalled = now_s - self._beat_s > self._stall_after_s
        if stalled is not self._stalled:
            self._note_stall(stalled)
        shown = as_stalled(snapshot) if stalled else snapshot
        self._registers.image = encode_image(shown, now_s, int(now_s - self._started_s), self._word_order)
        self._snapshot = snapshot

    def _note_stall(self, stalled: bool) -> None:
        self._stalled = stalled
        if stalled:
            log.error("Inspection cycle has not turned for %g s: the PLC is told", self._stall_after_s)
        else:
            log.info("Inspection cycle turns again")

    async def _serve(self, listener: socket.socket) -> None:
        self._loop = asyncio.get_running_loop()
        server = await self._loop.create_server(lambda: _Connection(self), sock=listener)
        self._listening.set()
        try:
            while not self._stopping.is_set():
                self._refresh()
                self._close_idlers()
                await _wait(self._stopping, REFRESH_S)
        finally:
            server.close()
            for connection in list(self.connections):
                connection.abort()

    def _close_idlers(self) -> None:
        now_s = time.monotonic()
        for connection in list(self.connections):
            if connection.overdue(now_s, self._idle_timeout_s):
                connection.abort()


def as_stalled(snapshot: Snapshot) -> Snapshot:
    """The snapshot as it must be shown when nobody stands behind it any more."""
    return replace(
        snapshot,
        state=State.ERROR,
        fault_code=Fault.CYCLE_STALLED,
        verdict=Verdict.NOT_INSPECTED,
        reasons=Reason.DEVICE_FAULT,
        defects=(),
        unpaired_count=0,
        plc=replace(snapshot.plc, answers=snapshot.plc.answers & ~(Answer.ONLINE | Answer.TRIGGER_READY)),
    )


class _ServedRegisters:
    """The image as a Modbus data model: holding registers mirror input registers; the control block can be written."""

    image = Image(())

    def __init__(self, on_control: OnControl | None) -> None:
        self._on_control = on_control

    def read_registers(self, table: Table, address: int, count: int) -> bytes:
        for first, data in self.image.areas:
            start = 2 * (address - first)
            end = start + 2 * count
            if start >= 0 and end <= len(data):
                return data[start:end]
        raise IllegalAddress

    def write_registers(self, address: int, data: bytes) -> None:
        words = struct.unpack(f">{len(data) // 2}H", data)
        last = CONTROL_ADDRESS + CONTROL_WORDS - len(words)
        if self._on_control is None or not CONTROL_ADDRESS <= address <= last:
            raise IllegalAddress
        self._on_control(address, words)

    def read_bits(self, table: Table, address: int, count: int) -> Sequence[bool]:
        raise IllegalAddress

    def write_bits(self, address: int, bits: Sequence[bool]) -> None:
        raise IllegalAddress


class _Connection(asyncio.BufferedProtocol):
    """One client. Its small buffer bounds what it can make us do before the others have their turn."""

    def __init__(self, server: PlcServer) -> None:
        self._server = server
        self._session = TcpSession(server.slave)
        self._view = memoryview(bytearray(RECEIVE_BYTES))
        self._answered_s = time.monotonic()
        self._blocked_s: float | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        peer = transport.get_extra_info("peername")
        if not peer or not self._server.admits(peer[0]):
            transport.abort()
            return
        self._server.connections.add(self)
        transport.set_write_buffer_limits(high=UNREAD_BYTES)

    def get_buffer(self, sizehint: int) -> memoryview:
        return self._view

    def buffer_updated(self, nbytes: int) -> None:
        answers = self._session.receive(bytes(self._view[:nbytes]))
        if answers:
            # Only whole requests keep a connection alive: dribbling bytes into it does not.
            self._answered_s = time.monotonic()
            self._transport.write(answers)
        if self._session.broken:
            self._transport.close()

    def pause_writing(self) -> None:
        self._blocked_s = time.monotonic()
        self._transport.pause_reading()

    def resume_writing(self) -> None:
        self._blocked_s = None
        self._transport.resume_reading()

    def connection_lost(self, exc: Exception | None) -> None:
        self._server.connections.discard(self)

    def overdue(self, now_s: float, idle_timeout_s: float) -> bool:
        """Silent, or not taking its answers, for too long."""
        blocked = self._blocked_s is not None and now_s - self._blocked_s > SLOW_READER_S
        return blocked or now_s - self._answered_s > idle_timeout_s

    def abort(self) -> None:
        self._transport.abort()


def _listen(host: str, port: int) -> socket.socket:
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        return socket.create_server((host, port), family=family, backlog=128)
    except OSError as error:
        reason = os.strerror(error.errno) if error.errno and error.errno > 0 else error.strerror
        message = f"PLC server cannot listen on {host}:{port}: {reason}; {_remedy(error, port)}"
        raise PlcServerError(message) from error


def _remedy(error: OSError, port: int) -> str:
    if error.errno == errno.EADDRINUSE:
        return f"stop the program that has it (ss -ltnp 'sport = :{port}') or set another port"
    if error.errno == errno.EACCES:
        return "set a port of 1024 or above, or grant the service CAP_NET_BIND_SERVICE"
    return "set host to an address of this machine, or 0.0.0.0 for all of them"


def _identity() -> dict[int, str]:
    """What function 43/14 tells: vendor, product code, revision."""
    return {0: PRODUCT, 1: PRODUCT, 2: version(PRODUCT)}


async def _wait(event: asyncio.Event, timeout_s: float) -> None:
    """Until the event is set or the time is over."""
    try:
        await asyncio.wait_for(event.wait(), timeout_s)
    except TimeoutError:
        return
