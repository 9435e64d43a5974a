"""TLS at the local platform's listener: old versions, weak ciphers and plain text have no answer (T19)."""

from __future__ import annotations

import asyncio
import contextlib
import datetime
import ipaddress
import random
import shutil
import socket
import ssl
import subprocess
import warnings
from collections.abc import Iterator
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from client_sdk import connect
from rse_pf.config import PlatformSettings
from rse_pf.errors import RsePfError, SettingsError
from rse_pf.local.control.platform import LocalPlatform

SOON_S = 20.0


def write_certificate(folder: Path) -> tuple[Path, Path]:
    """Write a certificate for 127.0.0.1 and its key; return both files."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "rse-pf of a test")])
    now = datetime.datetime.now(datetime.timezone.utc)
    address = x509.IPAddress(ipaddress.ip_address("127.0.0.1"))
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(1)
        .not_valid_before(now - datetime.timedelta(hours=1))
        .not_valid_after(now + datetime.timedelta(hours=1))
        .add_extension(x509.SubjectAlternativeName([address]), critical=False)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .sign(key, hashes.SHA256())
    )
    files = folder / "certificate.pem", folder / "key.pem"
    files[0].write_bytes(certificate.public_bytes(serialization.Encoding.PEM))
    files[1].write_bytes(
        key.private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        )
    )
    return files


class HandshakePolicy:
    """A platform behind TLS, run in a loop of its own so that a test may block."""

    def __init__(self, folder: Path) -> None:
        self.certificate, key = write_certificate(folder)
        settings = PlatformSettings().replace(
            local={"certificate": str(self.certificate), "private_key": str(key)}
        )
        self._loop = asyncio.new_event_loop()
        self._cloud = LocalPlatform(settings, servers=1, port=0, state=folder / "platform")
        self._loop.run_until_complete(self._cloud.__aenter__())
        self.url = self._cloud.url
        self.port = self._cloud.port

    def close(self) -> None:
        self._loop.run_until_complete(self._cloud.__aexit__(None, None, None))
        self._loop.close()

    def token(self) -> str:
        return self._cloud.issue_token("robot-1")

    def shake_hands(self, context: ssl.SSLContext) -> tuple[str, str] | None:
        """Return version and cipher that the listener agrees to, None if it agrees to nothing."""
        with socket.create_connection(("127.0.0.1", self.port), timeout=SOON_S) as plain:
            try:
                with context.wrap_socket(plain, server_hostname="127.0.0.1") as secured:
                    cipher = secured.cipher()
                    assert cipher is not None
                    return secured.version() or "", cipher[0]
            except (ssl.SSLError, ConnectionError):
                return None


@pytest.fixture(scope="module")
def listener(tmp_path_factory: pytest.TempPathFactory) -> Iterator[HandshakePolicy]:
    opened = HandshakePolicy(tmp_path_factory.mktemp("tls"))
    yield opened
    opened.close()


def speaking(version: ssl.TLSVersion, ciphers: str = "ALL:@SECLEVEL=0") -> ssl.SSLContext:
    """Return a client that speaks one version only, and takes any certificate."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    context.set_ciphers(ciphers)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        context.maximum_version = version
        context.minimum_version = version
    return context


@pytest.mark.system
@pytest.mark.parametrize("version", ["TLSv1_2", "TLSv1_3"])
def test_current_tls_versions_are_accepted_with_authenticated_ciphers(
    listener: HandshakePolicy, version: str
) -> None:
    agreed = listener.shake_hands(speaking(ssl.TLSVersion[version]))

    assert agreed is not None
    assert agreed[0] == version.replace("_", ".")
    assert "GCM" in agreed[1] or "POLY1305" in agreed[1]


@pytest.mark.system
@pytest.mark.parametrize("version", ["TLSv1", "TLSv1_1"])
def test_old_versions_get_no_handshake(listener: HandshakePolicy, version: str) -> None:
    assert listener.shake_hands(speaking(ssl.TLSVersion[version])) is None


