"""The station's Modbus server: serves the last published image, whole, from a thread of its own.

Rules. A read is answered from one published image, so it is never torn; there is one for all clients, so that none sees
an older one than another has seen. The server never waits for the inspection:
if the cycle stops beating, the server itself tells the PLC that the cycle has stalled. One client costs the others
nothing: each is read a little a turn, and closed when it is silent, does not take its answers, or speaks something
else. Who may connect and who may write is told apart by address (:mod:`inspector.publish.plc_access`). TLS
(:mod:`inspector.publish.plc_tls`) and a serial line (:mod:`inspector.publish.plc_serial`) show the same registers.
"""

from __future__ import annotations

import errno
import logging
import os
import socket
import threading
import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from typing import TYPE_CHECKING

from firmware_bridge.wire.modbus import MAX_IDENTITY_BYTES, Slave
from firmware_bridge.wire.modbus_frames import TcpSession
from inspector.faults import Fault
from inspector.handshake_table import Answer
from inspector.model import Reason, Snapshot, State, Verdict
from inspector.publish.plc_access import LOOPBACK, Networks
from inspector.publish.plc_clients import Access, Clients, Door, Welcome
from inspector.publish.plc_connection import Connection, Ending
from inspector.publish.plc_direct import Direct
from inspector.publish.plc_registers import OnControl, ServedRegisters
from inspector.publish.published_image import PublishedImage
from inspector.publish.registers import MAP_VERSION, WordOrder, encode_image

if TYPE_CHECKING:
    from inspector.publish.plc_serial import SerialShell
    from inspector.publish.plc_settings import SerialSettings, TlsSettings

log = logging.getLogger(__name__)

ANY_USUAL_UNIT = (0, 1, 255)
"""What clients put in the unit id of a device that is reached directly over TCP."""
PRODUCT = "seed-inspector"

REFRESH_S = 0.25
"""How often age and heartbeat are brought up to date, and connections looked over."""
STOP_DEADLINE_S = 5.0


class PlcServerError(Exception):
    """The server cannot listen; the message names the address or file, the cause and the remedy."""


@dataclass(frozen=True, slots=True)
class Diagnostics:
    """What the server has counted. Requests, exceptions and ``out_of_step`` restart when function 8 clears them."""

    connected: int
    """Clients there are."""
    accepted: int
    refused_strangers: int
    refused_full: int
    gave_way: int
    """Connections closed to make room for another."""
    closed_idle: int
    closed_slow: int
    """Clients that did not take their answers."""
    not_secure: int
    """Clients that did not prove themselves in the TLS handshake."""
    requests: int
    exceptions: Mapping[int, int]
    """How often each exception code was answered."""
    out_of_step: int
    """Stretches of bytes that were no Modbus; over TCP each ended its connection."""
    stalls: int
    """How often the cycle has stopped beating."""
    serial_open: bool
    """Whether the serial line is there; False without one."""


