"""Modbus/TCP Security from outside: OpenSSL's own client and Python's, with certificates that openssl made."""

from __future__ import annotations

import contextlib
import shutil
import socket
import ssl
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from inspector.model import Snapshot
from inspector.publish import plc_tls
from inspector.publish.plc_server import PlcServer, PlcServerError
from inspector.publish.plc_settings import TlsSettings

ASK, ANSWER = bytes.fromhex("0001 0000 0006 01 03 0000 0001"), bytes.fromhex("0001 0000 0005 01 03 02 1267")
WRITE, WRITTEN = bytes.fromhex("0002 0000 0006 01 06 01f4 0001"), bytes.fromhex("0002 0000 0006 01 06 01f4 0001")
REFUSED = bytes.fromhex("0002 0000 0003 01 86 01")
ROLE = "1.3.6.1.4.1.50316.802.1"
EXTENSIONS = {
    "station": "subjectAltName=IP:127.0.0.1",
    "plc": f"{ROLE}=ASN1:UTF8String:Operator",
    "viewer": f"{ROLE}=ASN1:UTF8String:Viewer",
    "nobody": "basicConstraints=CA:FALSE",
    "odd": f"{ROLE}=ASN1:PRINTABLESTRING:Operator",
    "liar": f"nsComment={ROLE} Operator",
}


def openssl(program: str, *arguments: object) -> None:
    subprocess.run([program, *map(str, arguments)], check=True, capture_output=True, timeout=30)