@pytest.mark.system
def test_of_all_ciphers_that_this_machine_can_offer_only_those_with_authentication_pass(
    listener: HandshakePolicy,
) -> None:
    offered = [
        each["name"]
        for each in speaking(ssl.TLSVersion.TLSv1_2).get_ciphers()
        if each["protocol"] != "TLSv1.3"
    ]
    passed = []
    for name in offered:
        agreed = listener.shake_hands(speaking(ssl.TLSVersion.TLSv1_2, f"{name}:@SECLEVEL=0"))
        if agreed is not None:
            passed.append(agreed[1])

    assert len(offered) > 20, "this machine offers nothing weak, so nothing was tested"
    assert passed
    assert all(name.startswith("ECDHE") and ("GCM" in name or "POLY1305" in name) for name in passed), passed


@pytest.mark.system
def test_plain_text_gets_no_answer(listener: HandshakePolicy) -> None:
    with socket.create_connection(("127.0.0.1", listener.port), timeout=SOON_S) as plain:
        plain.sendall(b"GET /ws HTTP/1.1\r\nHost: a\r\n\r\n")
        answer = b""
        with contextlib.suppress(ConnectionError):
            answer = plain.recv(1024)

    assert not answer.startswith(b"HTTP")


def client_hello(version: ssl.TLSVersion, host: str = "robots.invalid") -> bytes:
    """Return the first flight of a client."""
    received, sent = ssl.MemoryBIO(), ssl.MemoryBIO()
    client = speaking(version).wrap_bio(received, sent, server_hostname=host)
    with contextlib.suppress(ssl.SSLWantReadError):
        client.do_handshake()
    return sent.read()


@pytest.mark.system
def test_damaged_first_flights_and_any_server_name_leave_the_listener_as_it_was(
    listener: HandshakePolicy,
) -> None:
    rng = random.Random(14)
    versions = ssl.TLSVersion.TLSv1_2, ssl.TLSVersion.TLSv1_3
    names = ("x.invalid", "a.b." * 60 + "c", "*.*", "127.0.0.1", "-")
    flights = [client_hello(version, name) for version in versions for name in names]
    with contextlib.ExitStack() as opened:
        for number in range(200):
            flight = bytearray(rng.choice(flights))
            for _ in range(rng.randrange(1, 6)):
                flight[rng.randrange(len(flight))] = rng.randrange(256)
            plain = opened.enter_context(socket.create_connection(("127.0.0.1", listener.port), SOON_S))
            plain.sendall(flight[: rng.randrange(len(flight))] if number % 5 == 0 else flight)

        assert [listener.shake_hands(speaking(version)) is not None for version in versions] == [True, True]


@pytest.mark.system
@pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl is not installed")
def test_a_client_that_asks_to_renegotiate_is_refused(listener: HandshakePolicy) -> None:
    told = subprocess.run(
        ["openssl", "s_client", "-connect", f"127.0.0.1:{listener.port}", "-tls1_2", "-msg"],
        input=b"R\n", capture_output=True, timeout=SOON_S, check=False,
    )  # fmt: skip

    _, asked, after = (told.stdout + told.stderr).partition(b"RENEGOTIATING")
    assert asked
    assert b"fatal no_renegotiation" in after or b"no renegotiation" in after


@pytest.mark.system
def test_a_robot_connects_by_wss_and_refuses_an_untrusted_certificate(
    listener: HandshakePolicy, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def echoed() -> object:
        async with connect(url=listener.url, token=listener.token()) as robot:
            return await robot.call("echo", {"value": 5})

    assert listener.url.startswith("wss://")
    with pytest.raises(RsePfError):
        asyncio.run(asyncio.wait_for(echoed(), SOON_S))
    monkeypatch.setenv("SSL_CERT_FILE", str(listener.certificate))
    assert asyncio.run(asyncio.wait_for(echoed(), SOON_S))


def test_a_certificate_without_its_key_is_refused_at_once() -> None:
    with pytest.raises(SettingsError, match="private_key"):
        PlatformSettings().replace(local={"certificate": "listener.pem"})