class PlcServer:
    """Serves register images over Modbus. Every method may be called from any thread.

    ``allow``: networks whose hosts may connect; of these, ``allow_write`` may write the control block, which
    ``on_control`` is told (see :class:`~inspector.publish.plc_registers.ServedRegisters`). ``port`` 0 takes any free
    one. ``stall_after_s``: without :meth:`beat` or :meth:`publish` for so long, what is served is state
    ERROR, fault CYCLE_STALLED, NOT_INSPECTED. ``name`` is the station's, for function 43/14.
    """

    def __init__(
        self,
        host: str = "127.0.0.1",
        port: int = 502,
        *,
        unit_ids: Sequence[int] = ANY_USUAL_UNIT,
        allow: Iterable[str] = LOOPBACK,
        allow_write: Iterable[str] = LOOPBACK,
        max_connections: int = 16,
        idle_timeout_s: float = 60.0,
        stall_after_s: float = 2.0,
        word_order: WordOrder = "high_first",
        serial: SerialSettings | None = None,
        tls: TlsSettings | None = None,
        on_control: OnControl | None = None,
        name: str = "",
    ) -> None:
        self._host, self._port, self._tls, self._tls_port = host, port, tls, tls.port if tls else 0
        self._access = Access(Networks(allow), Networks(allow_write), max_connections, idle_timeout_s)
        self.stall_after_s = stall_after_s
        self._silence_s: float | None = None
        self._word_order: WordOrder = word_order
        self._snapshot = Snapshot()
        self._started_s = self._beat_s = time.monotonic()
        self._stalled, self._stalls = False, 0
        self._lock = threading.Lock()
        self._published = PublishedImage()
        registers = ServedRegisters(self._published, on_control, threading.RLock())
        self._slave = Slave(dict.fromkeys(unit_ids, registers), _identity(name))
        self._direct = Direct(self._published, unit_ids, self._slave.counters)
        self._serial = serial
        self._serial_slave = Slave({serial.unit: registers} if serial else {}, _identity(name))
        self._clients: Clients | None = None
        self._shell: SerialShell | None = None
        self._thread: threading.Thread | None = None

    @property
    def port(self) -> int:
        """The port listened on; the one asked for before :meth:`start`."""
        return self._port

    @property
    def tls_port(self) -> int:
        """The port of Modbus/TCP Security; 0 without TLS."""
        return self._tls_port

    @property
    def diagnostics(self) -> Diagnostics:
        """What was counted so far."""
        return _diagnostics(self._clients, (self._slave, self._serial_slave), self._shell, self._stalls)

    def start(self) -> None:
        """Return once clients are served. Raises :class:`PlcServerError`, and then serves nothing."""
        clients = Clients(self._access, self._direct)
        try:
            self._port = self._listen(clients, self._host, self._port, self._welcome)
            if self._tls:
                self.renew_certificates()
                self._tls_port = self._listen(clients, self._tls.host, self._tls.port, self._welcome_securely)
        except PlcServerError:
            clients.close()
            raise
        self._clients = clients
        self._started_s = self._beat_s = time.monotonic()
        self._refresh()
        self._thread = threading.Thread(target=clients.run, args=(self._refresh, REFRESH_S), name="plc", daemon=True)
        self._thread.start()
        self._start_serial()

    def publish(self, snapshot: Snapshot) -> None:
        """Serve this from now on, whole. Counts as a beat."""
        with self._lock:
            self.beat()
            self._swap(snapshot)

    def show(self, snapshot: Snapshot) -> None:
        """As :meth:`publish`, but no beat: what the PLC asks for says nothing of the cycle."""
        with self._lock:
            self._swap(snapshot)

    @property
    def stalled(self) -> bool:
        """Whether the cycle has stopped beating."""
        return self._stalled

    def beat(self, silence_s: float | None = None) -> None:
        """The cycle is alive; to be called each turn. The next one comes within ``silence_s``, or ``stall_after_s``."""
        self._beat_s = time.monotonic()  # first: a short silence is never held against an old beat
        self._silence_s = silence_s

    def renew_certificates(self) -> None:
        """Read the files of TLS again, for connections from now on. Raises PlcServerError; then the old ones hold."""
        if self._tls is None:
            return
        from inspector.publish import plc_tls  # only stations with TLS pay for it

        try:
            self._tls_context = plc_tls.context(self._tls)
        except plc_tls.TlsError as error:
            raise PlcServerError(f"PLC server cannot use {error}") from error

    def stop(self) -> None:
        """Close every connection and port. May be called twice, or without :meth:`start`."""
        if self._shell:
            self._shell.stop()
        if self._thread and self._clients:
            self._clients.stop()
            self._thread.join(STOP_DEADLINE_S)
            self._clients.close()
        self._shell = self._thread = None

    def _listen(self, clients: Clients, host: str, port: int, welcome: Welcome) -> int:
        listener = _listener(host, port)
        clients.listen(listener, welcome)
        port = listener.getsockname()[1]
        log.info("PLC server listens on %s:%d", host, port)
        return port

    def _welcome(self, client: socket.socket, address: str, may_write: bool) -> Connection:
        return Connection(client, address, self._session(may_write))

    def _welcome_securely(self, client: socket.socket, address: str, may_write: bool) -> Connection:
        from inspector.publish.plc_tls import SecureConnection

        roles = self._tls.write_roles if self._tls else ()
        return SecureConnection(self._tls_context, client, address, self._session(may_write), roles)

    def _session(self, may_write: bool) -> TcpSession:
        return TcpSession(self._slave, may_write=may_write)

    def _start_serial(self) -> None:
        if self._serial:
            from inspector.publish.plc_serial import SerialShell  # only stations with a serial line pay for it

            self._shell = SerialShell(self._serial_slave, self._serial)
            self._shell.start()

    def _refresh(self) -> None:
        """Bring age, heartbeat and the stall up to date. Who publishes just now does so too, and is not waited for."""
        if self._lock.acquire(blocking=False):
            try:
                self._swap(self._snapshot)
            finally:
                self._lock.release()

    def _swap(self, snapshot: Snapshot) -> None:
        """Build the image aside and put it in place; only under the lock, so that an older one never follows."""
        now_s = time.monotonic()
        allowed_s = self._silence_s or self.stall_after_s
        stalled = now_s - self._beat_s > allowed_s
        if stalled is not self._stalled:
            self._note_stall(stalled, allowed_s)
        shown = as_stalled(snapshot) if stalled else snapshot
        self._published.show(encode_image(shown, now_s, int(now_s - self._started_s), self._word_order))
        self._snapshot = snapshot

    def _note_stall(self, stalled: bool, allowed_s: float) -> None:
        self._stalled = stalled
        self._stalls += stalled
        if stalled:
            code = {"fault_code": Fault.CYCLE_STALLED}
            log.error("Inspection cycle has not turned for %g s: the PLC is told", allowed_s, extra=code)
        else:
            log.info("Inspection cycle turns again")


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
        statistics=None,
        plc=replace(snapshot.plc, answers=snapshot.plc.answers & ~(Answer.ONLINE | Answer.TRIGGER_READY)),
    )


def _diagnostics(
    clients: Clients | None, slaves: Iterable[Slave], shell: SerialShell | None, stalls: int
) -> Diagnostics:
    counters = [slave.counters for slave in slaves]
    door = clients.door if clients else Door()
    return Diagnostics(
        connected=len(clients.connections) if clients else 0,
        accepted=door.accepted,
        refused_strangers=door.refused_strangers,
        refused_full=door.refused_full,
        gave_way=door.endings[Ending.GAVE_WAY],
        closed_idle=door.endings[Ending.IDLE],
        closed_slow=door.endings[Ending.SLOW],
        not_secure=door.endings[Ending.NOT_SECURE],
        requests=sum(counter.requests for counter in counters),
        exceptions=dict(sum((Counter(dict(counter.exceptions)) for counter in counters), Counter())),
        out_of_step=sum(counter.errors for counter in counters),
        stalls=stalls,
        serial_open=shell is not None and shell.is_open,
    )


def _listener(host: str, port: int) -> socket.socket:
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


def _identity(name: str) -> dict[int, str]:
    """What function 43/14 tells: vendor, product code, revision; product name, model and the station's own name."""
    basic = {0: PRODUCT, 1: PRODUCT, 2: version(PRODUCT)}
    own = name.encode("ascii", "replace").decode()[:MAX_IDENTITY_BYTES]
    return basic | {4: PRODUCT, 5: f"register map {MAP_VERSION}"} | ({6: own} if own else {})
