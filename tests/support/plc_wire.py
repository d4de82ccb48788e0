"""A client of the PLC server on a bare socket, byte by byte."""

from __future__ import annotations

import contextlib
import socket
import struct

from inspector.publish.plc_server import PlcServer


def connect(server: PlcServer, address: str = "127.0.0.1") -> socket.socket:
    """A connection to the server's TCP port, from this address of the host."""
    client = socket.create_connection(("127.0.0.1", server.port), timeout=20, source_address=(address, 0))
    client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return client


def receive(client: socket.socket, size: int) -> bytes:
    """So many bytes, to the last."""
    data = b""
    while len(data) < size:
        piece = client.recv(size - len(data))
        assert piece, f"closed after {len(data)} of {size} bytes"
        data += piece
    return data


def ask(client: socket.socket, request: str) -> str:
    """The answer without its header, to a request given with everything after the length: unit and PDU."""
    body = bytes.fromhex(request)
    client.sendall(b"\x12\x34\0\0" + len(body).to_bytes(2, "big") + body)
    transaction, protocol, length = struct.unpack(">HHH", receive(client, 6))
    assert (transaction, protocol) == (0x1234, 0)
    return receive(client, length).hex(" ")


def is_closed(client: socket.socket) -> bool:
    """Whether the server has ended the connection; what it still had to say is read away."""
    with contextlib.suppress(ConnectionResetError):
        while client.recv(65536):
            pass
    return True
