"""Modbus/TCP Security: TLS with certificates on both sides, and the role in the client's.

Source: MODBUS/TCP Security Protocol Specification V2.1: TLS 1.2 or later, mutual authentication, port 802, the role as
a UTF8String in an X.509v3 extension with object identifier 1.3.6.1.4.1.50316.802.1.

Imported only where TLS is configured: :mod:`ssl` costs some time and memory.
"""

from __future__ import annotations

import contextlib
import os
import select
import socket
import ssl
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import ClassVar, Protocol

from firmware_bridge.wire.modbus_frames import TcpSession
from inspector import credential
from inspector.publish.plc_connection import Connection, Ending

ROLE_OID = bytes.fromhex("2b06010401 83890c 8622 01")
"""1.3.6.1.4.1.50316.802.1, as DER encodes it."""
HANDSHAKE_S = 5.0
"""A client that has not finished its handshake by then is closed."""

_OBJECT_IDENTIFIER, _OCTET_STRING, _UTF8_STRING, _EXTENSIONS = 0x06, 0x04, 0x0C, 0xA3


class TlsFiles(Protocol):
    """Where certificates and key are; all PEM."""

    @property
    def certificate(self) -> Path: ...
    @property
    def key(self) -> Path: ...
    @property
    def client_ca(self) -> Path: ...


class TlsError(Exception):
    """A file cannot be used: ``key`` is its setting's name; the message names the file, the cause and the remedy."""

    def __init__(self, key: str, path: Path, why: str, remedy: str) -> None:
        super().__init__(f"{path}: {why}; {remedy}")
        self.key, self.path, self.why, self.remedy = key, path, why, remedy


def context(files: TlsFiles) -> ssl.SSLContext:
    """What secure connections are made with. Raises TlsError."""
    made = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    made.minimum_version = ssl.TLSVersion.TLSv1_2
    made.verify_mode = ssl.CERT_REQUIRED
    made.options |= ssl.OP_NO_RENEGOTIATION
    for name, path in (("certificate", files.certificate), ("key", files.key), ("client_ca", files.client_ca)):
        _check_readable(name, path)
    _load("certificate", files.certificate, "give a PEM file", lambda: _certificate_only(files.certificate))
    remedy = "give the PEM key of the certificate, without a password"
    _load("key", files.key, remedy, lambda: made.load_cert_chain(files.certificate, files.key, password=_no_password))
    _load("client_ca", files.client_ca, "give a PEM file", lambda: made.load_verify_locations(files.client_ca))
    if not made.get_ca_certs():
        raise TlsError("client_ca", files.client_ca, "has no authority's certificate", "put it there, as PEM")
    return made


def _check_readable(name: str, path: Path) -> None:
    try:
        path.open("rb").close()
    except OSError as error:
        reason = os.strerror(error.errno) if error.errno else str(error)
        raise TlsError(name, path, reason, credential.remedy(path)) from error


def _certificate_only(path: Path) -> None:
    """Raise ssl.SSLError if there is no certificate in the file: OpenSSL would blame the key."""
    ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT).load_verify_locations(path)


def _no_password() -> str:
    raise ValueError("is locked with a password")


def _load(name: str, path: Path, remedy: str, load: Callable[[], object]) -> None:
    try:
        load()
    except (OSError, ValueError) as error:
        why = getattr(error, "reason", None) or str(error)
        raise TlsError(name, path, str(why).lower().replace("_", " "), remedy) from error


class SecureConnection(Connection):
    """A client over TLS: first the handshake, then as any other.

    With ``write_roles``, only who has one of them in its certificate keeps the right to write.
    """

    NOT_YET: ClassVar[tuple[type[OSError], ...]] = (BlockingIOError, ssl.SSLWantReadError, ssl.SSLWantWriteError)

    def __init__(
        self,
        tls: ssl.SSLContext,
        client: socket.socket,
        address: str,
        session: TcpSession,
        write_roles: Collection[str] = (),
    ) -> None:
        client.setblocking(False)
        self._secure = tls.wrap_socket(client, server_side=True, do_handshake_on_connect=False)
        self._session, self._write_roles, self._proven = session, write_roles, False
        super().__init__(self._secure, address, session)
        self._began_s = self.heard_s

    @property
    def direct(self) -> bool:
        """Never: what comes is to be decrypted first."""
        return False

    def overdue(self, now_s: float, idle_timeout_s: float) -> Ending | None:
        """Why it has to be closed by now, if it has."""
        if not self._proven and now_s - self._began_s > HANDSHAKE_S:
            return Ending.NOT_SECURE
        return super().overdue(now_s, idle_timeout_s)

    def close(self) -> None:
        """Say good-bye if that can be done at once, and close."""
        if self._proven:
            with contextlib.suppress(OSError, ValueError):
                self._secure.unwrap()
        super().close()

    def _go_on(self) -> None:
        if not self._proven:
            self._shake_hands()
        super()._go_on()
        while self._secure.pending() and not self._unsent and self.ending is None:
            super()._go_on()  # decrypted already: no event will tell

    def _shake_hands(self) -> None:
        try:
            self._secure.do_handshake()
        except ssl.SSLWantWriteError:
            self.wanted = select.EPOLLOUT
            raise
        except ssl.SSLWantReadError:
            self.wanted = select.EPOLLIN
            raise
        except OSError:
            self.ending = Ending.NOT_SECURE
            raise
        self._proven, self.wanted = True, select.EPOLLIN
        if self._write_roles and role(self._secure.getpeercert(binary_form=True) or b"") not in self._write_roles:
            self._session.may_write = False


def role(certificate: bytes) -> str | None:
    """The Modbus role in a certificate (DER, verified already); None if it names none, or not as specified.

    Extensions are found by walking down the certificate, not by searching it: a subject's name may hold any bytes.
    """
    try:
        ((_, whole),) = _elements(certificate)
        (_, to_be_signed), *_ = _elements(whole)
        for kind, extensions in _elements(to_be_signed):
            if kind == _EXTENSIONS:
                ((_, listed),) = _elements(extensions)
                return next((found for _, item in _elements(listed) if (found := _role(item)) is not None), None)
    except (ValueError, IndexError):
        return None
    return None


def _role(extension: bytes) -> str | None:
    (kind, identifier), *_, (last_kind, value) = _elements(extension)
    if kind != _OBJECT_IDENTIFIER or identifier != ROLE_OID or last_kind != _OCTET_STRING:
        return None
    ((text_kind, text),) = _elements(value)
    return text.decode() if text_kind == _UTF8_STRING else None


def _elements(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Tag and content of each DER element in a row. Raises ValueError or IndexError where it ends too early."""
    at = 0
    while at < len(data):
        tag, size, at = data[at], data[at + 1], at + 2
        if size & 0x80:
            long = size & 0x7F
            size, at = int.from_bytes(data[at : at + long], "big"), at + long
        if at + size > len(data):
            raise ValueError("an element is longer than what holds it")
        yield tag, data[at : at + size]
        at += size
