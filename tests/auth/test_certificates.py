"""The authority of a platform and its server certificates: who trusts them, for what, and for how long."""

from __future__ import annotations

import socket
import ssl
import threading
import time
from pathlib import Path

import pytest

from rse_pf.auth.certificates import (
    AUTHORITY_S,
    SERVER_S,
    CertificateWithKey,
    issue_server_certificate,
    make_authority,
)
from rse_pf.errors import UsageError

NOW_S = time.time()
AUTHORITY = make_authority("default", now_s=NOW_S)


def handshake(authority: CertificateWithKey, server: CertificateWithKey, name: str, folder: Path) -> str:
    """Return what a client that trusts *authority* says of *server* as *name*; empty if it is content."""
    (folder / "server.pem").write_text(server.pem)
    serving = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    serving.load_cert_chain(folder / "server.pem")
    asking = ssl.create_default_context(cadata=authority.certificate)
    asking.verify_flags |= ssl.VERIFY_X509_STRICT
    ours, theirs = socket.socketpair()

    def serve() -> None:
        try:
            serving.wrap_socket(theirs, server_side=True).close()
        except OSError:
            theirs.close()

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        asking.wrap_socket(ours, server_hostname=name).close()
    except ssl.SSLCertVerificationError as error:
        return str(error.verify_message)
    finally:
        ours.close()
        thread.join()
    return ""


def test_a_client_with_the_authority_trusts_the_address_and_the_name(tmp_path: Path) -> None:
    server = issue_server_certificate(AUTHORITY, ["10.1.2.3", "fd00::1", "lab.local"], now_s=NOW_S)

    assert [handshake(AUTHORITY, server, name, tmp_path) for name in server.names] == ["", "", ""]
    assert server.names == ("10.1.2.3", "fd00::1", "lab.local")


def test_another_address_another_authority_and_an_expired_certificate_are_refused(tmp_path: Path) -> None:
    server = issue_server_certificate(AUTHORITY, ["10.1.2.3"], now_s=NOW_S)
    late = issue_server_certificate(AUTHORITY, ["10.1.2.3"], now_s=NOW_S - SERVER_S - 60)
    other = make_authority("default", now_s=NOW_S)

    assert "IP address mismatch" in handshake(AUTHORITY, server, "10.1.2.4", tmp_path)
    assert "unable to get local issuer" in handshake(other, server, "10.1.2.3", tmp_path)
    assert "expired" in handshake(AUTHORITY, late, "10.1.2.3", tmp_path)


def test_a_stolen_authority_cannot_vouch_for_a_site_of_the_internet(tmp_path: Path) -> None:
    forged = issue_server_certificate(AUTHORITY, ["example.org"], now_s=NOW_S)

    assert "permitted subtree violation" in handshake(AUTHORITY, forged, "example.org", tmp_path)


def test_a_server_certificate_cannot_sign_and_never_outlives_its_authority(tmp_path: Path) -> None:
    server = issue_server_certificate(AUTHORITY, ["10.1.2.3"], now_s=NOW_S)
    old = make_authority("default", now_s=NOW_S - AUTHORITY_S + 3600)

    assert handshake(
        AUTHORITY, issue_server_certificate(server, ["10.1.2.3"], now_s=NOW_S), "10.1.2.3", tmp_path
    )
    assert issue_server_certificate(old, ["10.1.2.3"], now_s=NOW_S).expires_s == pytest.approx(
        old.expires_s, abs=1
    )
    assert server.expires_s == pytest.approx(NOW_S + SERVER_S, abs=1)


def test_what_was_written_is_read_and_a_damaged_or_mixed_file_is_refused() -> None:
    server = issue_server_certificate(AUTHORITY, ["10.1.2.3"], now_s=NOW_S)

    assert CertificateWithKey.from_pem(AUTHORITY.pem) == AUTHORITY
    assert server.is_issued_by(AUTHORITY)
    assert not server.is_issued_by(make_authority("default", now_s=NOW_S))
    for wrong in (
        "",
        AUTHORITY.certificate,
        AUTHORITY.certificate + server.private_key,
        AUTHORITY.pem[:-200],
    ):
        with pytest.raises(UsageError):
            CertificateWithKey.from_pem(wrong)
