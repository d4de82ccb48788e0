"""What a station must say about the ways in which its PLC reaches it."""

from __future__ import annotations

import ipaddress
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, Field, PositiveFloat, model_validator

from firmware_bridge.strict import Strict
from inspector.credential import SecretPath
from inspector.publish.plc_access import LOOPBACK
from inspector.publish.registers import RESULT_WORDS


def _network(text: str) -> str:
    try:
        ipaddress.ip_network(text)
    except ValueError as error:
        raise ValueError(f"allowed: an address or a network such as 192.168.1.0/24 ({error})") from error
    return text


Network = Annotated[str, AfterValidator(_network)]
FilePath = Annotated[Path, Field(strict=False)]


_NOT_SERVED = ("buffer_results", "post", "sequence_file")


class SerialSettings(Strict):
    """The same registers over a serial line, as a Modbus RTU slave; 8 data bits."""

    port: str = Field(min_length=1)
    """The port's device file; /dev/serial/by-id/... keeps its name when the adapter is replugged."""
    baud: Literal[1200, 2400, 4800, 9600, 19200, 38400, 57600, 115200] = 9600
    """Bits per second."""
    parity: Literal["N", "E", "O"] = "N"
    """None, even or odd."""
    stop_bits: Literal[1, 2] = 1
    """Stop bits."""
    unit: int = Field(1, ge=1, le=247)
    """Modbus unit id (slave address) on this line."""
    allow_write: bool = True
    """Whether the line's master may write the control block."""


class TlsSettings(Strict):
    """The same registers over Modbus/TCP Security: TLS 1.2 or later, certificates on both sides."""

    host: str = Field("127.0.0.1", min_length=1)
    """Address of this machine to listen on; 0.0.0.0 for all of them."""
    port: int = Field(802, ge=0, le=65535)
    """TCP port; 802 is Modbus/TCP Security's own and needs a privilege; 0 takes any free one."""
    certificate: FilePath
    """The station's certificate, and those between it and its root; PEM."""
    key: SecretPath
    """The private key of that certificate; PEM, without a password. `credential:NAME`: the one that systemd hands to
    the service (LoadCredential=)."""
    client_ca: FilePath
    """Certificates of the authorities that clients' certificates must come from; PEM."""
    write_roles: tuple[str, ...] = ()
    """Roles (in the client's certificate, OID 1.3.6.1.4.1.50316.802.1) that may write; empty: allow_write decides."""

    def under(self, folder: Path) -> TlsSettings:
        """The same settings with relative paths taken from ``folder``."""
        names = ("certificate", "key", "client_ca")
        return self.model_copy(update={name: folder / getattr(self, name) for name in names})


class PostSettings(Strict):
    """A PLC into whose holding registers the station writes its result block, by function 16."""

    host: str = Field(min_length=1)
    """Address or name of the PLC."""
    port: int = Field(502, ge=1, le=65535)
    """TCP port of the PLC's Modbus server."""
    unit: int = Field(1, ge=0, le=255)
    """Modbus unit id of the PLC."""
    address: int = Field(0, ge=0, le=0x10000 - RESULT_WORDS)
    """First of the registers that take the block, zero-based."""
    acknowledge_address: int | None = Field(None, ge=0, le=0xFFFF)
    """The PLC's register that holds the sequence of the result it took last; the next follows then. null: it follows at
    once."""
    queue: int = Field(64, ge=1, le=1024)
    """Results that wait while the PLC is away or slow; what finds no room is lost and counted."""
    period_s: float = Field(0.5, gt=0, le=60)
    """The block is written this often when nothing is new, so that heartbeat and age go on, seconds."""
    deadline_s: float = Field(1.0, gt=0, le=10)
    """The PLC must answer a request in this time, seconds."""
    retry_first_s: float = Field(0.5, gt=0, le=60)
    """After a failure it is tried again after this time, seconds; each further failure doubles it."""
    retry_longest_s: float = Field(5.0, gt=0, le=600)
    """The longest time between two tries, seconds."""

    @model_validator(mode="after")
    def _acknowledge_apart(self) -> Self:
        if self.acknowledge_address in range(self.address, self.address + RESULT_WORDS):
            allowed = f"below {self.address} or from {self.address + RESULT_WORDS} on"
            raise ValueError(f"acknowledge_address lies in the block; allowed: {allowed}")
        return self


class PlcSettings(Strict):
    """The Modbus server that the line's PLC polls."""

    host: str = Field("127.0.0.1", min_length=1)
    """Address of this machine to listen on; 0.0.0.0 for all of them."""
    port: int = Field(5020, ge=0, le=65535)
    """TCP port; 502 is Modbus' own and needs a privilege; 0 takes any free one."""
    unit_ids: tuple[Annotated[int, Field(ge=0, le=255)], ...] = Field((0, 1, 255), min_length=1)
    """Unit ids that are answered over TCP."""
    allow: tuple[Network, ...] = LOOPBACK
    """Addresses and networks that may connect."""
    allow_write: tuple[Network, ...] = LOOPBACK
    """Of those, the ones whose writes are carried out; the others read only."""
    max_connections: int = Field(16, ge=1, le=1024)
    """With more clients than this at once, whoever holds most connections loses one."""
    idle_timeout_s: PositiveFloat = 60.0
    """A connection without a request for so long is closed, seconds."""
    word_order: Literal["high_first", "low_first"] = "high_first"
    """Order of the two registers of a 32-bit value."""
    buffer_results: bool = False
    """Keep each result until the PLC acknowledges it, also while its bit BUFFER_RESULTS is off."""
    sequence_file: FilePath | None = None
    """File in which the last result's number is kept, so that `sequence` goes on after a restart; null: in the
    archive's folder, or without an archive from 0."""
    post: PostSettings | None = None
    """A PLC that results are written into, beside being served; null: none."""
    serial: SerialSettings | None = None
    """A serial line that is served too; null: none."""
    tls: TlsSettings | None = None
    """A port for Modbus/TCP Security, served too; null: none."""

    @model_validator(mode="after")
    def _acknowledged_once(self) -> Self:
        if self.post and self.post.acknowledge_address is not None and self.sequence_file is None:
            why = "after a restart, sequences that the PLC has acknowledged would come again"
            raise ValueError(f"post.acknowledge_address needs sequence_file: {why}; allowed: both, or neither")
        return self

    @property
    def served(self) -> dict[str, Any]:
        """What of these the server itself is given; the rest is for what stands behind the registers."""
        return {name: value for name, value in self if name not in _NOT_SERVED}

    @property
    def ports(self) -> set[int]:
        """The TCP ports that are listened on; 0 is any free one."""
        return {self.port} | ({self.tls.port} if self.tls else set())

    def under(self, folder: Path) -> PlcSettings:
        """The same settings with relative paths taken from ``folder``."""
        tls, file = self.tls and self.tls.under(folder), self.sequence_file and folder / self.sequence_file
        return self.model_copy(update={"tls": tls, "sequence_file": file})