@pytest.fixture(scope="session")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Keys and certificates: ca and other-ca (authorities), a certificate from ca for each of EXTENSIONS, foreign from
    other-ca."""
    program = shutil.which("openssl")
    if program is None:
        pytest.skip("peer missing: openssl (apt install openssl)")
    folder = tmp_path_factory.mktemp("certificates")
    key = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes", "-days", 2)
    for authority in ("ca", "other-ca"):
        out = ("-keyout", folder / f"{authority}.key", "-out", folder / f"{authority}.pem")
        openssl(program, "req", "-x509", *key, *out, "-subj", f"/CN={authority}")
    for name, extension in {**EXTENSIONS, "foreign": EXTENSIONS["plc"]}.items():
        authority = "other-ca" if name == "foreign" else "ca"
        signed_by = ("-CA", folder / f"{authority}.pem", "-CAkey", folder / f"{authority}.key")
        out = ("-keyout", folder / f"{name}.key", "-out", folder / f"{name}.pem")
        openssl(
            program,
            "req",
            "-x509",
            *key,
            *signed_by,
            *out,
            "-subj",
            f"/CN={name} {ROLE} Operator",
            "-addext",
            extension,
        )
    return folder


@pytest.fixture
def settings(files: Path) -> TlsSettings:
    return TlsSettings(port=0, certificate=files / "station.pem", key=files / "station.key", client_ca=files / "ca.pem")


Start = Callable[..., PlcServer]


@pytest.fixture
def start(settings: TlsSettings) -> Iterator[Start]:
    with contextlib.ExitStack() as stack:

        def run(write_roles: tuple[str, ...] = (), **options: Any) -> PlcServer:
            tls = settings.model_copy(update={"write_roles": write_roles})
            server = PlcServer(port=0, stall_after_s=60.0, tls=tls, on_control=lambda *_: None, **options)
            server.start()
            stack.callback(server.stop)
            server.publish(Snapshot(sequence=4711))
            return server

        yield run


def client_context(files: Path, name: str | None) -> ssl.SSLContext:
    made = ssl.create_default_context(cafile=str(files / "ca.pem"))
    if name:
        made.load_cert_chain(files / f"{name}.pem", files / f"{name}.key")
    return made


@contextlib.contextmanager
def secure(server: PlcServer, context: ssl.SSLContext) -> Iterator[ssl.SSLSocket]:
    with (
        socket.create_connection(("127.0.0.1", server.tls_port), timeout=20) as plain,
        context.wrap_socket(plain, server_hostname="127.0.0.1") as client,
    ):
        yield client


def asked(client: ssl.SSLSocket, request: bytes) -> bytes:
    client.sendall(request)
    answer = client.recv(6)
    size = int.from_bytes(answer[4:], "big")
    while len(answer) < 6 + size:
        piece = client.recv(6 + size - len(answer))
        assert piece
        answer += piece
    return answer


def is_turned_away(server: PlcServer, context: ssl.SSLContext) -> bool:
    """With TLS 1.3 a client learns only after its handshake that it was not believed."""
    try:
        with secure(server, context) as client:
            client.sendall(ASK)
            return client.recv(100) == b""
    except OSError:
        return True


def test_openssls_own_client_reads(start: Start, files: Path, peer: Any) -> None:
    server = start()
    command = [peer("openssl", "openssl"), "s_client", "-connect", f"127.0.0.1:{server.tls_port}", "-quiet"]
    command += ["-cert", files / "plc.pem", "-key", files / "plc.key", "-CAfile", files / "ca.pem"]
    command += ["-verify_return_error", "-no_ign_eof"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as client:
        assert client.stdin
        assert client.stdout
        for _ in range(3):
            client.stdin.write(ASK)
            client.stdin.flush()
            assert client.stdout.read(len(ANSWER)) == ANSWER
        client.stdin.close()


@pytest.mark.parametrize("version", [ssl.TLSVersion.TLSv1_2, ssl.TLSVersion.TLSv1_3])
def test_pythons_client_reads_with_each_version(start: Start, files: Path, version: ssl.TLSVersion) -> None:
    context = client_context(files, "plc")
    context.minimum_version = context.maximum_version = version
    with secure(start(), context) as client:
        for number in range(100):
            request = number.to_bytes(2, "big") + ASK[2:]
            assert asked(client, request) == request[:2] + ANSWER[2:]
        client.sendall(ASK * 300)
        received = b""
        while len(received) < 300 * len(ANSWER):
            received += client.recv(65536)
        assert received == ANSWER * 300


@pytest.mark.parametrize("name", [None, "foreign"])
def test_who_does_not_prove_itself_is_turned_away(start: Start, files: Path, name: str | None, wait_until: Any) -> None:
    server = start()
    assert is_turned_away(server, client_context(files, name))
    wait_until(lambda: server.diagnostics.not_secure == 1, "it is counted")
    with secure(server, client_context(files, "plc")) as client:
        assert asked(client, ASK) == ANSWER


@pytest.mark.filterwarnings("ignore:ssl.TLSVersion.TLSv1_1")
def test_older_versions_and_plain_modbus_are_turned_away(start: Start, files: Path, wait_until: Any) -> None:
    server = start()
    context = client_context(files, "plc")
    context.set_ciphers("ALL:@SECLEVEL=0")
    context.minimum_version = context.maximum_version = ssl.TLSVersion.TLSv1_1
    assert is_turned_away(server, context)
    with socket.create_connection(("127.0.0.1", server.tls_port), timeout=20) as plain:
        plain.sendall(ASK)
        with contextlib.suppress(ConnectionResetError):
            assert ANSWER not in plain.recv(100)
    wait_until(lambda: server.diagnostics.not_secure == 2, "both are counted")


@pytest.mark.parametrize(
    ("name", "answer"),
    [("plc", WRITTEN), ("viewer", REFUSED), ("nobody", REFUSED), ("odd", REFUSED), ("liar", REFUSED)],
)
def test_only_the_roles_named_may_write(start: Start, files: Path, name: str, answer: bytes) -> None:
    with secure(start(write_roles=("Operator",)), client_context(files, name)) as client:
        assert asked(client, WRITE) == answer
        assert asked(client, ASK) == ANSWER


def test_without_roles_the_address_decides(start: Start, files: Path) -> None:
    with secure(start(), client_context(files, "nobody")) as client:
        assert asked(client, WRITE) == WRITTEN


def test_a_role_gives_no_right_that_the_address_has_not(start: Start, files: Path) -> None:
    server = start(write_roles=("Operator",), allow_write=("192.0.2.1",))
    with secure(server, client_context(files, "plc")) as client:
        assert asked(client, WRITE) == REFUSED


def test_strangers_see_no_handshake(start: Start) -> None:
    server = start(allow=("192.0.2.1",))
    stranger = socket.create_connection(("127.0.0.1", server.tls_port), timeout=20)
    with stranger, contextlib.suppress(ConnectionResetError):
        assert stranger.recv(1) == b""
    assert server.diagnostics.refused_strangers == 1


def test_half_a_handshake_is_closed_in_time(
    start: Start, files: Path, monkeypatch: pytest.MonkeyPatch, wait_until: Any
) -> None:
    monkeypatch.setattr(plc_tls, "HANDSHAKE_S", 0.2)
    server = start()
    with (
        socket.create_connection(("127.0.0.1", server.tls_port), timeout=20) as silent,
        secure(server, client_context(files, "plc")) as client,
    ):
        silent.sendall(b"\x16\x03\x01")
        wait_until(lambda: server.diagnostics.not_secure == 1, "the silent one is closed")
        assert asked(client, ASK) == ANSWER


def test_a_client_that_never_reads_is_closed_and_costs_the_others_nothing(
    start: Start, files: Path, monkeypatch: pytest.MonkeyPatch, wait_until: Any
) -> None:
    monkeypatch.setattr("inspector.publish.plc_connection.SLOW_READER_S", 0.2)
    server, whole_block = start(), bytes.fromhex("0001 0000 0006 01 03 0000 007d") * 100
    with secure(server, client_context(files, "plc")) as deaf, secure(server, client_context(files, "plc")) as good:
        deaf.setblocking(False)

        def shout() -> int:
            with contextlib.suppress(OSError):
                deaf.send(whole_block)
            return server.diagnostics.closed_slow

        wait_until(shout, "the client that never reads is closed")
        assert asked(good, ASK) == ANSWER


def test_certificates_are_renewed_for_new_connections(start: Start, files: Path, settings: TlsSettings) -> None:
    server = start()
    with secure(server, client_context(files, "plc")) as old:
        kept = settings.certificate.read_bytes()
        try:
            settings.certificate.write_bytes(b"half a file")
            with pytest.raises(PlcServerError, match=r"station\.pem: .*; give a PEM file"):
                server.renew_certificates()
            with secure(server, client_context(files, "plc")) as still:
                assert asked(still, ASK) == ANSWER
        finally:
            settings.certificate.write_bytes(kept)
        server.renew_certificates()
        assert asked(old, ASK) == ANSWER
    with secure(server, client_context(files, "plc")) as new:
        assert asked(new, ASK) == ANSWER


@pytest.mark.parametrize(
    ("key", "content", "message"),
    [
        ("certificate", None, r"none\.pem: No such file or directory; give a file that the service may read"),
        ("certificate", "plc.key", r"plc\.key: .*; give a PEM file"),
        ("key", "plc.key", r"plc\.key: .*mismatch; give the PEM key of the certificate"),
        ("client_ca", "plc.key", r"plc\.key: .*; give a PEM file"),
        ("client_ca", "nobody.pem", r"nobody\.pem: has no authority's certificate"),
    ],
)
def test_a_file_that_cannot_be_used_is_named(
    settings: TlsSettings, files: Path, key: str, content: str | None, message: str
) -> None:
    spoilt = settings.model_copy(update={key: files / (content or "none.pem")})
    with pytest.raises(PlcServerError, match=f"PLC server cannot use .*{message}"):
        PlcServer(port=0, tls=spoilt).start()


def test_a_role_is_read_from_where_it_belongs(files: Path) -> None:
    def der(name: str) -> bytes:
        return ssl.PEM_cert_to_DER_cert((files / f"{name}.pem").read_text())

    roles = {name: plc_tls.role(der(name)) for name in EXTENSIONS}
    assert roles == {"plc": "Operator", "viewer": "Viewer"} | dict.fromkeys(("station", "nobody", "odd", "liar"))
    whole = der("plc")
    assert all(plc_tls.role(whole[:size]) is None for size in range(len(whole)))
